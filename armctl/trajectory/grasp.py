"""Reaching for a point as a hand does, and taking hold of what is there.

Rules.
1. The tool comes to the point along a straight line, slowly: from above, or along its own axis. It does not turn on
   the way, unless the joint limits leave nothing else.
2. The joint positions are the inverse kinematics' (closed form, numeric, or the genetic algorithms), taken in the order
   of least weighted travel (Bao, Liu & Zhao eq. 10); the first whose whole way passes the pre-flight is gone.
3. A gripper closes evenly until its load says that it holds something (`messages.Grip`), or until it is closed.
"""

import math
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext, suppress
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from armctl.config import Frozen, GripperConfig
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.kinematics import solution
from armctl.kinematics.chain import forward_kinematics
from armctl.kinematics.genetic import solve as genetic
from armctl.kinematics.inverse import pointing, pose_errors, refine_poses, unreachable
from armctl.kinematics.transform import FloatArray
from armctl.messages import Grip, JointTrajectory
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.bounds import Direction, Point
from armctl.trajectory.interpolate import PEAK_SPEED, QUINTIC_PEAK_SPEED, joint_path, rest_to_rest, time_law
from armctl.trajectory.preflight import Driven, preflight_motion, times_too_fast
from armctl.trajectory.target import MOST_POSTURES, SAME_RAD, aimed, postures_at, way_by

Method = Literal["closed", "numeric", "ga", "ga-improved"]
Along = Literal["above", "tool"]

# Fastest the tool goes on the straight line.
STRAIGHT_M_S = 0.05
CLOSING_RAD_S = math.radians(20.0)
# A loaded arm comes to rest within this time.
SETTLE_S = 0.4
# At so many places of the straight line the joints are computed; in between they follow a spline.
PLACES = 13
# At so many places the speeds on the straight line are computed.
LOOKS = 400
STRAIGHT_TOLERANCE_M = 1e-6
STRAIGHT_TOLERANCE_RAD = 1e-5


class ReachRequest(Frozen):
    """A point to reach for, and what the gripper does there."""

    # Where the tool point goes, in the base frame.
    point_m: Point
    gripper: Literal["stay", "grip", "let_go"] = "stay"
    # Where the tool points there; about that direction it may turn. None: anywhere.
    direction: Direction | None = None
    # Which inverse kinematics chooses the pose.
    ik: Method = "closed"
    # Seed of the methods that draw lots.
    seed: int = Field(0, ge=0, lt=2**31)
    # Length of the straight line that leads to the point.
    off_m: float = Field(0.05, ge=0.005, le=0.3)
    # Whether that line comes down from above or along the tool's axis.
    along: Along = "above"
    # Which posture at the point, of those whose whole way may be gone, the best first; None: the first.
    posture: int | None = Field(None, ge=1, le=MOST_POSTURES)

    def _check(self) -> None:
        if self.direction is not None and self.ik.startswith("ga"):
            raise ValueError(f"direction: the method {self.ik} takes none; give closed or numeric")


class GripRequest(Frozen):
    """What the gripper is to do where the tool is."""

    grip: Literal["close", "open"] = "close"


def plan_grasp(request: ReachRequest, q_now: Sequence[float], on: Driven) -> FloatArray:
    """The straight line to a point, checked as far as it is known before the arm moves.

    Args:
        q_now: Where the joints are commanded to be [rad], shape (joints,).
    Returns:
        Joint positions of the chain [rad], shape (PLACES, n): from off the point to the point.
    Raises:
        UnreachableTarget: no pose within the limits reaches the point; carries the nearest distance.
        RequestRefused: the point can be reached, but the way there must not be gone: code PREFLIGHT, every reason
            against the best solution. Code POSTURE: not so many postures may be gone to; each of them.
    """
    point = np.asarray(request.point_m, dtype=np.float64)
    if (floor_m := on.arm.floor_m) > point[2]:
        raise RequestRefused("PREFLIGHT", f"the point is {point[2]:.3f} m high, below the floor at {floor_m:.3f} m")

    def way(q: Sequence[float]) -> FloatArray:
        path_rad = _straight(np.asarray(q), point, on, request.off_m, request.along)
        straight(path_rad, approach(path_rad, q_now, on).positions_rad[-1], on)
        return path_rad

    return way_by((q.tolist() for q in _solutions(request, q_now, on)), way, request.posture)


