"""Plans: what the optimiser hands to the arm, their text form, and the checks before one may run.

A plan names joint positions (via points, both ends) at fractions of its progress and how to run between them; it
belongs to one arm and one calibration. Executing it means: slow approach to its first point, dwell, the plan proper,
settle. A plan that cannot be executed as it stands is refused as a whole, with every reason; nothing is clipped.
"""

from __future__ import annotations

import json
import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, model_validator

from armctl.config import ArmConfig, Name, validate
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.chain import link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory
from armctl.trajectory.approach import approach_duration_s
from armctl.trajectory.interpolate import (
    Interpolation,
    joint_path,
    quintic,
    time_law,
)

DWELL_S = 0.5
SETTLE_S = 0.5
MAX_VIA = 200
CHECK_PERIOD_S = 0.02
ACCELERATION_WINDOW_S = 0.1
"""Acceleration is the change of speed over this time: a corner of a linear plan is judged as the servo sees it."""

Point = Annotated[tuple[float, float, float], Field(strict=False)]
Joints = Annotated[tuple[float, ...], Field(strict=False)]


class Plan(BaseModel):
    """A straight-line motion of one arm; frozen and checked."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    from_m: Point
    to_m: Point
    duration_s: float = Field(gt=0.0, le=3600.0)
    via: int = Field(ge=0, le=MAX_VIA)
    """Waypoints between the first and the last."""
    interpolation: Interpolation
    waypoints_rad: tuple[Joints, ...] = Field(strict=False)
    """Joint positions, one row a waypoint, in the calibration file's joint order; shape (via + 2, joints)."""
    waypoint_progress: Joints
    """Progress of each waypoint, from 0 to 1."""
    predicted_mean_error_mm: float = Field(ge=0.0)
    predicted_max_error_mm: float = Field(ge=0.0)
    seed: int = Field(ge=0)

    @model_validator(mode="after")
    def _check(self) -> Plan:
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
        return self


def plan_to_text(plan: Plan) -> str:
    """The plan as JSON, indented for people, every bit kept."""
    return json.dumps(plan.model_dump(mode="json"), indent=1, allow_nan=False) + "\n"


