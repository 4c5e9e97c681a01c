"""Plans: what the optimiser hands to the arm, their text form, and the checks before one may run.

A plan names joint positions (via points, both ends) at fractions of its progress and how to run between them; it
belongs to one arm and one calibration. Executing it means: slow approach to just behind its first point, on to that
point in the direction of departure, dwell, the plan proper, settle. A plan with a via point every tick is a stream of
goals. One that cannot be executed as it stands is refused as a whole, with every reason; nothing is clipped.
"""

import json
import math
from collections.abc import Callable, Sequence
from functools import partial
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import Field

from armctl.config import ArmConfig, Frozen, Name, validate
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S, JointTrajectory
from armctl.strict_yaml import parse_json
from armctl.trajectory.approach import approach_duration_s
from armctl.trajectory.interpolate import Interpolation, joint_path, rest_to_rest, time_law
from armctl.trajectory.preflight import Driven, DrivenArm, preflight_motion

# How far behind its first point a plan is approached: more than what play and friction of a loaded servo take.
LEAD_RAD = math.radians(4.0)
# The way from there takes so long at least: a correction changes by 4 degrees a second at most, and what it is late by
# ends as an error that friction keeps at the first point.
LEAD_S = 2.0
# In this share of the duration a joint moves by LEAD_RAD, or it has no direction of departure.
LEAD_SHARE = 0.2
# And within this time, where the motion is none of a plan.
EARLY_S = 1.0
# The control step counts trajectory seconds up tick by tick: without this the plan might seem to begin a tick late.
ROUNDING_S = 1e-9
DWELL_S = 0.2
SETTLE_S = 0.5
# A goal every tick, a minute long at 50 Hz.
MAX_VIA = 3000
CHECK_PERIOD_S = 0.02

# Joint positions [rad], shape (m, joints), at times [s] since its start, shape (m,); the start before it.
Motion = Callable[[FloatArray], FloatArray]
Point = Annotated[tuple[float, float, float], Field(strict=False)]
Joints = Annotated[tuple[float, ...], Field(strict=False)]


class Plan(Frozen):
    """A straight-line motion of one arm; frozen and checked."""

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    from_m: Point
    to_m: Point
    duration_s: float = Field(gt=0.0, le=LONGEST_S)
    # Waypoints between the first and the last.
    via: int = Field(ge=0, le=MAX_VIA)
    interpolation: Interpolation
    # Joint positions, one row a waypoint, in the calibration file's joint order; shape (via + 2, joints).
    waypoints_rad: tuple[Joints, ...] = Field(strict=False)
    # Progress of each waypoint, from 0 to 1.
    waypoint_progress: Joints
    predicted_mean_error_mm: float = Field(ge=0.0)
    predicted_max_error_mm: float = Field(ge=0.0)
    seed: int = Field(ge=0)

    def _check(self) -> None:
        if len(self.waypoints_rad) != self.via + 2:
            raise ValueError(f"waypoints_rad has {len(self.waypoints_rad)} rows; via {self.via} needs {self.via + 2}")
        widths = {len(row) for row in self.waypoints_rad}
        if len(widths) != 1 or 0 in widths:
            raise ValueError(f"waypoints_rad has rows of {sorted(widths)} joints; all must name the same, at least one")
        progress = self.waypoint_progress
        if len(progress) != self.via + 2 or progress[0] != 0.0 or progress[-1] != 1.0:
            raise ValueError(f"waypoint_progress must be {self.via + 2} numbers from 0 to 1")
        if any(after <= before for before, after in pairwise(progress)):
            raise ValueError("waypoint_progress must increase strictly")


def plan_through(
    arm: ArmConfig, waypoints_rad: FloatArray, knots: FloatArray, predicted_mm: Sequence[float], **asked: Any
) -> Plan:
    """The plan through waypoints [rad], shape (k, joints), at the progress of the knots, shape (k,).

    Args:
        predicted_mm: Mean and largest distance from the line.
        asked: The fields that say which line it is and how it is gone: ends, duration, interpolation, seed.
    """
    return Plan(
        arm_id=arm.arm_id,
        calibration_hash=arm.calibration_hash,
        via=len(knots) - 2,
        waypoints_rad=tuple(map(tuple, waypoints_rad.tolist())),
        waypoint_progress=tuple(knots.tolist()),
        predicted_mean_error_mm=predicted_mm[0],
        predicted_max_error_mm=predicted_mm[1],
        **asked,
    )


