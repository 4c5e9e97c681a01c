"""A plan that is being worked out: where its waypoints are, and what the arm is expected to do along it.

Rules.
1. What a joint stays off its goal is its lag: goal of the plan less position, a function of time along one plan. The
   control step corrects what it foresees; runs show what that leaves (`refinement`).
2. A plan is placed as a whole: its waypoints are such that the motion less the lag is straight (`placement`), as near
   as can be to where they were. With a waypoint every tick that is a stream; with n via points the motion stays the
   interpolation of n via points.
3. Goals go to the nearest whole tick, each joint by itself. Choosing every tick's goals together, among the 2^n
   neighbours, so that the tool is nearest to the line is 5 times better on paper. It does not pay on servos with
   friction, which jump to a goal that goes to and fro, or do not follow it (12 arms by their true tools, with only such
   choices as turn no joint back: first run 9 % worse, outcome 5 % better in the mean but on 7 of the 12 only; with any:
   worse).
4. Nothing here knows where the tool really is, unless somebody measured it.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.placement import Objective, StraightMotion, place
from armctl.trajectory.plan import Plan, plan_positions, plan_through
from armctl.trajectory.preflight import Driven
from armctl.trajectory.straightness import errors_mm

# Kept free before each joint limit: a curve through waypoints swings a little further than they do.
SWING_RAD = np.radians(2.0)


class Line(NamedTuple):
    """The motion that is wanted: from A to B [m] in a straight line."""

    A: FloatArray
    B: FloatArray
    duration_s: float
    # Which measure of the distance from the line is made small.
    objective: Objective = "mix"
    # Where the tool was seen from outside, less where the encoders have it, at even times from begin to end [m], shape
    # (k, 3); None: nobody looked.
    unseen_m: FloatArray | None = None

    def errors_mm(self, tool_m: FloatArray) -> tuple[float, float]:
        """Mean and largest distance of tool points, shape (m, 3), from the line [mm]."""
        return errors_mm(tool_m, self.A, self.B)


class Course(NamedTuple):
    """A plan that is being worked out: its unrounded waypoints, and what the arm is expected to do along it.

    All on the grid of the arm's ticks from the plan's begin to its end, m = duration / period + 1 rows.
    """

    line: Line
    kind: Interpolation
    stream: bool
    # [rad], shape (k, n).
    waypoints: FloatArray
    knots: FloatArray
    # Goal of the plan less position, as far as it was measured; shape (m, n).
    lag_rad: FloatArray
    # The line's `unseen_m`, shape (m, 3).
    offset_m: FloatArray
    # Joints beyond the chain, such as a gripper, have no part in the line [rad], shape (k, joints - n).
    beyond_rad: FloatArray

    @property
    def goals_rad(self) -> FloatArray:
        return joint_path(self.waypoints, self.knots, progress_of_ticks(len(self.lag_rad)), self.kind)

    @property
    def expected_rad(self) -> FloatArray:
        """Where the joints are expected."""
        return self.goals_rad - self.lag_rad


def progress_of_ticks(m: int) -> FloatArray:
    """Progress along the line at each of m ticks, exactly 0 at the first and 1 at the last."""
    return time_law(np.linspace(0.0, 1.0, m))


def ticks_of(duration_s: float, period_s: float) -> int:
    """How many ticks see the motion, both ends included."""
    return max(3, round(duration_s / period_s) + 1)


def placed(on: Driven, course: Course, *, move_knots: bool = False, held: FloatArray | None = None) -> Course:
    """The course with its waypoints where the motion less the lag is straight.

    Args:
        move_knots: Whether the waypoints' places along the line are free as well.
        held: Which joints stay as they are, as weights from 0 to 1, shape (n,).
    """
    line, chain = course.line, on.robot.chain
    limits: FloatArray = np.array([joint.limits_rad for joint in on.arm.joints[: chain.n]])
    inside, objective = limits + np.array([SWING_RAD, -SWING_RAD]), "mix" if course.stream else line.objective
    motion = StraightMotion(chain, course.kind, line.A, line.B, inside, course.lag_rad, course.offset_m, objective)
    placement = place(motion, course.waypoints, course.knots, held=held, move_knots=move_knots)
    return course._replace(waypoints=placement.waypoints, knots=placement.knots)


def plan_of(on: Driven, course: Course, seed: int) -> Plan:
    """The course as a plan for the daemon; its prediction is where the arm is expected, without rounding to ticks."""
    line = course.line
    points = tool_position(on.robot.chain, course.expected_rad) + course.offset_m
    waypoints = np.concatenate([course.waypoints, course.beyond_rad], axis=1)
    ends_m = {"from_m": tuple(line.A.tolist()), "to_m": tuple(line.B.tolist())}
    how = {"duration_s": line.duration_s, "interpolation": course.kind, "seed": seed}
    return plan_through(on.arm, waypoints, course.knots, line.errors_mm(points), **ends_m, **how)


def course_of(on: Driven, plan: Plan) -> Course:
    """The course of a plan that nobody has run yet; `plan_of` makes the same plan of it."""
    n, ticks = on.robot.chain.n, ticks_of(plan.duration_s, on.period_s)
    line = Line(np.array(plan.from_m), np.array(plan.to_m), plan.duration_s)
    waypoints = np.array(plan.waypoints_rad)
    knots, none = np.array(plan.waypoint_progress), np.zeros((ticks, n))
    kind, stream = plan.interpolation, len(knots) == ticks
    return Course(line, kind, stream, waypoints[:, :n], knots, none, np.zeros((ticks, 3)), waypoints[:, n:])


def bent(on: Driven, plan: Plan, point: int, to_m: Sequence[float]) -> Plan:
    """The plan with one via point elsewhere, by the posture nearest to its own.

    Args:
        point: Which via point, from 1 to `plan.via`.
        to_m: Where the tool is to be there [m], shape (3,).
    Raises:
        RequestRefused: the plan has no such via point.
        UnreachableTarget: the tool cannot be there within the joint limits.
    """
    if point > plan.via:
        raise RequestRefused("POINT", f"the plan has no intermediate point {point}; it has {plan.via}")
    course, chain = course_of(on, plan), on.robot.chain
    limits: FloatArray = np.array([joint.limits_rad for joint in on.arm.joints[: chain.n]])
    waypoints = course.waypoints.copy()
    waypoints[point] = solve_position(chain, np.array(to_m), waypoints[point], limits)
    return plan_of(on, course._replace(waypoints=waypoints), plan.seed)


def sent_rad(arm: ArmConfig, goals_rad: FloatArray) -> FloatArray:
    """What the servos are really sent: goals in whole ticks, as angles [rad], shape (m, joints)."""
    columns = zip(arm.joints, goals_rad.T, strict=False)
    return np.array([[joint.position_rad(round(joint.tick(x))) for x in goals] for joint, goals in columns]).T


def plan_goals_rad(on: Driven, plan: Plan) -> FloatArray:
    """What the servos are sent at every tick of the plan [rad], shape (m, n)."""
    ticks = np.arange(ticks_of(plan.duration_s, on.period_s))
    return sent_rad(on.arm, plan_positions(plan, ticks * np.float64(on.period_s))[:, : on.robot.chain.n])
