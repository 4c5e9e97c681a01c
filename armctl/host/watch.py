"""A motion as the host sees it: what makes its trajectory, what is seen of it, and the look ahead of a jog."""

import math
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics.robots.robot import Robot
from armctl.messages import JointTrajectory, Reply, TickRecord
from armctl.trajectory.collision import floor_clearance, judged_pairs, link_clearance, link_points

# How far ahead of a jog collisions are looked for: heartbeat, stop and then some.
JOG_LOOK_S = 0.5
JOG_LOOKS = 11
SAME_M = 1e-6
# A joint so near to its limit, or there so soon, stands at it: two ticks of an encoder.
AT_LIMIT_RAD, AT_LIMIT_S = 0.0102, 0.5
# So near above the floor the control step leads no link down any more.
AT_FLOOR_M = 0.0005
# Of the load asked for: with less the gripper holds nothing, or has lost it.
HELD_SHARE = 0.5
# Makes a trajectory from where the joints are told to be [rad]; refuses what must not be run.
Leg = Callable[[Sequence[float]], JointTrajectory]


@dataclass
class Watch:
    """What is seen of the arm while it moves."""

    time_ns: list[int] = field(default_factory=list)
    # When each joint's servo was read.
    stamps_ns: list[tuple[int, ...]] = field(default_factory=list)
    positions_rad: list[tuple[float, ...]] = field(default_factory=list)
    # Fraction of the trajectory at which the arm was to be then.
    progress: list[float] = field(default_factory=list)
    # The same at the next tick, as far as it is known.
    ahead: float = 0.0
    marks_ns: dict[str, int] = field(default_factory=dict)
    # When each tick's goal left, the joints' goals, and where they are to be a tick later [rad]; empty: there was none.
    now_ns: list[int] = field(default_factory=list)
    goals: list[tuple[int, ...]] = field(default_factory=list)
    wanted_rad: list[tuple[float, ...]] = field(default_factory=list)
    # Whether each servo answered, and its load.
    fresh: list[tuple[bool, ...]] = field(default_factory=list)
    load_ratio: list[tuple[float, ...]] = field(default_factory=list)
    # How often goals were changed at rest.
    corrections: int = 0

    def see(self, record: TickRecord) -> None:
        self.time_ns.append(record.inputs.sample.time_ns)
        joints = len(record.outputs.joints)  # behind their first servos come the second ones of pairs
        self.stamps_ns.append(tuple(servo.stamp_ns for servo in record.inputs.sample.servos[:joints]))
        self.positions_rad.append(tuple(joint.position_rad for joint in record.outputs.joints))
        self.progress.append(self.ahead)
        self.ahead = self.ahead if record.outputs.progress is None else record.outputs.progress
        self.fresh.append(tuple(servo.fresh for servo in record.inputs.sample.servos))
        self.load_ratio.append(tuple(joint.load_ratio for joint in record.outputs.joints))
        self.now_ns.append(record.inputs.now_ns)
        goal = record.outputs.goal
        self.goals.append(goal.ticks[:joints] if goal is not None else self.goals[-1] if self.goals else ())
        self.wanted_rad.append(record.outputs.wanted_rad)
        for event in record.outputs.events:
            self.corrections += event.code == "CORRECTED"
            if event.code in ("PLAN_BEGIN", "PLAN_END"):
                self.marks_ns[event.code] = record.inputs.sample.time_ns


class Done(NamedTuple):
    """A leg that was run to its end."""

    trajectory: JointTrajectory
    watch: Watch
    reply: Reply


def holds(arm: ArmConfig, load_ratio: Sequence[float]) -> bool:
    """Whether the gripper's load says that it holds something; an arm without a gripper holds nothing.

    Args:
        load_ratio: Of every joint.
    """
    gripper = arm.gripper
    held = 0.0 if gripper is None else abs(load_ratio[arm.joint_names.index(gripper.joint)])
    return gripper is not None and held >= HELD_SHARE * gripper.load_ratio


def refuse_at_limit(q_now: Sequence[float], joints_rad_s: Sequence[float], arm: ArmConfig) -> None:
    """Refuse a jog that would lead nowhere: what asks for it is to hear why.

    Raises:
        RequestRefused: code LIMIT, naming the joint that stands at its limit.
    """
    ways = zip(arm.joints, q_now, joints_rad_s, strict=True)
    turning = [(joint.name, joint.limits_rad[v > 0.0], q, v) for joint, q, v in ways if v]
    stands = [(name, to) for name, to, q, v in turning if (to - q) / v < min(AT_LIMIT_S, AT_LIMIT_RAD / abs(v))]
    if stands and len(stands) == len(turning):
        at = f"{stands[0][0]} stands at its limit, {math.degrees(stands[0][1]):.1f} deg"
        raise RequestRefused("LIMIT", f"{at}, and would have to turn past it; jog another way")


def refuse_collision(q_now: Sequence[float], joints_rad_s: Sequence[float], arm: ArmConfig, robot: Robot) -> None:
    """Look where a jog of the joints leads within `JOG_LOOK_S`; links that overlap already may come apart.

    The control step keeps limits and floor on the way. Here the links must not come to touch each other, and an arm at
    the floor must not go down.

    Raises:
        RequestRefused: code PREFLIGHT, naming the links, or the floor.
    """
    n, radius_m = robot.chain.n, arm.link_radius_m
    time_s = np.linspace(0.0, JOG_LOOK_S, JOG_LOOKS)[:, None]
    low, high = np.array([joint.limits_rad for joint in arm.joints[:n]]).T
    here = np.array(q_now[:n])
    ahead = np.clip(here + time_s * np.array(joints_rad_s[:n]), np.minimum(low, here), np.maximum(high, here))
    points = link_points(robot.chain, ahead)
    low_m = floor_clearance(points[:2], arm.floor_m, radius_m).min(axis=-1)
    if low_m[1] < low_m[0] < AT_FLOOR_M:
        raise RequestRefused("PREFLIGHT", "the arm is at the floor, and would go below it; jog another way")
    pairs = judged_pairs(points[0], radius_m)
    gap_m = link_clearance(points, pairs, radius_m)
    closing = (gap_m < np.minimum(gap_m[0], 0.0) - SAME_M).any(axis=0)
    if closing.any():
        first, second = pairs[int(closing.argmax())].tolist()
        raise RequestRefused("PREFLIGHT", f"links {first + 1} and {second + 1} would touch; jog another way")


def run_name(label: str) -> str:
    """A recording's name: what ran, and when."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
    return f"run-{re.sub('[^A-Za-z0-9._-]', '-', label)[:32]}-{stamp}Z"