def plan_to_text(plan: Frozen) -> str:
    """The plan, or a path, as JSON, indented for people, every bit kept."""
    return json.dumps(plan.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def plan_from_text(text: str, file: str) -> Plan:
    """The plan written by `plan_to_text`.

    Args:
        file: Name of the file, for error messages.
    Raises:
        ConfigError: not JSON, or not exactly a plan; names the key, its value and its bound.
    """
    return validate(Plan, parse_json(text, file), file)


def plan_positions(plan: Plan, time_s: FloatArray) -> FloatArray:
    """Joint positions of the plan proper at times since its start.

    Args:
        time_s: Times, shape (m,); before the start counts as the start, after the end as the end.
    Returns:
        q [rad], shape (m, joints).
    """
    s = time_law(np.asarray(time_s) / plan.duration_s)
    return joint_path(np.array(plan.waypoints_rad), np.array(plan.waypoint_progress), s, plan.interpolation)


def joint_trajectory(plan: Plan, on: Driven, q_now: Sequence[float]) -> JointTrajectory:
    """The whole motion from where the arm is: slow approach, dwell, the plan proper in [begin_s, end_s], settle.

    The approach is a synchronised quintic of at most 20 deg/s, slower where a joint's or the tool's limit is lower.

    Args:
        q_now: Commanded joint positions [rad], shape (joints,).
    Raises:
        ValueError: `q_now` is not one finite number a joint of the plan, or the period is not positive.
    """
    return led_in(partial(plan_positions, plan), plan.duration_s, on, q_now, f"line via {plan.via}", early_s=math.inf)


def led_in(
    motion: Motion, duration_s: float, on: Driven, q_now: Sequence[float], label: str, *, early_s: float = EARLY_S
) -> JointTrajectory:
    """Any motion with its slow approach, which comes to its first point in the direction of departure.

    Args:
        q_now: Commanded joint positions [rad], shape (joints,).
        early_s: The direction of departure is where the motion leads within this time, and within `LEAD_SHARE` of it.
    Raises:
        ValueError: `q_now` is not one finite number a joint of the motion, or the period is not positive.
    """
    [start], arm, period_s = motion(np.zeros(1)), on.arm, on.period_s
    q0 = np.asarray(q_now, dtype=np.float64)
    if not start.shape == q0.shape == (len(arm.joints),) or not np.isfinite(q0).all():
        raise ValueError(f"q_now {q0.shape} and motion {start.shape} must be one finite number for each joint")
    if not 0.0 < period_s < math.inf:
        raise ValueError(f"period_s {period_s} must be above 0")
    low, high = np.array([joint.limits_rad for joint in arm.joints]).T
    lead_rad = _lead(motion, min(early_s, LEAD_SHARE * duration_s))
    behind = np.where((low <= start) & (start <= high), np.clip(start - lead_rad, low, high), start)
    there_s, led_s = [approach_duration_s(a, b, on) for a, b in ((q0, behind), (behind, start))]
    ways = [(q0, behind, there_s), (behind, start, max(LEAD_S, led_s) if led_s else 0.0)]
    return approached(ways, motion, duration_s, period_s, label)


def against(
    motion: Motion, duration_s: float, on: Driven, q_now: Sequence[float], *, early_s: float = EARLY_S
) -> tuple[str, ...]:
    """Every reason why a motion, led in as `led_in` does, must not run from `q_now` [rad]; empty: it may.

    Looks at the whole motion, approach included, every `CHECK_PERIOD_S`.
    """
    checked = DrivenArm(on.arm, on.robot, CHECK_PERIOD_S)
    whole = led_in(motion, duration_s, checked, q_now, "", early_s=early_s)
    return preflight_motion(np.array(whole.positions_rad), checked, duration_s=duration_s)


def approached(
    ways: Sequence[tuple[FloatArray, FloatArray, float]], motion: Motion, duration_s: float, period_s: float, label: str
) -> JointTrajectory:
    """Slow ways one after the other, dwell, a motion in [begin_s, end_s], settle.

    Args:
        ways: From where [rad], to where [rad], each of shape (joints,), and how long [s].
    """
    begin = math.ceil((sum(way_s for _, _, way_s in ways) + DWELL_S) / period_s - 1e-9)
    rows = begin + math.ceil((duration_s + SETTLE_S) / period_s - 1e-9)
    time_s: FloatArray = np.arange(rows + 1) * np.float64(period_s)
    positions = motion(time_s - begin * period_s)
    set_off_s = 0.0
    for q0, q1, way_s in ways:
        there_s = set_off_s + way_s
        going = (time_s >= set_off_s) & (time_s < there_s)
        positions[going] = rest_to_rest(q0, q1, (time_s[going] - set_off_s) / max(there_s - set_off_s, 1e-9))
        set_off_s = there_s
    begin_s, end_s = begin * period_s - ROUNDING_S, begin * period_s + duration_s - ROUNDING_S
    return JointTrajectory(period_s, tuple(map(tuple, positions.tolist())), begin_s=begin_s, end_s=end_s, label=label)


def lead(plan: Plan) -> FloatArray:
    """How far each joint starts behind the plan's first point [rad], shape (joints,).

    A servo that comes to a point from one side and leaves it to the other first crosses its play and turns its
    friction around; one that comes in the direction of its departure has done both before the plan begins.
    """
    return _lead(partial(plan_positions, plan), LEAD_SHARE * plan.duration_s)


def _lead(motion: Motion, early_s: float) -> FloatArray:
    start, early = motion(np.array([0.0, early_s]))
    return np.asarray(np.clip(early - start, -LEAD_RAD, LEAD_RAD))


def preflight(plan: Plan, on: Driven, q_now: Sequence[float]) -> tuple[str, ...]:
    """Every reason why the plan must not run on this arm from `q_now`; empty: it may."""
    reasons, arm = [], on.arm
    if plan.arm_id != arm.arm_id:
        reasons.append(f"the plan was made for arm {plan.arm_id!r}, this is {arm.arm_id!r}; optimise for this arm")
    elif plan.calibration_hash != arm.calibration_hash:
        both = f"calibration {plan.calibration_hash}, the arm now has {arm.calibration_hash}"
        reasons.append(f"the plan was made with {both}; optimise again")
    joints = len(arm.joints)
    if len(plan.waypoints_rad[0]) != joints:
        return (*reasons, f"the plan moves {len(plan.waypoints_rad[0])} joints, the arm has {joints}")
    if len(q_now) != joints or not all(map(math.isfinite, q_now)):
        return (*reasons, f"the arm stands at {list(q_now)}, not {joints} known joint angles; connect it first")
    return (*reasons, *against(partial(plan_positions, plan), plan.duration_s, on, q_now, early_s=math.inf))
