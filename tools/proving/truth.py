"""Where a tool truly is beside a line or a point, by geometry of the judge's own, and what an arm can reach at all.

Nothing here comes from the package. An arm's links are rows of numbers, multiplied out in `motions.py`; joints that
reach a place are looked for by damped least squares from many postures.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from proving.motions import Chain, MotionJudge
from proving.reading import TICK_DEG, Arm

FloatArray = NDArray[np.float64]

# What lines there are, by the way the tool goes: at right angles to its radius, so that the base turns; along it; up
# or down; at an angle within the plane of the base's axis; and with a good part of all three.
CLASSES = ("turning", "radial", "vertical", "slanted", "diagonal")
LENGTHS_M = (0.1, 0.3)
SLANTS_RAD = (math.radians(20.0), math.radians(70.0))
DIAGONAL_SHARE = 0.3
# Where tools are sent: not farther from the shoulder than this share of the stretched arm, for weak motors lift no
# more, in front, off the base and the floor.
STRETCH, AROUND_RAD = 0.85, 2.0
NEAREST_M, LOWEST_M, HIGHEST_M = 0.10, 0.03, 0.40
# A posture keeps so much from a joint's limits: a correction needs room.
ROOM_RAD = math.radians(9.0)
POSTURES, STATIONS = 24, 13
REACHED_M = 1e-4
# No joint turns more from one station to the next.
CONTINUOUS_RAD = 0.6


def off_line_mm(points_m: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """How far points, shape (m, 3), are from the straight line through A and B [mm]."""
    across = np.cross(points_m - A, (B - A) / np.linalg.norm(B - A))
    return np.asarray(np.linalg.norm(across, axis=1) * 1e3)


def off_chord_mm(points_m: FloatArray) -> FloatArray:
    """How far points, shape (m, 3), are from the straight line that fits them best [mm]."""
    middle = points_m.mean(axis=0)
    way = np.linalg.svd(points_m - middle, full_matrices=False)[2][0]
    return off_line_mm(points_m, middle, middle + way)


def covered(points_m: FloatArray, A: FloatArray, B: FloatArray) -> float:
    """Which share of the way from A to B a path goes: from where it begins to where it ends."""
    return float((points_m[-1] - points_m[0]) @ (B - A) / ((B - A) @ (B - A)))


def within(values: Sequence[float], share: float) -> float:
    """The smallest of the values that at least this share of them does not exceed."""
    return sorted(values)[max(0, math.ceil(share * len(values) - 1e-9) - 1)]


@dataclass(frozen=True, eq=False)
class Drawn:
    """A line that an arm can reach."""

    A: FloatArray
    B: FloatArray
    # A way of the joints along it [rad], shape (STATIONS, n).
    way_rad: FloatArray
    # How many lines were drawn before that it cannot.
    beyond: int


class Reach:
    """One arm, as far as it can reach."""

    def __init__(self, arm: Arm, chain: Chain) -> None:
        self._arm, self._motions, self._n = arm, MotionJudge(arm, chain), len(chain.rows)
        limits = np.radians([joint.limits_deg for joint in arm.joints[: self._n]])
        self._low, self._high = limits[:, 0] + ROOM_RAD, limits[:, 1] - ROOM_RAD
        links = self._motions.points(np.zeros((1, self._n)))[0, 1:]
        self._shoulder_m = links[0]
        self._far_m = STRETCH * float(np.linalg.norm(np.diff(links, axis=0), axis=1).sum())

    def tool_m(self, q: FloatArray) -> FloatArray:
        """Tool points [m], shape (m, 3), of joint positions [rad], shape (m, joints)."""
        return np.asarray(self._motions.points(q[:, : self._n])[:, -1])

    def point(self, rng: np.random.Generator) -> FloatArray:
        """A place [m] that some posture reaches, drawn at random."""
        while True:
            point = self._place(rng)
            if self._ways(point[None], rng):
                return point

    def line(self, kind: str, rng: np.random.Generator) -> Drawn:
        """A line of a class, drawn at random, and again where the arm cannot reach all of it."""
        beyond = 0
        while True:
            middle, half = self._place(rng), rng.uniform(*LENGTHS_M) / 2.0
            way = half * _direction(kind, math.atan2(middle[1], middle[0]), rng)
            A, B = middle - way, middle + way
            points = A + np.linspace(0.0, 1.0, STATIONS)[:, None] * (B - A)
            if self._has_room(points) and (ways := self._ways(points, rng)):
                return Drawn(A, B, ways[0], beyond)
            beyond += 1

    def unseen_mm(self, way_rad: FloatArray, A: FloatArray, B: FloatArray) -> float:
        """What no encoder shows: how far zeros that are off by up to half a tick, evenly, move the tool across AB.

        Root mean square over the joints' offsets and along the way; an arm's own offsets may be kinder or worse.
        """
        along = (B - A) / np.linalg.norm(B - A)
        J = self._slopes_m(way_rad)
        across = J - along[:, None] * (along @ J)[:, None, :]
        rms_m = float(np.sqrt((across**2).sum(axis=(1, 2)).mean()))
        return 1e3 * rms_m * math.radians(TICK_DEG) / math.sqrt(12.0)

    def _place(self, rng: np.random.Generator) -> FloatArray:
        while True:
            radius, around = self._far_m * math.sqrt(rng.uniform()), rng.uniform(-AROUND_RAD, AROUND_RAD)
            place = np.array([radius * math.cos(around), radius * math.sin(around), rng.uniform(0.0, HIGHEST_M)])
            if self._has_room(place[None]):
                return place

    def _has_room(self, points: FloatArray) -> bool:
        around = np.abs(np.arctan2(points[:, 1], points[:, 0]))
        return bool(
            (np.linalg.norm(points - self._shoulder_m, axis=1) < self._far_m).all()
            and np.hypot(points[:, 0], points[:, 1]).min() > NEAREST_M
            and points[:, 2].min() > self._arm.floor_m + LOWEST_M
            and around.max() < AROUND_RAD
        )

    def _ways(self, points: FloatArray, rng: np.random.Generator) -> list[FloatArray]:
        """A way of the joints through the points against which there is nothing to say; none: there is none."""
        q = rng.uniform(self._low, self._high, (POSTURES, self._n))
        way = [self._onto(points[0], q, 60)]
        for point in points[1:]:
            way.append(self._onto(point, way[-1], 8))
        ways = np.stack(way, axis=1)
        missed = np.stack([self.tool_m(one) for one in ways]) - points
        good = (np.linalg.norm(missed, axis=2) < REACHED_M).all(axis=1)
        good &= (np.abs(np.diff(ways, axis=1)) < CONTINUOUS_RAD).all(axis=(1, 2))
        others = np.zeros((len(points), len(self._arm.joints) - self._n))
        for one in ways[good]:
            rows = np.repeat(np.hstack([one, others]), 2 if len(one) == 1 else 1, axis=0)
            # Within its 5 s a line is slow: limits, floor and links are what counts.
            if not next(self._motions.against(rows.tolist(), 1.0), ""):
                return [one]
        return []

    def _onto(self, point: FloatArray, q: FloatArray, rounds: int) -> FloatArray:
        """Joint positions nearer to where the tool is at a point, within the limits, shape (k, n)."""
        for _ in range(rounds):
            J, away = self._slopes_m(q), point - self.tool_m(q)
            pulled = np.linalg.solve(J @ J.transpose(0, 2, 1) + 1e-6 * np.eye(3), away[:, :, None])
            step = (J.transpose(0, 2, 1) @ pulled)[:, :, 0]
            q = np.clip(q + np.clip(step, -0.2, 0.2), self._low, self._high)
        return q

    def _slopes_m(self, q: FloatArray) -> FloatArray:
        """By how much each joint moves the tool [m/rad], shape (k, 3, n), by differences."""
        h, n = 1e-6, self._n
        turned = (q[:, None] + np.concatenate([h * np.eye(n), -h * np.eye(n)])).reshape(-1, n)
        tools = self.tool_m(turned).reshape(len(q), 2, n, 3)
        return np.asarray(((tools[:, 0] - tools[:, 1]) / (2.0 * h)).transpose(0, 2, 1))


def _direction(kind: str, around_rad: float, rng: np.random.Generator) -> FloatArray:
    """A unit vector of a class of lines, at an azimuth."""
    out = np.array([math.cos(around_rad), math.sin(around_rad), 0.0])
    side, up = np.array([-out[1], out[0], 0.0]), np.array([0.0, 0.0, 1.0])
    sign = float(rng.choice((-1.0, 1.0)))
    if kind == "slanted":
        slant = float(rng.choice((-1.0, 1.0))) * rng.uniform(*SLANTS_RAD)
        return np.asarray(sign * (math.cos(slant) * out + math.sin(slant) * up))
    if kind == "diagonal":
        while np.abs(parts := rng.standard_normal(3)).min() < DIAGONAL_SHARE * np.linalg.norm(parts):
            pass
        return np.asarray((parts[0] * out + parts[1] * side + parts[2] * up) / np.linalg.norm(parts))
    return sign * {"turning": side, "radial": out, "vertical": up}[kind]
