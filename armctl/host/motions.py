"""Motions as clients ask for them: run, path, play, move and transfer, where they go and what they are judged by."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.host.host import Host
from armctl.host.lease import Client
from armctl.host.watch import Done, Leg
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.target import Target
from armctl.kinematics.transform import pose_from_xyz_rpy
from armctl.messages import JointTrajectory
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.path_motion import PathMotion, path_motion
from armctl.trajectory.plan import Plan, joint_trajectory, preflight
from armctl.trajectory.playback import PlayRequest, TaughtMotion, playback
from armctl.trajectory.preflight import Driven, preflight_motion
from armctl.trajectory.reference import ReferencePath, error_mm
from armctl.trajectory.target import MoveRequest, aimed, postures_at, way_by
from armctl.trajectory.tool_path import PathRequest
from armctl.trajectory.transfer import NOTED, TransferRequest, transfer_trajectory


async def run(host: Host, client: Client, plan: Plan, *, corrected: bool = True) -> dict[str, Any]:
    """Pre-flight, slow approach, the plan itself; recorded, and compared with the line it was made for.

    Raises:
        RequestRefused: pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    legs = [run_leg(host, plan, corrected=corrected)]
    name, [done] = await host.execute(client, "run", legs, plan_note(plan, corrected=corrected))
    return {"recording": name, **line_result(plan, done, host.robot)}


def plan_note(plan: Plan, *, corrected: bool) -> dict[str, Any]:
    """What the recording of a run says of its plan."""
    return {"event": "PLAN", "plan": plan.model_dump(mode="json"), "corrected": corrected}


def run_leg(host: Host, plan: Plan, *, corrected: bool) -> Leg:
    """The motion of a run; refused by pre-flight with every reason."""

    def make(q_now: Sequence[float]) -> JointTrajectory:
        if reasons := preflight(plan, host, q_now):
            inside = all(within_limits(q, host.arm) for q in plan.waypoints_rad)
            raise RequestRefused("PREFLIGHT" if inside else "LIMIT", reasons)
        return replace(joint_trajectory(plan, host, q_now), corrected=corrected)

    return make


async def path(host: Host, client: Client, request: PathRequest) -> dict[str, Any]:
    """Approach slowly and lead the tool along a path; recorded, and compared with the path as it was asked for.

    Raises:
        RequestRefused: PATH, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    leg, made = path_leg(host, request)
    name, [done] = await host.execute(client, "path", [leg], path_note(request))
    return {"recording": name, **path_result(made, host.robot, done)}


def path_note(request: PathRequest) -> dict[str, Any]:
    """What the recording of a path says of it."""
    return {"event": "PATH", **request.model_dump(exclude_none=True)}


def path_leg(host: Host, request: PathRequest) -> tuple[Leg, list[PathMotion]]:
    """The motion along a path, and where it puts what it has made."""
    made: list[PathMotion] = []

    def make(q_now: Sequence[float]) -> JointTrajectory:
        made.append(path_motion(request, q_now, host))
        return made[-1].trajectory

    return make, made


def path_result(made: Sequence[PathMotion], robot: Robot, done: Done) -> dict[str, Any]:
    """The executed path, made last, against the one that was asked for; raises as `followed`."""
    predicted = {f"predicted_{key}": value for key, value in error_mm(made[-1].rounding_m).items()}
    return {**followed([done], made[-1].reference, robot), **predicted}


async def play(host: Host, client: Client, motion: Callable[[], TaughtMotion], request: PlayRequest) -> dict[str, Any]:
    """Approach slowly and move as was taught, as often as asked for; recorded, and compared with the taught path.

    Raises:
        RequestRefused: FOREIGN_LOG, JOINTS, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    played = cache(lambda: playback(motion(), request.rate, host))
    legs: list[Leg] = [lambda q_now: played().trajectory(q_now)] * request.repeat
    note = {"event": "PLAY", "name": request.name, "rate": request.rate, "repeat": request.repeat}
    name, done = await host.execute(client, "play", legs, note)
    reference = played().reference
    off = {f"path_{key}": value for key, value in followed(done, reference, host.robot).items() if "error" in key}
    return {"recording": name, **followed(done, reference, host.robot, at_equal_progress=True), **off}


