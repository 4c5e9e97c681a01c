"""Motions as clients ask for them: where a move goes, what is seen of a motion, and what it is judged by."""

from __future__ import annotations

import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.messages import JointTrajectory, Reply, TickRecord
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.collision import judged_pairs, link_clearance, link_points
from armctl.trajectory.plan import Plan, joint_trajectory, preflight
from armctl.trajectory.preflight import preflight_motion
from armctl.trajectory.straightness import max_error, mean_error
from armctl.trajectory.target import MoveRequest, joints_at_point, joints_at_pose
from armctl.trajectory.transfer import NOTED, TransferRequest, transfer_trajectory

if TYPE_CHECKING:
    from armctl.host.host import Host
    from armctl.host.lease import Client

# How far ahead of a jog collisions are looked for: heartbeat, stop and then some.
JOG_LOOK_S = 0.5
JOG_LOOKS = 11
SAME_M = 1e-6

# Makes a trajectory from where the joints are told to be, and where they are [rad]; refuses what must not be run.
Leg = Callable[[Sequence[float], Sequence[float]], JointTrajectory]


@dataclass
class Watch:
    """What is seen of the arm while it moves."""

    time_ns: list[int] = field(default_factory=list)
    positions_rad: list[tuple[float, ...]] = field(default_factory=list)
    marks_ns: dict[str, int] = field(default_factory=dict)

    def see(self, record: TickRecord) -> None:
        self.time_ns.append(record.inputs.sample.time_ns)
        self.positions_rad.append(tuple(joint.position_rad for joint in record.outputs.joints))
        for event in record.outputs.events:
            if event.code in ("PLAN_BEGIN", "PLAN_END"):
                self.marks_ns[event.code] = record.inputs.sample.time_ns


@dataclass(frozen=True)
class Done:
    """A leg that was run to its end."""

    trajectory: JointTrajectory
    watch: Watch
    reply: Reply


