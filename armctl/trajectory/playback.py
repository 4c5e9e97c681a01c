"""A taught motion, played again: smoothed, eased in and out, at a rate of its own.

Rules.
1. Samples are brought to an even grid and smoothed by local cubics: what was recorded is whole ticks, and what was
   written may have corners. Smoothing reaches `HALF_WIDTH_S` to either side.
2. The taught time passes at the rate that was asked for; it sets off and stops smoothly within `EASE_S` each. So the
   joints go the taught way.
3. Every joint of the chain has to be in it. Joints that move no tool point, such as a gripper, move as far as they are
   in it, and stay where they are otherwise.
4. What is too fast for the arm is refused with the rate that would do; nothing is slowed down by itself. A limp joint
   that lay against its limit was read a tick or two beyond it: it is played at the limit. What was taught farther
   outside is refused.
"""

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, NamedTuple

import numpy as np
from pydantic import Field

from armctl.config import Frozen, Name, validate
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import ConfigError, RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S, JointTrajectory
from armctl.strict_yaml import csv_table, finite
from armctl.trajectory.bounds import Joints
from armctl.trajectory.interpolate import columns_at, time_law
from armctl.trajectory.plan import CHECK_PERIOD_S, against, led_in
from armctl.trajectory.preflight import EDGE_TICKS, ROUNDING, Driven, peak_tool_speed, times_too_fast
from armctl.trajectory.reference import ReferencePath
from armctl.trajectory.smoothing import local_cubics

HALF_WIDTH_S = 0.55
# Between samples before they are smoothed, at most, and after.
SAMPLE_S, ROW_S = 0.1, 0.02
EASE_S = 0.8
SHORTEST_S = 0.5
LOWEST_RATE, HIGHEST_RATE = 0.1, 2.0
MOST_REPEATS = 100
TIME = "time_s"
# As `armctl log export` names the position of a joint.
EXPORTED, DEGREES = ".position_rad", "_deg"
# Of angles in a request: a thousandth of a servo's tick.
DECIMALS = 5


class TaughtMotion(Frozen):
    """Joint positions over time."""

    joints: Annotated[tuple[Name, ...], Field(min_length=1, max_length=32, strict=False)]
    # When each row is due; rises, and begins anywhere.
    time_s: Annotated[tuple[float, ...], Field(min_length=2, strict=False)]
    # One row a sample, in the order of `joints`.
    positions_rad: Annotated[tuple[Joints, ...], Field(min_length=2, strict=False)]
    # Of whom it was recorded; empty: nobody knows.
    arm_id: str = Field("", max_length=64)
    calibration_hash: str = Field("", max_length=64)

    def _check(self) -> None:
        if len(set(self.joints)) != len(self.joints):
            raise ValueError(f"joints: {', '.join(self.joints)}; each may stand there once")
        if len(self.time_s) != len(self.positions_rad):
            raise ValueError(f"time_s has {len(self.time_s)} entries, positions_rad {len(self.positions_rad)} rows")
        if odd := [number for number, row in enumerate(self.positions_rad, 1) if len(row) != len(self.joints)]:
            raise ValueError(f"positions_rad: row {odd[0]} has not {len(self.joints)} numbers, one a joint")
        for number, (before, after) in enumerate(pairwise(self.time_s), 2):
            if after <= before:
                both = f"row {number} is at {after:g} s, the one before at {before:g} s"
                raise ValueError(f"time_s: {both}; it must rise")
        if not SHORTEST_S <= self.duration_s <= LONGEST_S:
            raise ValueError(f"time_s: {self.duration_s:g} s long; {SHORTEST_S:g} to {LONGEST_S:g} s can be played")

    @property
    def duration_s(self) -> float:
        return self.time_s[-1] - self.time_s[0]


class PlayRequest(Frozen):
    """What to play, a recording by its `name` or a `motion`, how fast and how often."""

    name: Name | None = None
    motion: TaughtMotion | None = None
    # Taught seconds a second.
    rate: float = Field(1.0, ge=LOWEST_RATE, le=HIGHEST_RATE)
    repeat: int = Field(1, ge=1, le=MOST_REPEATS)

    def _check(self) -> None:
        if (self.name is None) == (self.motion is None):
            raise ValueError("name, motion: give just one of them")


def motion_from_text(text: str, file: str) -> TaughtMotion:
    """The motion in comma-separated values: `time_s`, and a column a joint, named by it: radians, with `_deg` degrees.

    A table that `armctl log export` made has columns such as `shoulder.position_rad`; its other columns do not count.

    Args:
        file: Name of the file, for error messages.
    Raises:
        ConfigError: the table is none, or holds no motion; names the row or field, the value and its bound.
    """
    remedy = "the first row must be time_s and the joints' names, such as time_s,base,shoulder"
    header, rows = csv_table(text, file, (TIME,), remedy)
    columns = [name for name in header if name.endswith(EXPORTED)] or [name for name in header if name != TIME]
    if not columns:
        raise ConfigError(file, "header", "no column of a joint", remedy)
    time_s, positions = [], []
    for where, cells in rows:
        time_s.append(finite(cells[TIME], file, where))
        angles = ((name, finite(cells[name], file, where)) for name in columns)
        scaled = (math.radians(q) if name.endswith(DEGREES) else q for name, q in angles)
        positions.append(tuple(round(q, DECIMALS) for q in scaled))
    joints = tuple(name.removesuffix(EXPORTED).removesuffix(DEGREES) for name in columns)
    return validate(TaughtMotion, {"joints": joints, "time_s": tuple(time_s), "positions_rad": tuple(positions)}, file)