def approach(path_rad: FloatArray, q_now: Sequence[float], on: Driven, *, opening: bool = False) -> JointTrajectory:
    """The slow motion to the beginning of the straight line, the gripper opening on the way or staying as it is.

    Raises:
        RequestRefused: code PREFLIGHT.
    """
    there = [*path_rad[0].tolist(), *q_now[on.robot.chain.n :]]
    if opening:
        index, gripper = gripper_of(on)
        there[index] = math.radians(gripper.open_deg)
    return _settled(approach_trajectory(q_now, there, on, "reach"), q_now, on)


def straight(path_rad: FloatArray, q_now: Sequence[float], on: Driven) -> JointTrajectory:
    """The straight line, or the same backwards.

    Args:
        path_rad: Joint positions of the chain [rad] along it, shape (m, n).
        q_now: Where the joints are wanted [rad], shape (joints,).
    Raises:
        RequestRefused: code PREFLIGHT.
    """
    n, joints = on.robot.chain.n, on.arm.joints[: on.robot.chain.n]
    tool_m = forward_kinematics(on.robot.chain, path_rad[[0, -1]])[:, :3, 3]
    duration_s = QUINTIC_PEAK_SPEED * float(np.linalg.norm(tool_m[1] - tool_m[0])) / STRAIGHT_M_S
    knots = np.linspace(0.0, 1.0, len(path_rad))
    low, high = np.array([joint.limits_rad for joint in joints]).T

    def rows(count: int) -> FloatArray:
        place = rest_to_rest(np.zeros(1), np.ones(1), np.arange(count + 1) / count)[:, 0]
        return np.asarray(np.clip(joint_path(path_rad, knots, place, "cubic"), low, high))

    slower = max(1.0, times_too_fast(rows(LOOKS), duration_s / LOOKS, joints))
    chain = rows(max(1, math.ceil(duration_s * slower / on.period_s)))
    positions = np.concatenate((chain, np.tile(np.asarray(q_now[n:]), (len(chain), 1))), axis=1)
    return _settled(_trajectory(positions, on.period_s, "straight"), q_now, on)


def gripping(q_now: Sequence[float], on: Driven, *, closing: bool) -> JointTrajectory:
    """The gripper closes until its load says that it holds something, or opens; evenly, the other joints stay.

    Raises:
        RequestRefused: code NO_GRIPPER or PREFLIGHT.
    """
    index, gripper = gripper_of(on)
    way_rad = math.radians(gripper.closed_deg if closing else gripper.open_deg) - q_now[index]
    speed_rad_s = min(CLOSING_RAD_S, on.arm.joints[index].speed_limit_rad_s)
    rows = max(1, math.ceil(PEAK_SPEED * abs(way_rad) / speed_rad_s / on.period_s))
    positions = np.tile(np.asarray(q_now, dtype=np.float64), (rows + 1, 1))
    positions[:, index] += way_rad * time_law(np.arange(rows + 1) / rows)
    trajectory = _settled(_trajectory(positions, on.period_s, "grip" if closing else "let go"), q_now, on)
    return replace(trajectory, grip=Grip(index, gripper.load_ratio)) if closing else trajectory


