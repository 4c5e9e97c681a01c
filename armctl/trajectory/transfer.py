"""The cycle of a transfer robot: down to one station, up, across to the other, down, up, and back (Lu & Liu, 3).

Rules.
1. The paw points straight down, as a tool that reaches does. Where that is the z axis of its frame, as in the paper,
   the x axis leads away from the base or towards it if it can; else it is turned as is nearest. All lifts are straight
   and vertical: quintics in the joints through `LIFT_PIECES` + 1 places of inverse kinematics, which pass each place
   with the velocity and acceleration that the Jacobian gives them there.
2. Across, all joints go by one quintic from rest to rest.
3. The paper prints curves and no motion: stations, height and times are whatever is asked for, link lengths the arm's.
4. Of the poses over both stations those two are taken between which the joints travel least; on its way down the paw
   keeps its rotation where the arm can, and no joint goes far between two places.
"""

import math
from collections.abc import Sequence
from itertools import pairwise, product
from typing import NamedTuple

import numpy as np
from pydantic import Field

from armctl.config import ArmConfig, Frozen
from armctl.errors import RequestRefused
from armctl.kinematics import solution
from armctl.kinematics.chain import forward_kinematics, jacobian, joint_axes
from armctl.kinematics.differential import jacobian_rate, joint_rates
from armctl.kinematics.inverse import pointing
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.target import pose_target
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S, JointTrajectory
from armctl.trajectory.approach import approach_duration_s
from armctl.trajectory.bounds import Point
from armctl.trajectory.plan import approached
from armctl.trajectory.preflight import Driven, preflight_motion
from armctl.trajectory.quintic import Quintic, quintic
from armctl.trajectory.target import aimed

# Event under which a log holds the parameters of the cycle that it records.
NOTED = "TRANSFER"
LIFT_PIECES = 4
# No joint turns so far between two places of a lift unless the arm changes into another pose.
JUMP_RAD = math.radians(60.0)
# Kept free at each joint limit: between two places of a lift joints swing out a little.
ROOM_RAD = math.radians(1.0)
DOWN = (0.0, 0.0, -1.0)


class TransferRequest(Frozen):
    """A pick-and-transfer cycle between two stations."""

    pick_m: Point
    place_m: Point
    # How high the tool lifts over each station.
    height_m: float = Field(0.06, ge=0.005, le=0.5)
    # Time of each way down and each way up.
    lift_s: float = Field(2.0, gt=0.0, le=60.0)
    # Time of each way across.
    carry_s: float = Field(4.0, gt=0.0, le=60.0)
    # Time at each station.
    dwell_s: float = Field(0.5, ge=0.0, le=60.0)
    cycles: int = Field(1, ge=1, le=20)

    def _check(self) -> None:
        whole_s = self.cycles * (4.0 * self.lift_s + 2.0 * self.carry_s + 2.0 * self.dwell_s)
        if whole_s > LONGEST_S:
            raise ValueError(f"{whole_s:.1f} s in all, at most {LONGEST_S:g} s; ask for fewer cycles, or quicker ones")