class Playback(NamedTuple):
    """A taught motion for one arm, smoothed and timed."""

    on: Driven
    rate: float
    # Of the taught motion, since its begin, shape (m,).
    taught_s: FloatArray
    # Shape (m, joints); NaN: the joint stays where it is.
    positions_rad: FloatArray

    @property
    def ease_s(self) -> float:
        return min(EASE_S, float(self.taught_s[-1]) / self.rate)

    @property
    def duration_s(self) -> float:
        return float(self.taught_s[-1]) / self.rate + self.ease_s

    def taught_at(self, time_s: FloatArray) -> FloatArray:
        """Taught time [s] at times since the begin [s], both of shape (k,)."""
        return np.asarray(self.taught_s[-1] * time_law(time_s / self.duration_s, self.ease_s / self.duration_s))

    @property
    def reference(self) -> ReferencePath:
        """The taught path of the tool by the share of the motion's time."""
        share = np.linspace(0.0, 1.0, len(self.taught_s))
        q = columns_at(self.taught_at(share * self.duration_s), self.taught_s, self.positions_rad)
        return ReferencePath(share, tool_position(self.on.robot.chain, q[:, : self.on.robot.chain.n]))

    def trajectory(self, q_now: Sequence[float]) -> JointTrajectory:
        """The whole motion from where the arm is.

        Args:
            q_now: Where the joints are wanted [rad], shape (joints,).
        Raises:
            RequestRefused: code PREFLIGHT, every reason, and the rate that would do where it is too fast.
        """
        kept = np.where(np.isnan(self.positions_rad), np.asarray(q_now), self.positions_rad)

        def motion(time_s: FloatArray) -> FloatArray:
            return columns_at(self.taught_at(time_s), self.taught_s, kept)

        if reasons := against(motion, self.duration_s, self.on, q_now):
            raise RequestRefused("PREFLIGHT", self._with_rate(reasons, kept))
        return led_in(motion, self.duration_s, self.on, q_now, "play")

    def _with_rate(self, reasons: Sequence[str], kept: FloatArray) -> list[str]:
        """The reasons, with the rate that would do in place of a duration."""
        slower = self
        # What was eased over at a high rate may show at a lower one.
        while (over := slower._over(kept)) > ROUNDING and slower.rate >= LOWEST_RATE:
            slower = slower._replace(rate=math.floor(100.0 * slower.rate / over) / 100.0)
        enough = slower.rate >= LOWEST_RATE
        remedy = f"rate {slower.rate:g} would do" if enough else f"even rate {LOWEST_RATE:g} is too fast"
        parts = (reason.partition("give it a duration") for reason in reasons)
        return [f"{why}{remedy}" if asked else why for why, asked, _ in parts]

    def _over(self, kept: FloatArray) -> float:
        """How many times too fast it is: a number by which the rate has to be divided."""
        time_s = np.arange(0.0, self.duration_s + CHECK_PERIOD_S, CHECK_PERIOD_S)
        q = columns_at(self.taught_at(time_s), self.taught_s, kept)
        tool_m_s = peak_tool_speed(tool_position(self.on.robot.chain, q[:, : self.on.robot.chain.n]), CHECK_PERIOD_S)
        return max(times_too_fast(q, CHECK_PERIOD_S, self.on.arm.joints), tool_m_s / self.on.arm.tool_speed_limit_m_s)


def playback(motion: TaughtMotion, rate: float, on: Driven) -> Playback:
    """A taught motion as this arm plays it.

    Raises:
        RequestRefused: code FOREIGN_LOG, another arm was taught, or with another calibration; code JOINTS, a joint of
            the arm is missing in it, or it has others.
    """
    arm = on.arm
    if motion.arm_id and (motion.arm_id, motion.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        other = f"it was recorded with arm {motion.arm_id}, calibration {motion.calibration_hash}"
        raise RequestRefused("FOREIGN_LOG", f"{other}; this is {arm.arm_id}, {arm.calibration_hash}")
    known, needed = ", ".join(arm.joint_names), arm.joint_names[: on.robot.chain.n]
    reasons = [f"there is no joint {name!r}; joints: {known}" for name in motion.joints if name not in arm.joint_names]
    reasons += [f"joint {name} is missing; it moves the tool" for name in needed if name not in motion.joints]
    if reasons:
        raise RequestRefused("JOINTS", reasons)
    time_s = np.array(motion.time_s) - motion.time_s[0]
    even_s = np.linspace(0.0, time_s[-1], math.ceil(time_s[-1] / min(SAMPLE_S, float(np.median(np.diff(time_s))))) + 1)
    rows_s = np.linspace(0.0, time_s[-1], math.ceil(time_s[-1] / ROW_S) + 1)
    samples = columns_at(even_s, time_s, np.array(motion.positions_rad))
    smooth = local_cubics(even_s, samples, rows_s, HALF_WIDTH_S)[0]
    positions = np.full((len(rows_s), len(arm.joints)), np.nan)
    positions[:, [arm.joint_names.index(name) for name in motion.joints]] = smooth
    inside = np.clip(positions, *np.array([joint.limits_rad for joint in arm.joints]).T)
    at_limit = np.abs(positions - inside) < (EDGE_TICKS + 0.5) * TICK_RAD
    return Playback(on, rate, rows_s, np.where(at_limit, inside, positions))
