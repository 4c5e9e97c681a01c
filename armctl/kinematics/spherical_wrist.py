"""Closed-form inverse kinematics of six joints with a spherical wrist: eight solutions.

Waist, two parallel pitch joints and three axes that meet in the wrist's centre W, in the signs of the PUMA 560
(alpha 90, 0, -90, 90, -90, 0).

1. W = p - d6 a. The waist turns it into the arm's plane, `shoulder` beside the axis:
   W_x s1 - W_y c1 = shoulder, W_x c1 + W_y s1 = +-sqrt(W_x^2 + W_y^2 - shoulder^2).
2. In that plane the elbow is a triangle of a2 and L = hypot(a3, d4): two solutions by the law of cosines.
3. What is left is R36 = Rz(theta4) Ry(-theta5) Rz(theta6): two solutions. theta6 is taken from its second row with
   theta4 put in, so that where theta5 is 0 and only theta4 + theta6 counts, the rotation is exact all the same.

No angle is computed to take its cosine again; each is one atan2 at the end.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.annulus import ROUNDING, PlaneReach
from armctl.kinematics.chain import blocks
from armctl.kinematics.transform import FloatArray, finite

BRANCHES = 8
# Below this |sin theta5| the directions of axes 4 and 6 cannot be told apart.
_STRAIGHT = 1e-12
# Nearer than this to a singular pose it is not for `pose`.
EDGE = 1e-4


@dataclass(frozen=True)
class SphericalWrist:
    """Lengths [m] of the arm."""

    a1: float
    a2: float
    a3: float
    shoulder: float
    d4: float
    d6: float

    def __post_init__(self) -> None:
        if not (self.a2 > 0.0 and math.hypot(self.a3, self.d4) > 0.0):
            found = f"a2 {self.a2}, a3 {self.a3}, d4 {self.d4}"
            raise ConfigError("lengths", found, "an arm without links", "a2 and hypot(a3, d4) must be above 0 m")

    @cached_property
    def _forearm(self) -> tuple[float, float, float]:
        """L, and cosine and sine of its bend."""
        L = math.hypot(self.a3, self.d4)
        return L, self.a3 / L, self.d4 / L

    @property
    def wrist_reach(self) -> PlaneReach:
        """Where the wrist's centre can go."""
        return PlaneReach((self.a2, self._forearm[0]), self.a1, self.shoulder, 0.0)

    def poses(self, T: FloatArray) -> FloatArray:
        """Every joint configuration of every pose.

        Args:
            T: Tool poses in the base frame, shape (m, 4, 4).
        Returns:
            q [rad], shape (m, 8, 6): waist forward and back x elbow x wrist; NaN where a branch does not exist.
        """
        q = np.empty((len(T), 2, 2, 2, 6))
        with np.errstate(invalid="ignore", divide="ignore"):
            for block in blocks(len(T)):
                self._block(T[block], q[block])
        return q.reshape(-1, BRANCHES, 6)

    def _block(self, T: FloatArray, q: FloatArray) -> None:
        (nx, ny, nz), (ox, oy, oz), (ax, ay, az), (px, py, pz) = (np.ascontiguousarray(T[:, :3, i].T) for i in range(4))
        L, cos_bend, sin_bend = self._forearm
        a2, offset, d6 = self.a2, self.shoulder, self.d6
        wx, wy, v = px - d6 * ax, py - d6 * ay, pz - d6 * az
        square = wx * wx + wy * wy
        root = np.sqrt(_no_rounding(square - offset * offset, ROUNDING * (square + offset * offset)))
        radial = np.stack((root, -root))[:, None]  # waist, elbow, pose
        c1 = np.where(square > 0.0, (radial * wx - offset * wy) / square, 1.0 + 0.0 * root)
        s1 = np.where(square > 0.0, (radial * wy + offset * wx) / square, 0.0 * root)
        u = radial - self.a1
        C = ((u * u + v * v) - (a2 * a2 + L * L)) / (2.0 * a2 * L)
        root = np.sqrt(_no_rounding((1.0 - C) * (1.0 + C), 2.0 * ROUNDING))
        S = np.concatenate((root, -root), axis=1)
        C = np.clip(C, -1.0, 1.0)
        c3, s3 = C * cos_bend + S * sin_bend, S * cos_bend - C * sin_bend
        along, across = a2 + L * C, L * S
        c2, s2 = u * along + v * across, v * along - u * across
        length = np.hypot(c2, s2)
        c2, s2 = c2 / length, s2 / length
        c23, s23 = c2 * c3 - s2 * s3, s2 * c3 + c2 * s3
        # The rotation seen from frame 3: first turned into the arm's plane, then along the forearm.
        x, y = c1 * ax + s1 * ay, c1 * ay - s1 * ax
        ax3, az3 = c23 * x + s23 * az, c23 * az - s23 * x
        h = np.sqrt(ax3 * ax3 + y * y)
        bent = h > _STRAIGHT
        c4, s4 = np.where(bent, -ax3 / h, 1.0 + 0.0 * h), np.where(bent, -y / h, 0.0 * h)
        x, y = c1 * nx + s1 * ny, c1 * ny - s1 * nx
        s6 = c4 * y - s4 * (c23 * x + s23 * nz)
        x, y = c1 * ox + s1 * oy, c1 * oy - s1 * ox
        c6 = c4 * y - s4 * (c23 * x + s23 * oz)
        q4, q5, q6 = np.arctan2(s4, c4), np.arctan2(h, az3), np.arctan2(s6, c6)
        first = (np.arctan2(s1, c1), np.arctan2(s2, c2), np.arctan2(s3, c3))
        for joint, angle in enumerate(first):
            q[..., joint] = angle.transpose(2, 0, 1)[..., None]
        flipped = (q4 - np.copysign(math.pi, q4), -q5, q6 - np.copysign(math.pi, q6))
        for joint, (angle, other) in enumerate(zip((q4, q5, q6), flipped, strict=True), start=3):
            q[..., 0, joint] = angle.transpose(2, 0, 1)
            q[..., 1, joint] = other.transpose(2, 0, 1)
        q[~np.isfinite(q).all(axis=-1)] = math.nan

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Every joint configuration [rad] of one pose, in plain floats: at most eight, in the order of `poses`.

        None at all where the pose is singular, or nearly: there branches meet, or are families.

        Args:
            T: Tool pose in the base frame, at least its first three rows.
        """
        (nx, ox, ax, px), (ny, oy, ay, py), (nz, oz, az, pz) = T[:3]
        L, cos_bend, sin_bend = self._forearm
        a2, offset, d6 = self.a2, self.shoulder, self.d6
        sqrt, atan2 = math.sqrt, math.atan2
        wx, wy, v = px - d6 * ax, py - d6 * ay, pz - d6 * az
        square = wx * wx + wy * wy
        rest = square - offset * offset
        if rest < EDGE * EDGE * (square + offset * offset) or square == 0.0:
            return []
        root = sqrt(rest)
        found: list[tuple[float, ...]] = []
        for radial in (root, -root):
            c1, s1 = (radial * wx - offset * wy) / square, (radial * wy + offset * wx) / square
            q1, u = atan2(s1, c1), radial - self.a1
            C = (u * u + v * v - (a2 * a2 + L * L)) / (2.0 * a2 * L)
            rest = (1.0 - C) * (1.0 + C)
            if abs(rest) < EDGE * EDGE:
                return []
            if rest < 0.0:
                continue
            S = sqrt(rest)
            along = a2 + L * C
            a_x, a_y = c1 * ax + s1 * ay, c1 * ay - s1 * ax
            n_x, n_y = c1 * nx + s1 * ny, c1 * ny - s1 * nx
            o_x, o_y = c1 * ox + s1 * oy, c1 * oy - s1 * ox
            for S3 in (S, -S):
                c3, s3 = C * cos_bend + S3 * sin_bend, S3 * cos_bend - C * sin_bend
                across = L * S3
                q3, q2 = atan2(s3, c3), atan2(v * along - u * across, u * along + v * across)
                c23, s23 = u * along + v * across, v * along - u * across
                length = sqrt(c23 * c23 + s23 * s23)
                c23, s23 = (c23 * c3 - s23 * s3) / length, (s23 * c3 + c23 * s3) / length
                ax3, az3 = c23 * a_x + s23 * az, c23 * az - s23 * a_x
                h = sqrt(ax3 * ax3 + a_y * a_y)
                if h < EDGE:
                    return []
                c4, s4 = -ax3 / h, -a_y / h
                q4, q5 = atan2(s4, c4), atan2(h, az3)
                q6 = atan2(c4 * n_y - s4 * (c23 * n_x + s23 * nz), c4 * o_y - s4 * (c23 * o_x + s23 * oz))
                half_4 = -math.pi if q4 > 0.0 else math.pi
                half_6 = -math.pi if q6 > 0.0 else math.pi
                found += (q1, q2, q3, q4, q5, q6), (q1, q2, q3, q4 + half_4, -q5, q6 + half_6)
        return found

    def pose_families(self, T: FloatArray) -> FloatArray:
        """Every joint configuration [rad] of one pose, shape (8, 1, 6): six joints leave nothing free."""
        return self.poses(T[None]).reshape(BRANCHES, 1, 6)

    def positions(self, points: FloatArray) -> FloatArray:
        """Joint configurations [rad] that put the tool on points, with the hand in many directions.

        Args:
            points: Tool points in the base frame [m], shape (m, 3).
        Returns:
            q, shape (m, 8, k, 6) over k directions; NaN where the wrist does not reach.
        """
        axes = _directions()
        T = poses_along(np.repeat(points, len(axes), axis=0), np.tile(axes, (len(points), 1)))
        return self.poses(T).reshape(len(points), len(axes), BRANCHES, 6).swapaxes(1, 2)

    def nearest_position(self, point: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] of the tool's place nearest to a point out of reach, and its distance [m].

        Returns:
            q, shape (k, 6), the hand pointing at the point; distance 0 where some direction of the hand reaches it.
        """
        wrist, gap = self.wrist_reach.nearest(point)
        if gap <= abs(self.d6):
            return finite(self.positions(np.asarray(point)[None])), 0.0
        axis = (np.asarray(point) - wrist) / gap
        hand = poses_along(wrist + abs(self.d6) * axis, math.copysign(1.0, self.d6) * axis[None])
        return finite(self.poses(hand)), gap - abs(self.d6)

    def nearest_pose(self, T: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] of the pose of the same rotation nearest to one out of reach, and its distance [m]."""
        near = np.array(T)
        wrist, distance = self.wrist_reach.nearest(T[:3, 3] - self.d6 * T[:3, 2])
        near[:3, 3] = wrist + self.d6 * T[:3, 2]
        return finite(self.poses(near[None])), distance


def poses_along(point: FloatArray, axes: FloatArray) -> FloatArray:
    """Poses at points [m] whose z axes are the unit vectors `axes`, shapes (k, 3) or (3,), (k, 3) -> (k, 4, 4)."""
    T = np.zeros((len(axes), 4, 4))
    steep = np.abs(axes[:, 2]) > 0.9
    side = np.cross(np.where(steep[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), axes)
    T[:, :3, 1] = side / np.linalg.norm(side, axis=1, keepdims=True)
    T[:, :3, 2] = axes
    T[:, :3, 0] = np.cross(T[:, :3, 1], axes)
    T[:, :3, 3] = point
    T[:, 3, 3] = 1.0
    return T


def _directions(count: int = 128) -> FloatArray:
    """Unit vectors spread evenly over the sphere (golden spiral), shape (count, 3)."""
    k = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * k / count, math.pi * (1.0 + math.sqrt(5.0)) * k
    r = np.sqrt(1.0 - z * z)
    return np.stack((r * np.cos(turn), r * np.sin(turn), z), axis=1)


def _no_rounding(value: FloatArray, slack: FloatArray | float) -> FloatArray:
    """`value`, with what lies within `slack` below zero counted as zero."""
    return np.where((value < 0.0) & (value >= -slack), 0.0, value)
