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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, cast

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.annulus import ROUNDING, PlaneReach, waists_of_point
from armctl.kinematics.chain import Frame, blocks, columns_of
from armctl.kinematics.numbers import ARRAYS, FLOATS, Numbers
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
        q = np.empty((len(T), BRANCHES, 6))
        with np.errstate(invalid="ignore", divide="ignore"):
            for block in blocks(len(T)):
                for branch, angles in enumerate(self._branches(columns_of(T[block]), ARRAYS)):
                    for joint, angle in enumerate(angles):
                        q[block, branch, joint] = angle
        q[~np.isfinite(q).all(axis=-1)] = math.nan
        return q

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Every joint configuration [rad] of one pose, in plain floats: at most eight, in the order of `poses`.

        None at all where the pose is singular, or nearly: there branches meet, or are families.

        Args:
            T: Tool pose in the base frame, at least its first three rows.
        """
        x, y = T[0][3] - self.d6 * T[0][2], T[1][3] - self.d6 * T[1][2]
        square, beside = x * x + y * y, self.shoulder * self.shoulder
        if square == 0.0 or square - beside < EDGE * EDGE * (square + beside):
            return []
        found = [q for q in self._branches(cast(Frame, tuple(zip(*T[:3], strict=True))), FLOATS) if q[5] == q[5]]
        _, cos_bend, sin_bend = self._forearm
        edges = [min(abs(math.sin(q[2]) * cos_bend + math.cos(q[2]) * sin_bend), abs(math.sin(q[4]))) for q in found]
        return found if all(edge >= EDGE for edge in edges) else []

    def _branches(self, T: Frame, on: Numbers) -> Iterator[tuple[Any, ...]]:
        """Six angles of each branch, NaN where there is none, of the columns of a pose, or of many."""
        (n_x, n_y, n_z), (o_x, o_y, o_z), (a_x, a_y, a_z), (p_x, p_y, p_z) = T
        L, cos_bend, sin_bend = self._forearm
        a2, d6 = self.a2, self.d6
        w_x, w_y, v = p_x - d6 * a_x, p_y - d6 * a_y, p_z - d6 * a_z
        for c1, s1, radial in waists_of_point(w_x, w_y, self.shoulder, on):
            q1, u = on.atan2(s1, c1), radial - self.a1
            C = ((u * u + v * v) - (a2 * a2 + L * L)) / (2.0 * a2 * L)
            bent = on.root((1.0 - C) * (1.0 + C), 2.0 * ROUNDING)
            C = on.within(C, -1.0, 1.0)
            # The rotation, turned into the arm's plane.
            (n_u, n_v), (o_u, o_v), (a_u, a_v) = (
                (c1 * x + s1 * y, c1 * y - s1 * x) for x, y in ((n_x, n_y), (o_x, o_y), (a_x, a_y))
            )
            for S in (bent, -bent):
                c3, s3 = C * cos_bend + S * sin_bend, S * cos_bend - C * sin_bend
                along, across = a2 + L * C, L * S
                c2, s2 = u * along + v * across, v * along - u * across
                length = on.root(c2 * c2 + s2 * s2, 0.0)
                length = on.where(length > 0.0, length, math.nan)
                c2, s2 = c2 / length, s2 / length
                c23, s23 = c2 * c3 - s2 * s3, s2 * c3 + c2 * s3
                # Then along the forearm.
                a_3, w_3 = c23 * a_u + s23 * a_z, c23 * a_z - s23 * a_u
                h = on.root(a_3 * a_3 + a_v * a_v, 0.0)
                turns, off_line = h > _STRAIGHT, on.where(h > _STRAIGHT, h, math.nan)
                c4, s4 = on.where(turns, -a_3 / off_line, 1.0 + 0.0 * h), on.where(turns, -a_v / off_line, 0.0 * h)
                s6 = c4 * n_v - s4 * (c23 * n_u + s23 * n_z)
                c6 = c4 * o_v - s4 * (c23 * o_u + s23 * o_z)
                q2, q3 = on.atan2(s2, c2), on.atan2(s3, c3)
                q4, q5, q6 = on.atan2(s4, c4), on.atan2(h, w_3), on.atan2(s6, c6)
                yield q1, q2, q3, q4, q5, q6
                yield q1, q2, q3, q4 - on.copysign(math.pi, q4), -q5, q6 - on.copysign(math.pi, q6)

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
    side = np.cross(np.where((np.abs(axes[:, 2]) > 0.9)[:, None], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0]), axes)
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
