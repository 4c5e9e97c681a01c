"""Closed-form inverse kinematics of a waist and three or four parallel pitch joints.

The waist turns a plane about z; the shoulder stands `a1` in front of the waist's axis, the plane `shoulder` beside it.
In the plane (u forward, v up) the links make the angles theta2, theta2 + theta3, ... with u.

1. The waist follows from the tool's direction where that fixes it (its normal is the pitch axis), else from the
   tool point: two solutions, forward and back.
2. The direction of the last link is the tool's pitch. Taking that link off leaves the wrist; four links leave one
   free angle there, which is chosen as near to the wanted `bend` of the last joint as the triangle allows.
3. Two links remain: a triangle, elbow up and down.

A tool point alone leaves the pitch free too: each wanted pitch is moved into what the other links can reach, whose
ends are again a triangle's. A hand that turns about its own axis (`roll`) points along its z axis and adds the turn.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.annulus import ROUNDING, PlaneReach, annulus
from armctl.kinematics.transform import FloatArray, finite

# Bends [rad] of the last joint that are tried where it is free: with the pitch free too, and with the pitch given.
BENDS = np.radians(np.arange(-120.0, 121.0, 15.0))
FINE_BENDS = np.radians(np.arange(-150.0, 151.0, 5.0))
# Nearer than this to a singular pose it is not for `pose`, nor farther from one that the arm can take.
EDGE, SAME = 1e-4, 1e-9
# Pitches [rad] that are tried where the tool's direction is free.
PITCHES = np.radians(np.arange(-180.0, 180.0, 5.0))


@dataclass(frozen=True)
class PlanarArm:
    """Lengths [m]; a positive pitch lifts the arm."""

    links_m: tuple[float, ...]
    height: float = 0.0
    a1: float = 0.0
    shoulder: float = 0.0
    roll: bool = False

    def __post_init__(self) -> None:
        if not min(self.links_m) > 0.0:
            raise ConfigError(
                "lengths", str(self.links_m), "links without length", "every link must be longer than 0 m"
            )
        assert not (self.roll and self.shoulder), "a rolling hand beside the waist's axis is not worked out"

    @property
    def tool_reach(self) -> PlaneReach:
        """Where the tool point can go."""
        return PlaneReach(self.links_m, self.a1, self.shoulder, self.height)

    def poses(self, T: FloatArray, bend: float = 0.0) -> FloatArray:
        """Every joint configuration of every pose; with a free last joint, those that bend it by about `bend` [rad].

        The tool's position and the direction of its last link hold exactly; whether the rest of the rotation does is
        for forward kinematics to say, since such an arm has fewer joints than a pose has freedoms.

        Args:
            T: Tool poses in the base frame, shape (m, 4, 4).
        Returns:
            q [rad], shape (m, branches, n): waist x elbow; NaN where a branch does not exist.
        """
        p = T[:, :3, 3]
        with np.errstate(invalid="ignore", divide="ignore"):
            if self.roll:
                c1, s1 = self._waist_of_axis(p, T[:, :3, 2])
            else:
                normal = np.hypot(T[:, 0, 2], T[:, 1, 2])
                c1 = np.where(normal > 0.0, -T[:, 1, 2] / normal, 1.0)[:, None]
                s1 = np.where(normal > 0.0, T[:, 0, 2] / normal, 0.0)[:, None]
            return self._facing(p, T[:, :3, :3], c1, s1, bend, clamp=False)

    def _facing(
        self, p: FloatArray, R: FloatArray, c1: FloatArray, s1: FloatArray, bend: float, *, clamp: bool
    ) -> FloatArray:
        """Configurations, shape (m, branches, n), at points p with the waist given and the direction as in R."""
        axis = R[:, :, 2 if self.roll else 0]
        u = c1 * p[:, :1] + s1 * p[:, 1:2] - self.a1
        v = p[:, 2:] - self.height + 0.0 * u
        pitch = np.arctan2(axis[:, 2:], c1 * axis[:, :1] + s1 * axis[:, 1:2])
        q = self._in_plane(u, v, pitch, bend, clamp=clamp)
        if self.roll:
            # n = cos(roll) X4 + sin(roll) Y4: X4 in the plane a quarter turn behind the hand, Y4 across the plane.
            reached = q[..., 0, :].sum(axis=-1)
            X = R[:, :, :1]
            along = np.cos(reached) * (c1 * X[:, 0] + s1 * X[:, 1]) + np.sin(reached) * X[:, 2]
            across = c1 * X[:, 1] - s1 * X[:, 0]
            roll = np.arctan2(across, along)[:, :, None, None]
            q = np.concatenate((q, np.broadcast_to(roll, (*q.shape[:3], 1))), axis=-1)
        return self._with_waist(c1, s1, q)

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Every joint configuration [rad] of one pose, in plain floats, in the order of `poses`.

        None at all with four links, where the pose is singular or nearly, and where the arm cannot take it.

        Args:
            T: Tool pose in the base frame, at least its first three rows.
        """
        (nx, _, zx, px), (ny, _, zy, py), (nz, _, zz, pz) = T[:3]
        far, level = math.hypot(px, py) / sum(self.links_m), math.hypot(zx, zy)
        if len(self.links_m) == 4 or (max(level, far) if self.roll else level) < EDGE:
            return []
        x, y, z = (zx, zy, zz) if self.roll else (nx, ny, nz)
        if not self.roll:
            c1, s1, out = -zy / level, zx / level, zz
        elif level > far:
            c1, s1, out = zx / level, zy / level, 0.0
        else:
            c1, s1, out = px / math.hypot(px, py), py / math.hypot(px, py), 0.0
        if max(abs(s1 * px - c1 * py - self.shoulder), abs(out), abs(s1 * x - c1 * y)) > SAME:
            return []
        a, b, last = self.links_m
        found: list[tuple[float, ...]] = []
        for c, s in ((c1, s1), (-c1, -s1)) if self.roll else ((c1, s1),):
            ahead, along = math.hypot(c * x + s * y, z), c * nx + s * ny
            pitch = math.atan2(z, c * x + s * y)
            u = c * px + s * py - self.a1 - last * (c * x + s * y) / ahead
            v = pz - self.height - last * z / ahead
            C = (u * u + v * v - a * a - b * b) / (2.0 * a * b)
            if abs(rest := (1.0 - C) * (1.0 + C)) < EDGE * EDGE:
                return []
            for S in (math.sqrt(rest), -math.sqrt(rest)) if rest > 0.0 else ():
                upper = math.atan2(v * (a + b * C) - u * b * S, u * (a + b * C) + v * b * S)
                elbow, reached = math.atan2(S, C), pitch - math.pi / 2.0 if self.roll else pitch
                last_rad = math.remainder(reached - upper - elbow, 2.0 * math.pi)
                turn = math.atan2(c * ny - s * nx, math.cos(reached) * along + math.sin(reached) * nz)
                found.append((math.atan2(s, c), upper, elbow, last_rad, *((turn,) if self.roll else ())))
        return found

    def pose_families(self, T: FloatArray) -> FloatArray:
        """Joint configurations [rad] of one pose, shape (branches, k, n): with four links, over k bends."""
        bends = FINE_BENDS if len(self.links_m) == 4 else np.zeros(1)
        return np.stack([self.poses(T[None], float(bend))[0] for bend in bends], axis=1)

    def positions(self, points: FloatArray) -> FloatArray:
        """Joint configurations [rad] that put the tool on points, over pitches and bends; roll 0.

        Args:
            points: Tool points in the base frame [m], shape (m, 3).
        Returns:
            q, shape (m, 4, k, n): waist x elbow; NaN where the point is out of reach.
        """
        bends = BENDS if len(self.links_m) == 4 else np.zeros(1)
        p = np.repeat(np.asarray(points, dtype=np.float64), len(PITCHES), axis=0)
        pitch = np.tile(PITCHES, len(points))[:, None]
        with np.errstate(invalid="ignore", divide="ignore"):
            c1, s1 = self._waist_of_point(p)
            u = c1 * p[:, :1] + s1 * p[:, 1:2] - self.a1
            v = p[:, 2:] - self.height + 0.0 * u
            family = []
            for bend in bends.tolist():
                q = self._in_plane(u, v, pitch + 0.0 * u, bend, clamp=True)
                if self.roll:
                    q = np.concatenate((q, np.zeros((*q.shape[:3], 1))), axis=-1)
                family.append(self._with_waist(c1, s1, q))
        q = np.stack(family).reshape(len(bends), len(points), len(PITCHES), 4, -1)
        return q.transpose(1, 3, 2, 0, 4).reshape(len(points), 4, len(PITCHES) * len(bends), -1)

    def nearest_position(self, point: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] of the tool's place nearest to a point, shape (k, n), and its distance [m]."""
        near, distance = self.tool_reach.nearest(point)
        return finite(self.positions(near[None])), distance

    def nearest_pose(self, T: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] near a pose this arm cannot take, shape (k, n), and the least distance [m].

        The tool's position comes first, then the direction of its last link, turned into the arm's plane and, as far
        as the other links need it, further.
        """
        near, distance = self.tool_reach.nearest(T[:3, 3])
        with np.errstate(invalid="ignore", divide="ignore"):
            c1, s1 = self._waist_of_point(near[None])
            q = self._facing(near[None], T[None, :3, :3], c1, s1, 0.0, clamp=True)[0]
        return finite(q), distance

    def _waist_of_point(self, p: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the waist, shape (m, 2): the plane holds the point, before and behind the axis."""
        x, y = p[:, :1], p[:, 1:2]
        offset, square = self.shoulder, x * x + y * y
        rest = square - offset * offset
        rest = np.where((rest < 0.0) & (rest >= -ROUNDING * (square + offset * offset)), 0.0, rest)
        radial = np.concatenate((np.sqrt(rest), -np.sqrt(rest)), axis=1)
        c1 = np.where(square > 0.0, (radial * x - offset * y) / square, 1.0)
        s1 = np.where(square > 0.0, (radial * y + offset * x) / square, 0.0)
        return c1, s1

    def _waist_of_axis(self, p: FloatArray, axis: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Cosine and sine of the waist, shape (m, 2), from the hand's axis or the point, whichever lies further out.

        Only for arms whose plane holds the waist's axis.
        """
        level, out = np.hypot(axis[:, 0], axis[:, 1]), np.hypot(p[:, 0], p[:, 1]) / sum(self.links_m)
        c1, s1 = self._waist_of_point(p)
        by_axis = level > out
        side = np.stack((1.0 / level, -1.0 / level), axis=1)
        c1 = np.where(by_axis[:, None], axis[:, :1] * side, c1)
        s1 = np.where(by_axis[:, None], axis[:, 1:2] * side, s1)
        return c1, s1

    def _in_plane(self, u: FloatArray, v: FloatArray, pitch: FloatArray, bend: float, *, clamp: bool) -> FloatArray:
        """Pitch joints, shape (m, waists, 2, links); NaN where the links do not reach."""
        *inner, last = self.links_m
        if clamp:
            pitch = _feasible(u, v, last, tuple(inner), pitch)
        directions = [pitch]
        u, v = u - last * np.cos(pitch), v - last * np.sin(pitch)
        if len(inner) == 3:
            free = _feasible(u, v, inner[2], tuple(inner[:2]), pitch - bend)
            directions.insert(0, free)
            u, v = u - inner[2] * np.cos(free), v - inner[2] * np.sin(free)
        a, b = inner[:2]
        C = (u * u + v * v - a * a - b * b) / (2.0 * a * b)
        rest = (1.0 - C) * (1.0 + C)
        S = np.sqrt(np.where((rest < 0.0) & (rest >= -4.0 * ROUNDING), 0.0, rest))
        C = np.clip(C, -1.0, 1.0)
        S = np.stack((S, -S), axis=-1)
        C, u, v = C[..., None], u[..., None], v[..., None]
        upper = np.arctan2(v * (a + b * C) - u * b * S, u * (a + b * C) + v * b * S)
        elbow = np.arctan2(S, C + 0.0 * S)
        total, joints = upper + elbow, [upper, elbow]
        for direction in directions:
            # The frame of a hand that rolls lies a quarter turn behind the direction it points in.
            quarter = math.pi / 2.0 if self.roll else 0.0
            joints.append(_wrapped(direction[..., None] - quarter - total))
            total = total + joints[-1]
        return np.stack(joints, axis=-1)

    def _with_waist(self, c1: FloatArray, s1: FloatArray, q: FloatArray) -> FloatArray:
        """Waist and pitch joints together, shape (m, waists x 2, n)."""
        waist = np.broadcast_to(np.arctan2(s1, c1)[:, :, None, None], (*q.shape[:3], 1))
        q = np.concatenate((waist, q), axis=-1).reshape(len(q), -1, q.shape[-1] + 1)
        q[~np.isfinite(q).all(axis=-1)] = math.nan
        return q


def _feasible(u: FloatArray, v: FloatArray, link: float, inner: tuple[float, ...], wanted: FloatArray) -> FloatArray:
    """The direction of a link that ends at (u, v), as near to the wanted one as the links before it can reach."""
    low, high = annulus(inner)
    distance, bearing = np.hypot(u, v), np.arctan2(v, u)
    across = 2.0 * distance * link
    least = np.arccos(np.clip((distance**2 + link**2 - low * low) / across, -1.0, 1.0))
    most = np.arccos(np.clip((distance**2 + link**2 - high * high) / across, -1.0, 1.0))
    off = _wrapped(wanted - bearing)
    turned = bearing + np.copysign(np.clip(np.abs(off), least, most), off)
    return np.where(across > 0.0, turned, wanted)


def _wrapped(angle: FloatArray) -> FloatArray:
    """The angle within +-pi."""
    return np.asarray(angle - 2.0 * math.pi * np.round(angle / (2.0 * math.pi)))