class Motion(NamedTuple):
    """Quintics one after the other: the cycle as the model has it."""

    pieces: tuple[Quintic, ...]

    @property
    def duration_s(self) -> float:
        return sum(piece.duration_s for piece in self.pieces)

    def sample(self, time_s: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Position [rad], velocity [rad/s] and acceleration [rad/s^2] of the chain at times [s], each (m, n)."""
        begins = np.concatenate([[0.0], np.cumsum([piece.duration_s for piece in self.pieces])])
        which = np.clip(np.searchsorted(begins, time_s, side="right") - 1, 0, len(self.pieces) - 1)
        curves = np.empty((3, len(time_s), self.pieces[0].coefficients.shape[1]))
        for index in np.unique(which):
            at = which == index
            curves[:, at] = self.pieces[index].sample(time_s[at] - begins[index])
        return curves[0], curves[1], curves[2]


def motion(cycle: TransferRequest, arm: ArmConfig, robot: Robot) -> Motion:
    """The whole of the cycle, which begins and ends over the first station.

    Raises:
        RequestRefused: code UNREACHABLE, a place that the paw cannot take within the limits, with the distance.
    """
    joints = arm.joints[: robot.chain.n]
    rest = np.array([joint.rest_rad for joint in joints])
    limits = np.array([joint.limits_rad for joint in joints]) + np.array([ROOM_RAD, -ROOM_RAD])
    both = list[list[list[Quintic]]]()
    for station in (cycle.pick_m, cycle.place_m):
        lifts, refused = list[list[Quintic]](), list[RequestRefused]()
        for over in _paw_down(np.add(station, (0.0, 0.0, cycle.height_m)), rest, limits, robot):
            try:
                lifts.append(_lift(np.array(station), over, cycle, limits, robot))
            except RequestRefused as reason:
                refused.append(reason)
        if not lifts:
            raise refused[0]
        both.append(lifts)
    # A piece begins at the first of its coefficients.
    pick, place = min(
        product(*both), key=lambda pair: np.ptp([lift[0].coefficients[0] for lift in pair], axis=0).max().round(9)
    )
    over_pick, over_place = (lift[0].coefficients[0] for lift in (pick, place))
    there, back = (quintic(*ends, cycle.carry_s) for ends in ((over_pick, over_place), (over_place, over_pick)))
    return Motion((*_down_and_up(pick, cycle), there, *_down_and_up(place, cycle), back) * cycle.cycles)


def transfer_trajectory(cycle: TransferRequest, q_now: Sequence[float], on: Driven) -> JointTrajectory:
    """Slow approach, dwell, the cycle in [begin_s, end_s], settle; joints beyond the chain stay.

    Raises:
        RequestRefused: code UNREACHABLE, or PREFLIGHT with every reason.
    """
    n, model = on.robot.chain.n, motion(cycle, on.arm, on.robot)
    q0 = np.asarray(q_now, dtype=np.float64)
    start = np.concatenate([model.sample(np.zeros(1))[0][0], q0[n:]])
    approach_s = approach_duration_s(q0, start, on)

    def positions(time_s: FloatArray) -> FloatArray:
        return np.concatenate([model.sample(time_s)[0], np.tile(q0[n:], (len(time_s), 1))], axis=1)

    trajectory = approached([(q0, start, approach_s)], positions, model.duration_s, on.period_s, "transfer")
    if reasons := preflight_motion(np.array(trajectory.positions_rad), on, start_rad=q_now):
        raise RequestRefused("PREFLIGHT", reasons)
    return trajectory


def _down_and_up(lift: list[Quintic], cycle: TransferRequest) -> list[Quintic]:
    """Down, dwell, and up the same way, backwards in time."""
    bottom = lift[-1].sample(np.array([lift[-1].duration_s]))[0][0]
    dwell = [quintic(bottom, bottom, cycle.dwell_s)] if cycle.dwell_s else []
    return [*lift, *dwell, *map(_reversed, lift[::-1])]


def _reversed(piece: Quintic) -> Quintic:
    """The same joints backwards: the coefficients of c(1 - tau)."""
    powers = [[math.comb(k, j) * (-1.0) ** j for k in range(6)] for j in range(6)]
    return Quintic(np.array(powers) @ piece.coefficients, piece.duration_s)


def _lift(
    station_m: FloatArray, near: FloatArray, cycle: TransferRequest, limits: FloatArray, robot: Robot
) -> list[Quintic]:
    """From a pose over a station straight down onto it."""
    down = quintic(station_m + np.array([0.0, 0.0, cycle.height_m]), station_m, cycle.lift_s)
    ends: list[tuple[FloatArray, FloatArray, FloatArray]] = []
    for place, speed, change in zip(*down.sample(np.linspace(0.0, cycle.lift_s, LIFT_PIECES + 1)), strict=True):
        T = forward_kinematics(robot.chain, near)
        T[:3, 3] = x, y, z = place.tolist()
        for target in (pose_target(T), aimed((x, y, z), DOWN)):
            q = solution.refine(robot, target, near[None], limits)
            if solution.errors_of(robot, target, q)[2][0] and np.abs(q[0] - near).max() <= JUMP_RAD:
                break
        else:
            why = f"on its way down the arm would have to change its pose at ({x:.3f}, {y:.3f}, {z:.3f}) m"
            raise RequestRefused("UNREACHABLE", f"{why}: move the station, or lower the height")
        near = q[0]
        J, still = jacobian(robot.chain, near), np.zeros(3)  # it does not turn
        q_rate = joint_rates(J, np.append(speed, still))
        change = np.append(change, still) - jacobian_rate(robot.chain, near, q_rate) @ q_rate
        ends.append((near, q_rate, joint_rates(J, change)))
    duration_s = cycle.lift_s / LIFT_PIECES
    return [quintic(q0, q1, duration_s, v0=v0, v1=v1, a0=a0, a1=a1) for (q0, v0, a0), (q1, v1, a1) in pairwise(ends)]


def _paw_down(point: FloatArray, near: FloatArray, limits: FloatArray, robot: Robot) -> list[FloatArray]:
    """Joint positions [rad] within the limits that put the paw there, pointing down; those nearest to `near` first.

    Raises:
        RequestRefused: code UNREACHABLE, there are none.
    """
    x, y, z = point.tolist()
    out = point[:2] - joint_axes(robot.chain, np.zeros((1, robot.chain.n)))[0][0][1][:2, 0]
    c, s = (out / max(math.hypot(*out), 1e-9)).tolist()
    turns = ((c, s), (-c, -s)) if pointing(robot.chain)[2] > 1.0 - 1e-9 else ()
    radial = [np.array([[c, s, 0.0, x], [s, -c, 0.0, y], [0.0, 0.0, -1.0, z], [0.0, 0.0, 0.0, 1.0]]) for c, s in turns]
    found: list[FloatArray] = []
    for targets in ([pose_target(T) for T in radial], [aimed((x, y, z), DOWN)]):
        for target in () if found else targets:
            answer = solution.solve(robot, target, present=near, limits=limits)
            found += [np.array(one.q_rad) for one in answer.solutions if answer.reachable and one.within_limits]
    if found:
        return sorted(found, key=lambda q: float(solution.weighted_travel(q, near, limits)))
    near_m = answer.least_position_error_m
    why = f"the nearest place is {1e3 * near_m:.1f} mm off; move the station"
    if answer.reachable or near_m < solution.REACHED_M:
        why = "only outside the joint limits; move the station"
    raise RequestRefused("UNREACHABLE", f"the paw cannot point down at ({x:.3f}, {y:.3f}, {z:.3f}) m: {why}")