def plan_from_text(text: str, file: str) -> Plan:
    """The plan written by `plan_to_text`.

    Args:
        file: Name of the file, for error messages.
    Raises:
        ConfigError: not JSON, or not exactly a plan; names the key, its value and its bound.
    """

    def mapping(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
        keys = [key for key, _ in pairs]
        if twice := [key for key in keys if keys.count(key) > 1]:
            raise ConfigError(file, twice[0], "the key stands twice")
        return dict(pairs)

    try:
        data = json.loads(text, object_pairs_hook=mapping)
    except (ValueError, RecursionError) as error:
        raise ConfigError(file, "", f"not a plan, not even JSON: {error}") from None
    return validate(Plan, data, file)


def plan_positions(plan: Plan, time_s: FloatArray) -> FloatArray:
    """Joint positions of the plan proper at times since its start.

    Args:
        time_s: Times, shape (m,); before the start counts as the start, after the end as the end.
    Returns:
        q [rad], shape (m, joints).
    """
    s = time_law(np.asarray(time_s) / plan.duration_s)
    return joint_path(np.array(plan.waypoints_rad), np.array(plan.waypoint_progress), s, plan.interpolation)


def joint_trajectory(plan: Plan, arm: ArmConfig, q_now: Sequence[float], period_s: float) -> JointTrajectory:
    """The whole motion from where the arm is: slow approach, dwell, the plan proper in [begin_s, end_s], settle.

    The approach is a synchronised quintic of at most 20 deg/s, slower where a joint's or the tool's limit is lower.

    Args:
        q_now: Commanded joint positions [rad], shape (joints,).
        period_s: Time between two rows.
    Raises:
        ValueError: `q_now` is not one finite number a joint of the plan, or the period is not positive.
    """
    start = np.array(plan.waypoints_rad[0])
    q0 = np.asarray(q_now, dtype=np.float64)
    if not start.shape == q0.shape == (len(arm.joints),) or not np.isfinite(q0).all():
        raise ValueError(f"q_now {q0.shape} and plan {start.shape} must be one finite number for each joint of the arm")
    if not 0.0 < period_s < math.inf:
        raise ValueError(f"period_s {period_s} must be above 0")
    approach_s = approach_duration_s(q0, start, arm, robots.get(arm.robot, arm.lengths_m))
    begin = math.ceil((approach_s + DWELL_S) / period_s - 1e-9)
    rows = begin + math.ceil((plan.duration_s + SETTLE_S) / period_s - 1e-9)
    time_s: FloatArray = np.arange(rows + 1) * np.float64(period_s)
    positions = plan_positions(plan, time_s - begin * period_s)
    approach = time_s < approach_s
    positions[approach] = quintic(q0, start, time_s[approach] / max(approach_s, 1e-9))
    return JointTrajectory(
        period_s=period_s,
        positions_rad=tuple(map(tuple, positions.tolist())),
        begin_s=begin * period_s,
        end_s=begin * period_s + plan.duration_s,
        label=f"line via {plan.via}",
    )


def preflight(plan: Plan, arm: ArmConfig, robot: Robot, q_now: Sequence[float]) -> tuple[str, ...]:
    """Every reason why the plan must not run on this arm from `q_now`; empty: it may.

    Looks at the whole motion, approach included, every 0.02 s.
    """
    reasons = []
    if plan.arm_id != arm.arm_id:
        reasons.append(f"the plan was made for arm {plan.arm_id!r}, this is {arm.arm_id!r}; optimise for this arm")
    elif plan.calibration_hash != arm.calibration_hash:
        reasons.append(
            f"the plan was made with calibration {plan.calibration_hash}, the arm now has {arm.calibration_hash}; "
            "optimise again"
        )
    joints = len(arm.joints)
    if len(plan.waypoints_rad[0]) != joints:
        return (*reasons, f"the plan moves {len(plan.waypoints_rad[0])} joints, the arm has {joints}")
    if len(q_now) != joints or not all(map(math.isfinite, q_now)):
        return (*reasons, f"the arm stands at {list(q_now)}, not {joints} known joint angles; connect it first")

    trajectory = joint_trajectory(plan, arm, q_now, CHECK_PERIOD_S)
    q = np.array(trajectory.positions_rad)
    window = round(ACCELERATION_WINDOW_S / CHECK_PERIOD_S)
    padded = np.concatenate([np.repeat(q[:1], window, axis=0), q, np.repeat(q[-1:], window, axis=0)])
    speed = np.abs(np.diff(q, axis=0)).max(axis=0) / CHECK_PERIOD_S
    bend = padded[2 * window :] - 2.0 * padded[window:-window] + padded[: -2 * window]
    acceleration = np.abs(bend).max(axis=0) / ACCELERATION_WINDOW_S**2
    for i, joint in enumerate(arm.joints):
        low, high = (math.degrees(limit) for limit in joint.limits_rad)
        slack = math.degrees(TICK_RAD) / 2.0
        for extreme in (math.degrees(float(q[:, i].min())), math.degrees(float(q[:, i].max()))):
            if not low - slack <= extreme <= high + slack:
                where = "stands at" if extreme == math.degrees(q_now[i]) else "would go to"
                reasons.append(
                    f"{joint.name} {where} {extreme:.1f} deg, outside its limits {low:.1f} to {high:.1f} deg"
                )
        for value, bound, unit, factor in (
            (math.degrees(float(speed[i])), joint.speed_limit_deg_s, "deg/s", 1.0),
            (math.degrees(float(acceleration[i])), joint.acceleration_limit_deg_s2, "deg/s2", 0.5),
        ):
            if value > bound * 1.001:
                reasons.append(
                    f"{joint.name} would reach {value:.1f} {unit}, at most {bound:.1f} {unit}; "
                    f"optimise with a duration of {plan.duration_s * (value / bound) ** factor:.1f} s or more"
                )
    frames = link_frames(robot.chain, q[:, : robot.chain.n])[:, 1:, :3, 3]
    tool_m_s = float(np.linalg.norm(np.diff(frames[:, -1], axis=0), axis=1).max()) / CHECK_PERIOD_S
    if tool_m_s > arm.tool_speed_limit_m_s * 1.001:
        reasons.append(
            f"the tool would reach {tool_m_s:.3f} m/s, at most {arm.tool_speed_limit_m_s:.3f} m/s; "
            f"optimise with a duration of {plan.duration_s * tool_m_s / arm.tool_speed_limit_m_s:.1f} s or more"
        )
    lowest = frames[..., 2].min(axis=0)
    if lowest.min() < arm.floor_m:
        link = int(lowest.argmin())
        part = "the tool" if link == robot.chain.n - 1 else f"the end of link {link + 1}"
        reasons.append(
            f"{part} would come down to {lowest.min():.3f} m, below the floor at {arm.floor_m:.3f} m; "
            "raise the line, or move the arm to another start"
        )
    return tuple(reasons)