async def move(host: Host, client: Client, request: MoveRequest) -> dict[str, Any]:
    """Go to a target, all joints arriving at once; recorded, and compared with the target.

    Raises:
        RequestRefused: UNREACHABLE, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    name, [done] = await host.execute(client, "move", [lambda q_now: move_trajectory(request, q_now, host)])
    return {"recording": name, **move_result(done, host.robot)}


async def transfer(host: Host, client: Client, request: TransferRequest) -> dict[str, Any]:
    """Approach slowly, run a pick-and-transfer cycle, record it; the recording says itself what the cycle was.

    Raises:
        RequestRefused: UNREACHABLE, pre-flight (every reason), BUSY, stopped or failed on the way.
        LogError: the recording cannot be made.
    """
    legs: list[Leg] = [lambda q_now: transfer_trajectory(request, q_now, host)]
    name, [done] = await host.execute(client, "transfer", legs, {"event": NOTED, "cycle": request.model_dump()})
    cycle_s = done.trajectory.end_s - done.trajectory.begin_s
    return {"recording": name, **move_result(done, host.robot), "cycle_s": cycle_s}


def move_trajectory(request: MoveRequest, q_now: Sequence[float], on: Driven) -> JointTrajectory:
    """The way to a target: all joints start and arrive at once, slowly unless a duration is given.

    Of the postures that reach it the nearest is taken whose whole motion may be gone, or the one that was asked for.

    Raises:
        UnreachableTarget: no pose within the limits reaches it.
        RequestRefused: the way there must not be gone (PREFLIGHT, every reason against the nearest posture; LIMIT
            where the target itself lies outside the joints' limits), or there are not so many postures (POSTURE, each
            of them).
    """
    if request.point_m is not None:
        goals = postures_at(aimed(request.point_m, request.direction), q_now, on, nearest=True)
    elif request.pose is not None:
        goals = postures_at(Target(pose_from_xyz_rpy(*request.pose), turned=True), q_now, on, nearest=True)
    else:
        goals = [list(request.joints_rad or ())]
    if len(goals[0]) != len(on.arm.joints):
        raise RequestRefused("LIMIT", f"{len(goals[0])} joint positions for {len(on.arm.joints)} joints")

    def way(goal: Sequence[float]) -> JointTrajectory:
        trajectory = approach_trajectory(q_now, goal, on, "move", request.duration_s)
        if reasons := preflight_motion(np.array(trajectory.positions_rad), on, start_rad=q_now):
            raise RequestRefused("PREFLIGHT" if within_limits(goal, on.arm) else "LIMIT", reasons)
        return trajectory

    return way_by(goals, way, request.posture)


def within_limits(q: Sequence[float], arm: ArmConfig) -> bool:
    """Whether joint positions [rad], shape (joints,), lie within the limits."""
    limits_rad = [joint.limits_rad for joint in arm.joints]
    return len(q) == len(limits_rad) and all(low <= at <= high for at, (low, high) in zip(q, limits_rad, strict=True))


def move_result(done: Done, robot: Robot) -> dict[str, Any]:
    """How far from its target the tool came to rest, by the encoders."""
    target_rad, joints_rad = done.trajectory.positions_rad[-1], done.watch.positions_rad[-1]
    wanted, reached = np.array([target_rad[: robot.chain.n], joints_rad[: robot.chain.n]])
    place = tool_position(robot.chain, reached)
    return {
        "position_error_mm": 1e3 * float(np.linalg.norm(place - tool_position(robot.chain, wanted))),
        "position_m": place.tolist(),
        "joints_rad": list(joints_rad),
        "target_rad": list(target_rad),
        "duration_s": done.trajectory.duration_s,
        "corrections": done.watch.corrections,
    }


def line_result(plan: Plan, done: Done, robot: Robot) -> dict[str, Any]:
    """The executed path against the plan's line (Raharjo et al. eqs. 19, 20); raises as `followed`."""
    predicted = plan.model_dump(include={"predicted_mean_error_mm", "predicted_max_error_mm"})
    return followed([done], ReferencePath.line(np.array(plan.from_m), np.array(plan.to_m)), robot) | predicted


def followed(
    done: Sequence[Done], reference: ReferencePath, robot: Robot, *, at_equal_progress: bool = False
) -> dict[str, Any]:
    """The tool's executed path against the one it was to follow, by the encoders; of several legs all together.

    Args:
        at_equal_progress: Whether to be early or late counts; if not, only the distance from the path does.

    Raises:
        RequestRefused: code RECORDS_LOST, a leg's beginning or end was not seen.
    """
    distances, marks_ns = [], []
    for leg in done:
        watch, way = leg.watch, leg.trajectory
        if len(watch.marks_ns) < 2:
            raise RequestRefused("RECORDS_LOST", "the run ended, but its beginning or end was lost; see its recording")
        begin_ns, end_ns = watch.marks_ns["PLAN_BEGIN"], watch.marks_ns["PLAN_END"]
        time_ns = np.array(watch.time_ns)
        inside = (begin_ns <= time_ns) & (time_ns <= end_ns)
        points = tool_position(robot.chain, np.array(watch.positions_rad)[inside, : robot.chain.n])
        due_s = np.array(watch.progress)[inside] * way.duration_s - way.begin_s
        progress = np.clip(due_s / (way.end_s - way.begin_s), 0.0, 1.0)
        distances.append((reference.apart_m if at_equal_progress else reference.off_m)(points, progress))
        marks_ns.append((begin_ns, end_ns))
    return {
        **error_mm(np.concatenate(distances)),
        "duration_s": sum(end_ns - begin_ns for begin_ns, end_ns in marks_ns) / NS_PER_S,
        "begin_ns": marks_ns[0][0],
        "end_ns": marks_ns[-1][1],
    }