def gripper_of(on: Driven) -> tuple[int, GripperConfig]:
    """Index and settings of the joint that grips.

    Raises:
        RequestRefused: code NO_GRIPPER, the arm has none, or it is a joint that moves the tool point.
    """
    arm, robot = on.arm, on.robot
    if arm.gripper is None:
        others = ", ".join(arm.joint_names[robot.chain.n :]) or "none"
        why = f"its calibration has no key gripper (joints that move no tool point: {others})"
        raise RequestRefused("NO_GRIPPER", f"arm {arm.arm_id} has no gripper: {why}; `armctl arms` says which have one")
    index = arm.joint_names.index(arm.gripper.joint)
    if index < robot.chain.n:
        raise RequestRefused("NO_GRIPPER", f"joint {arm.gripper.joint} moves the tool point; it cannot be the gripper")
    return index, arm.gripper


def _solutions(request: ReachRequest, q_now: Sequence[float], on: Driven) -> Iterator[FloatArray]:
    """Joint positions of the chain [rad] within the limits that reach the point, best first; at least one."""
    n = on.robot.chain.n
    bounded = replace(on.robot, ranges_deg=tuple(joint.limits_deg for joint in on.arm.joints[:n]))
    target, present = aimed(request.point_m, request.direction), np.asarray(q_now[:n])
    solve: Callable[..., solution.Answer] = genetic.solve if request.ik.startswith("ga") else solution.solve
    answer = solve(bounded, target, method=request.ik, present=present, seed=request.seed)
    if not answer.reachable and answer.least_position_error_m > 0.0:
        raise unreachable(target.position_m, answer.least_position_error_m)
    found = [
        np.array(one.q_rad)
        for one in answer.solutions
        if one.within_limits and one.position_error_m <= solution.REACHED_M and (answer.reachable or not target.turned)
    ]
    yield from found
    # Where none of these will do, another member of a family may.
    with suppress(UnreachableTarget) if found else nullcontext():
        for q in (np.array(one[:n]) for one in postures_at(target, q_now, on)):
            if all(np.abs(q - one).max() >= SAME_RAD for one in found):
                yield q


def _straight(q: FloatArray, point: FloatArray, on: Driven, off_m: float, along: Along) -> FloatArray:
    """Joint positions [rad] on the straight line that ends at q, shape (PLACES, n)."""
    chain = on.robot.chain
    limits = np.array([joint.limits_rad for joint in on.arm.joints[: chain.n]])
    T = np.repeat(forward_kinematics(chain, q)[None], PLACES, axis=0)
    back = np.array([0.0, 0.0, 1.0]) if along == "above" else -T[0, :3, :3] @ pointing(chain)
    T[:, :3, 3] = point + np.linspace(0.0, off_m, PLACES)[:, None] * back
    reached_m = 0.0
    for turned in (True, False):
        path = [q]
        for pose in T[1:]:
            path.append(refine_poses(chain, pose[None], path[-1][None], limits, turned=turned)[0])
        away_m, turned_rad = pose_errors(chain, np.array(path), T)
        off_it = (away_m > STRAIGHT_TOLERANCE_M) | (turned & (turned_rad > STRAIGHT_TOLERANCE_RAD))
        if not off_it.any():
            return np.array(path[::-1])
        reached_m = max(reached_m, off_m * (int(off_it.argmax()) - 1) / (PLACES - 1))
    far = f"the tool can back off from the point by {1000.0 * reached_m:.0f} mm, not by {1000.0 * off_m:.0f}"
    remedy = "shorten the straight way, or come another way"
    raise RequestRefused("PREFLIGHT", f"within the joint limits {far}; {remedy}")


def _trajectory(positions_rad: FloatArray, period_s: float, label: str) -> JointTrajectory:
    return JointTrajectory(period_s, tuple(map(tuple, positions_rad.tolist())), label=label)


def _settled(trajectory: JointTrajectory, q_now: Sequence[float], on: Driven) -> JointTrajectory:
    """The trajectory with time to come to rest at its end, if it may be run."""
    rows = trajectory.positions_rad + trajectory.positions_rad[-1:] * math.ceil(SETTLE_S / on.period_s)
    if reasons := preflight_motion(np.array(rows), on, start_rad=q_now):
        raise RequestRefused("PREFLIGHT", reasons)
    return replace(trajectory, positions_rad=rows)
