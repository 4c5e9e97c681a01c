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
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.annulus import ROUNDING, PlaneReach, annulus, waists_of_point
from armctl.kinematics.chain import Frame, columns_of
from armctl.kinematics.numbers import ARRAYS, FLOATS, Numbers
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
            remedy = "every link must be longer than 0 m"
            raise ConfigError("lengths", str(self.links_m), "links without length", remedy)
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
        columns = columns_of(T)
        with np.errstate(invalid="ignore", divide="ignore"):
            return _stacked(self._branches(columns, self._waists(columns, ARRAYS), bend, ARRAYS))

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Every joint configuration [rad] of one pose, in plain floats, in the order of `poses`.

        None at all with four links, where the pose is singular or nearly, and where the arm cannot take it.

        Args:
            T: Tool pose in the base frame, at least its first three rows.
        """
        x_axis, _, (z_x, z_y, z_z), (p_x, p_y, _) = columns = cast(Frame, tuple(zip(*T[:3], strict=True)))
        far, level = math.hypot(p_x, p_y) / sum(self.links_m), math.hypot(z_x, z_y)
        if len(self.links_m) == 4 or (max(level, far) if self.roll else level) < EDGE:
            return []
        (c1, s1), *_ = waists = self._waists(columns, FLOATS)
        # What an arm of so few joints leaves: of the place, of the pitch axis, of the last link's direction.
        x, y, out = (z_x, z_y, 0.0) if self.roll else (*x_axis[:2], z_z)
        if max(abs(s1 * p_x - c1 * p_y - self.shoulder), abs(out), abs(s1 * x - c1 * y)) > SAME:
            return []
        found = [q for q in self._branches(columns, waists, 0.0, FLOATS) if q[2] == q[2]]
        return [] if any(abs(math.sin(elbow)) < EDGE for _, _, elbow, *_ in found) else found

    def _branches(
        self, T: Frame, waists: Iterable[tuple[Any, ...]], bend: float, on: Numbers, *, clamp: bool = False
    ) -> Iterator[tuple[Any, ...]]:
        """The angles of each branch, NaN where there is none, of the columns of a pose, or of many.

        Args:
            waists: Cosine and sine of the waist, and what may be told beside them, forward and back.
            clamp: The last link's direction is turned as far as the others need it to reach.
        """
        (n_x, n_y, n_z), _, _, (p_x, p_y, p_z) = T
        a_x, a_y, a_z = T[2 if self.roll else 0]
        for c1, s1, *_ in waists:
            pitch = on.atan2(a_z, c1 * a_x + s1 * a_y)
            for joints in self._in_plane(c1 * p_x + s1 * p_y - self.a1, p_z - self.height, pitch, bend, on, clamp):
                if self.roll:
                    # n = cos(roll) X4 + sin(roll) Y4: X4 in the plane a quarter turn behind the hand, Y4 across it.
                    reached = joints[0] + joints[1] + joints[2]
                    along = on.cos(reached) * (c1 * n_x + s1 * n_y) + on.sin(reached) * n_z
                    joints = (*joints, on.atan2(c1 * n_y - s1 * n_x, along))
                yield (on.atan2(s1, c1), *joints)

    def _in_plane(self, u: Any, v: Any, pitch: Any, bend: float, on: Numbers, clamp: bool) -> Iterator[tuple[Any, ...]]:
        """The pitch joints, elbow up and down."""
        *inner, last = self.links_m
        if clamp:
            pitch = _feasible(u, v, last, tuple(inner), pitch)
        directions = [pitch]
        u, v = u - last * on.cos(pitch), v - last * on.sin(pitch)
        if len(inner) == 3:
            free = _feasible(u, v, inner[2], tuple(inner[:2]), pitch - bend)
            directions.insert(0, free)
            u, v = u - inner[2] * on.cos(free), v - inner[2] * on.sin(free)
        a, b = inner[:2]
        C = (u * u + v * v - a * a - b * b) / (2.0 * a * b)
        root = on.root((1.0 - C) * (1.0 + C), 4.0 * ROUNDING)
        C = on.within(C, -1.0, 1.0)
        # The frame of a hand that rolls lies a quarter turn behind the direction it points in.
        quarter = math.pi / 2.0 if self.roll else 0.0
        for S in (root, -root):
            joints = [on.atan2(v * (a + b * C) - u * b * S, u * (a + b * C) + v * b * S), on.atan2(S, C + 0.0 * S)]
            total = joints[0] + joints[1]
            for direction in directions:
                joints.append(on.wrapped(direction - quarter - total))
                total = total + joints[-1]
            yield tuple(joints)

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
        p_x, p_y, p_z = np.repeat(np.asarray(points, dtype=np.float64), len(PITCHES), axis=0).T
        pitch, roll = np.tile(PITCHES, len(points)), (0.0,) * self.roll
        with np.errstate(invalid="ignore", divide="ignore"):
            waists = waists_of_point(p_x, p_y, self.shoulder, ARRAYS)
            planes = [(np.arctan2(s1, c1), c1 * p_x + s1 * p_y - self.a1) for c1, s1, _ in waists]
            family = [
                _stacked(
                    (waist, *joints, *roll)
                    for waist, u in planes
                    for joints in self._in_plane(u, p_z - self.height, pitch, bend, ARRAYS, clamp=True)
                )
                for bend in bends.tolist()
            ]
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
        at = np.array(T)
        at[:3, 3], distance = self.tool_reach.nearest(T[:3, 3])
        columns = columns_of(at[None])
        with np.errstate(invalid="ignore", divide="ignore"):
            waists = waists_of_point(*columns[3][:2], self.shoulder, ARRAYS)
            return finite(_stacked(self._branches(columns, waists, 0.0, ARRAYS, clamp=True))), distance

    def _waists(self, T: Frame, on: Numbers) -> list[tuple[Any, Any]]:
        """Cosine and sine of the waist of a pose: across the pitch axis or, where the hand rolls, as that points.

        Where it points up or down more than the point lies out, from the point: its plane holds the waist's axis.
        """
        (a_x, a_y, _), (p_x, p_y, _) = T[2:]
        level = on.root(a_x * a_x + a_y * a_y, 0.0)
        turns, leveled = level > 0.0, on.where(level > 0.0, level, math.nan)
        if not self.roll:
            return [(on.where(turns, -a_y / leveled, 1.0), on.where(turns, a_x / leveled, 0.0))]
        by_axis = level > on.root(p_x * p_x + p_y * p_y, 0.0) / sum(self.links_m)
        return [
            (on.where(by_axis, way * a_x / leveled, c1), on.where(by_axis, way * a_y / leveled, s1))
            for way, (c1, s1, _) in zip((1.0, -1.0), waists_of_point(p_x, p_y, self.shoulder, on), strict=True)
        ]


def _stacked(branches: Iterable[tuple[Any, ...]]) -> FloatArray:
    """Configurations, shape (m, branches, n); NaN as a whole where an angle is."""
    q = np.stack([np.stack(np.broadcast_arrays(*angles), axis=-1) for angles in branches], axis=1)
    q[~np.isfinite(q).all(axis=-1)] = math.nan
    return q


def _feasible(u: FloatArray, v: FloatArray, link: float, inner: tuple[float, ...], wanted: FloatArray) -> FloatArray:
    """The direction of a link that ends at (u, v), as near to the wanted one as the links before it can reach."""
    low, high = annulus(inner)
    distance, bearing = np.hypot(u, v), np.arctan2(v, u)
    across = 2.0 * distance * link
    least = np.arccos(np.clip((distance**2 + link**2 - low * low) / across, -1.0, 1.0))
    most = np.arccos(np.clip((distance**2 + link**2 - high * high) / across, -1.0, 1.0))
    off = ARRAYS.wrapped(wanted - bearing)
    return np.where(across > 0.0, bearing + np.copysign(np.clip(np.abs(off), least, most), off), wanted)
