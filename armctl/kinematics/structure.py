"""Which closed form an arm's inverse kinematics has, told by its axes and not by its name.

An arm may be given by any table or URDF: its base, its zeros, its joints' directions and its tool frame are anybody's.
Two structures have closed forms, `PlanarArm` and `SphericalWrist`, each for a table of its own. A chain has such a
structure where it is that table but for constants,

    T(q) = B T_form(signs * q + zeros) C        (B: where the waist stands; C: how the tool frame is turned)

They follow from the axes at q = 0: the waist is the first one, the second lies across it, and the arm's plane is at
right angles to that. What was found is tried on some poses, so that nothing else is taken for it.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, joint_axes
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.spherical_wrist import SphericalWrist
from armctl.kinematics.transform import FloatArray, inverted

# Up to which a chain is what its structure says [m and rad]; `solve` brings what is left onto the target.
SAME = 1e-8
QUARTER, TURN = math.pi / 2.0, 2.0 * math.pi


@dataclass(frozen=True, eq=False)
class Placed:
    """A closed form at another place, with other zeros, directions and another tool frame."""

    form: PlanarArm | SphericalWrist
    # Shape (4, 4); C is a rotation alone.
    B: FloatArray
    C: FloatArray
    # Shape (n,).
    signs: FloatArray
    zeros_rad: FloatArray

    def poses(self, T: FloatArray) -> FloatArray:
        return self._ours(self.form.poses(self._theirs(T)))

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        signs, zeros = self.signs.tolist(), self.zeros_rad.tolist()
        return [
            tuple(math.remainder(sign * (q - zero), TURN) for q, sign, zero in zip(one, signs, zeros, strict=True))
            for one in self.form.pose(self._theirs(np.asarray(T)).tolist())
        ]

    def pose_families(self, T: FloatArray) -> FloatArray:
        return self._ours(self.form.pose_families(self._theirs(T)))

    def positions(self, points: FloatArray) -> FloatArray:
        return self._ours(self.form.positions((np.asarray(points) - self.B[:3, 3]) @ self.B[:3, :3]))

    def nearest_pose(self, T: FloatArray) -> tuple[FloatArray, float]:
        q, distance = self.form.nearest_pose(self._theirs(T))
        return self._ours(q), distance

    def nearest_position(self, point: FloatArray) -> tuple[FloatArray, float]:
        q, distance = self.form.nearest_position((np.asarray(point) - self.B[:3, 3]) @ self.B[:3, :3])
        return self._ours(q), distance

    def _theirs(self, T: FloatArray) -> FloatArray:
        before, after = self._around
        return np.asarray(before @ T @ after)

    @cached_property
    def _around(self) -> tuple[FloatArray, FloatArray]:
        return inverted(self.B), inverted(self.C)

    def _ours(self, q: FloatArray) -> FloatArray:
        q = self.signs * (q - self.zeros_rad)
        return np.asarray(q - 2.0 * math.pi * np.round(q / (2.0 * math.pi)))


# Joint ranges play no part in it; angles lie within +-pi.
ClosedForm = PlanarArm | SphericalWrist | Placed


def closed_form(chain: SerialChain) -> ClosedForm | None:
    """The closed form that a chain has, as it is where the chain is its own table; None: it is solved by numbers."""
    if chain.n < 4:
        return None
    on = _Axes(chain)
    try:
        candidate = _candidate(on)
    except ConfigError:
        return None  # a link without length
    if candidate is None:
        return None
    form, table, signs, zeros = candidate
    B = on.B
    C = inverted(B @ forward_kinematics(table, zeros)) @ forward_kinematics(chain, np.zeros(chain.n))
    q = np.random.default_rng(0).uniform(-math.pi, math.pi, (8, chain.n))
    off = np.abs(B @ forward_kinematics(table, signs * q + zeros) @ C - forward_kinematics(chain, q)).max()
    # Nor is it one where the tool is not where the form's is.
    if off >= SAME or np.abs(C[:3, 3]).max() > SAME:
        return None
    C[:3, 3] = 0.0
    own = max(np.abs(B - np.eye(4)).max(), np.abs(C - np.eye(4)).max(), np.abs(zeros).max(), 1.0 - signs.min())
    return form if own < 1e-15 else Placed(form, B, C, signs, zeros)


# A form, its own table, signs and zeros [rad].
Candidate = tuple[PlanarArm | SphericalWrist, SerialChain, FloatArray, FloatArray]


class _Axes:
    """The axes of a chain at q = 0, seen from its waist."""

    def __init__(self, chain: SerialChain) -> None:
        axes, tool = joint_axes(chain, np.zeros((1, chain.n)))
        self.n, z = chain.n, np.array([direction[:, 0] for direction, _ in axes])
        y, up = -z[1], z[0]
        # Its x points where the arm's plane does, its pitch axes along -y.
        self.B = np.eye(4)
        self.B[:3, :3] = np.stack([np.cross(y, up), y, up], axis=1)
        self.B[:3, 3] = axes[0][1][:, 0]
        self.z = z @ self.B[:3, :3]
        self.at = (np.array([*(place[:, 0] for _, place in axes), tool[:, 0]]) - self.B[:3, 3]) @ self.B[:3, :3]

    def pitches(self) -> int:
        """How many joints from the second on turn about the same direction."""
        return int(np.argmin([*(np.abs(np.abs(self.z[1:, 1]) - 1.0) < SAME), False]))

    @property
    def level(self) -> bool:
        """Whether the second axis lies across the waist's."""
        return abs(float(self.z[1] @ self.z[0])) < SAME and float(np.linalg.norm(np.cross(*self.z[:2]))) > 0.5