async def run(host: Host, client: Client, plan: Plan) -> dict[str, Any]:
    """Pre-flight, slow approach, the plan itself; recorded, and compared with the line it was made for.

    Raises:
        RequestRefused: pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """

    def make(q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        if reasons := preflight(plan, host.arm, host.robot, q_now):
            inside = all(within_limits(q, host.arm) for q in plan.waypoints_rad)
            raise RequestRefused("PREFLIGHT" if inside else "LIMIT", reasons)
        return joint_trajectory(plan, host.arm, q_now, host.period_s)

    name, [done] = await host.execute(client, "run", [make])
    return {"recording": name, **line_result(plan, done.watch, host.robot)}


async def move(host: Host, client: Client, request: MoveRequest) -> dict[str, Any]:
    """Go to a target, all joints arriving at once; recorded, and compared with the target.

    Raises:
        RequestRefused: UNREACHABLE, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """

    def make(q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        return move_trajectory(request, q_now, host.arm, host.robot, host.period_s)

    name, [done] = await host.execute(client, "move", [make])
    return {"recording": name, **move_result(done, host.robot)}


async def transfer(host: Host, client: Client, request: TransferRequest) -> dict[str, Any]:
    """Approach slowly, run a pick-and-transfer cycle, record it; the recording says itself what the cycle was.

    Raises:
        RequestRefused: UNREACHABLE, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """

    def make(q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        return transfer_trajectory(request, q_now, host.arm, host.robot, host.period_s)

    name, [done] = await host.execute(client, "transfer", [make], {"event": NOTED, "cycle": request.model_dump()})
    cycle_s = done.trajectory.end_s - done.trajectory.begin_s
    return {"recording": name, **move_result(done, host.robot), "cycle_s": cycle_s}


def move_trajectory(
    request: MoveRequest, q_now: Sequence[float], arm: ArmConfig, robot: Robot, period_s: float
) -> JointTrajectory:
    """The way to a target: all joints start and arrive at once, slowly unless a duration is given.

    Raises:
        RequestRefused: no pose within the limits reaches it (UNREACHABLE), or the way there must not be gone
            (PREFLIGHT, every reason; LIMIT where the target itself lies outside the joints' limits).
    """
    try:
        if request.point_m is not None:
            goal = joints_at_point(request.point_m, q_now, arm, robot)
        elif request.pose is not None:
            goal = joints_at_pose(request.pose, q_now, arm, robot)
        else:
            goal = list(request.joints_rad or ())
    except UnreachableTarget as error:
        raise RequestRefused("UNREACHABLE", str(error)) from None
    if len(goal) != len(arm.joints):
        raise RequestRefused("LIMIT", f"{len(goal)} joint positions for {len(arm.joints)} joints")
    trajectory = approach_trajectory(q_now, goal, arm, robot, period_s, "move", request.duration_s)
    positions = np.array(trajectory.positions_rad)
    if reasons := preflight_motion(positions, period_s, arm, robot, start_rad=q_now):
        raise RequestRefused("PREFLIGHT" if within_limits(goal, arm) else "LIMIT", reasons)
    return trajectory


def within_limits(q: Sequence[float], arm: ArmConfig) -> bool:
    """Whether joint positions [rad], shape (joints,), lie within the limits."""
    return len(q) == len(arm.joints) and all(
        joint.limits_rad[0] <= position <= joint.limits_rad[1] for position, joint in zip(q, arm.joints, strict=True)
    )


def move_result(done: Done, robot: Robot) -> dict[str, Any]:
    """How far from its target the tool came to rest, by the encoders."""
    n = robot.chain.n
    target_rad, joints_rad = done.trajectory.positions_rad[-1], done.watch.positions_rad[-1]
    wanted, reached = np.array([target_rad[:n], joints_rad[:n]])
    place = tool_position(robot.chain, reached)
    return {
        "position_error_mm": 1e3 * float(np.linalg.norm(place - tool_position(robot.chain, wanted))),
        "position_m": place.tolist(),
        "joints_rad": list(joints_rad),
        "target_rad": list(target_rad),
        "duration_s": done.trajectory.duration_s,
    }


def line_result(plan: Plan, watch: Watch, robot: Robot) -> dict[str, Any]:
    """The executed path against the plan's line (Raharjo et al. eqs. 19, 20).

    Raises:
        RequestRefused: code RECORDS_LOST, the run's beginning or end was not seen.
    """
    if len(watch.marks_ns) < 2:
        raise RequestRefused("RECORDS_LOST", "the run ended, but its beginning or end was lost; see its recording")
    begin_ns, end_ns = watch.marks_ns["PLAN_BEGIN"], watch.marks_ns["PLAN_END"]
    time_ns = np.array(watch.time_ns)
    q = np.array(watch.positions_rad)[(begin_ns <= time_ns) & (time_ns <= end_ns), : robot.chain.n]
    points = tool_position(robot.chain, q)
    line = np.asarray(plan.from_m), np.asarray(plan.to_m)
    return {
        "mean_error_mm": 1e3 * float(mean_error(points, *line)),
        "max_error_mm": 1e3 * float(max_error(points, *line)),
        "duration_s": (end_ns - begin_ns) / NS_PER_S,
        "predicted_mean_error_mm": plan.predicted_mean_error_mm,
        "predicted_max_error_mm": plan.predicted_max_error_mm,
        "begin_ns": begin_ns,
        "end_ns": end_ns,
    }


def refuse_collision(q_now: Sequence[float], joints_rad_s: Sequence[float], arm: ArmConfig, robot: Robot) -> None:
    """Look where a jog of the joints leads within `JOG_LOOK_S`; links that overlap already may come apart.

    Limits and floor are the control step's; here it is the links that must not touch each other.

    Raises:
        RequestRefused: code PREFLIGHT, naming the links.
    """
    n, radius_m = robot.chain.n, arm.link_radius_m
    time_s = np.linspace(0.0, JOG_LOOK_S, JOG_LOOKS)[:, None]
    low, high = np.array([joint.limits_rad for joint in arm.joints[:n]]).T
    here = np.array(q_now[:n])
    ahead = np.clip(here + time_s * np.array(joints_rad_s[:n]), np.minimum(low, here), np.maximum(high, here))
    points = link_points(robot.chain, ahead)
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