def _candidate(on: _Axes) -> Candidate | None:
    """The form that a chain may have."""
    pitches = on.pitches() if on.level else 0
    if (pitches, on.n) in ((3, 4), (4, 5), (3, 5)):
        return _planar(on, pitches, roll=on.n == pitches + 2)
    return _spherical(on) if pitches == 2 and on.n == 6 else None


def _planar(on: _Axes, pitches: int, *, roll: bool) -> Candidate:
    corners = np.array([*on.at[1 : pitches + 1], on.at[-1]])[:, [0, 2]]
    (a1, height), links = corners[0], np.diff(corners, axis=0)
    lengths = tuple(np.linalg.norm(links, axis=1).tolist())
    if min(lengths) < SAME:
        raise ConfigError("structure", "", "a link without length")
    shoulder = 0.0 if roll else -float(on.at[-1][1])
    form = PlanarArm(lengths, height=float(height), a1=float(a1), shoulder=shoulder, roll=roll)
    turns = np.diff(np.arctan2(links[:, 1], links[:, 0]), prepend=0.0)
    first = DHRow(a=float(a1), alpha=QUARTER, d=float(height))
    second = DHRow(a=lengths[0], d=shoulder)
    if not roll:
        rows = (first, second, *(DHRow(a=length) for length in lengths[1:]))
        return form, SerialChain(rows), np.array([1.0, *-on.z[1:, 1]]).round(), np.array([0.0, *turns])
    rows = (first, second, DHRow(a=lengths[1]), DHRow(alpha=-QUARTER), DHRow(d=lengths[2]))
    along = math.copysign(1.0, float(on.z[4][[0, 2]] @ links[2]))
    turns[2] -= QUARTER
    return form, SerialChain(rows), np.array([1.0, *-on.z[1:4, 1], along]).round(), np.array([0.0, *turns, 0.0])


def _spherical(on: _Axes) -> Candidate:
    (a1, height), upper = on.at[1][[0, 2]], (on.at[2] - on.at[1])[[0, 2]]
    e4, e5, e6 = on.z[3:6]
    # Where axes 4 and 6 meet, or come nearest; along one line, where axis 5 stands.
    across = np.cross(e4, e6)
    if float(across @ across) < 1e-6:
        wrist = on.at[3] + e4 * float((on.at[4] - on.at[3]) @ e4)
    else:
        wrist = on.at[3] + e4 * float(np.cross(on.at[5] - on.at[3], e6) @ across / (across @ across))
    # x of link 3 lies a quarter turn behind axis 4, in the arm's plane.
    x3 = np.cross(e4, [0.0, -1.0, 0.0])
    forearm = wrist - on.at[2]
    a2, a3, d4 = float(np.linalg.norm(upper)), float(forearm @ x3), float(forearm @ e4)
    d6, shoulder = float((on.at[-1] - wrist) @ e6), -float(wrist[1])
    form = SphericalWrist(a1=float(a1), a2=a2, a3=a3, shoulder=shoulder, d4=d4, d6=d6)
    on.B[:3, 3] += on.B[:3, 2] * float(height)
    first, second = DHRow(a=float(a1), alpha=QUARTER), DHRow(a=a2, d=shoulder)
    rows = (first, second, DHRow(a3, -QUARTER), DHRow(0.0, QUARTER, d4), DHRow(alpha=-QUARTER), DHRow(d=d6))
    theta2 = math.atan2(upper[1], upper[0])
    theta3 = math.atan2(x3[2], x3[0]) - theta2
    z4 = -np.cross(e4, x3)
    theta4 = math.atan2(float(np.cross(z4, e5) @ e4), float(z4 @ e5))
    theta5 = math.atan2(float(np.cross(e4, e6) @ e5), float(e4 @ e6))
    signs = np.array([1.0, *-on.z[1:3, 1], 1.0, 1.0, 1.0]).round()
    return form, SerialChain(rows), signs, np.array([0.0, theta2, theta3, theta4, theta5, 0.0])
