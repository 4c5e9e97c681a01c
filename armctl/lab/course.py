"""The way along a line that an arm is sent: chosen among many, its via points placed where the lagging arm is straight.

Rules.
1. What a joint stays off its goal is its lag: goal of the plan less position, a function of time along one plan. The
   control step corrects what it foresees; runs show what that leaves (`correction`).
2. A plan is placed as a whole: its waypoints are such that the motion less the lag is straight
   (`trajectory/placement.py`), as near as can be to where they were. With a waypoint every tick that is a stream.
3. Goals go to the nearest whole tick, each joint by itself. Choosing every tick's goals together, among the 2^n
   neighbours, so that the tool is nearest to the line is 5 times better on paper. It does not pay on servos with
   friction, which jump to a goal that goes to and fro, or do not follow it (12 arms by their true tools, with only such
   choices as turn no joint back: first run 9 % worse, outcome 5 % better in the mean but on 7 of the 12 only; with any:
   worse).
4. Nothing here knows where the tool really is, unless somebody measured it.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import plan_through
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.rig import Rig
from armctl.messages import LagModel
from armctl.trajectory import lag
from armctl.trajectory.interpolate import Interpolation, columns_at, joint_path, time_law
from armctl.trajectory.line_path import sensitivity_m
from armctl.trajectory.placement import Objective, StraightMotion, place
from armctl.trajectory.plan import Plan, joint_trajectory, plan_positions
from armctl.trajectory.straightness import distance_to_line, max_error, mean_error

# How many via points; auto: as few as will do; stream: a goal every tick.
Via = int | Literal["auto", "stream"]

# How many ways along the line are considered at all, placed as via points, and offered to the arm.
DRAWN_WAYS, PLACED_WAYS, TRIED_WAYS = 400, 32, 30
# What a servo is off after correction, one with another.
SERVO_ERROR_RAD = 0.3 * TICK_RAD
# Largest lag of a plan that may run: a larger one is near to where the daemon takes a joint for blocked.
HEAVIEST_RAD = np.radians(7.0)
UNKNOWN_HEAVIEST_RAD = np.radians(5.0)
# How much more than it bears where it stands an arm may bear on its way from there.
LEAVING = 1.1
# Kept free before each joint limit: a curve through waypoints swings a little further than they do.
SWING_RAD = np.radians(2.0)


@dataclass(frozen=True, eq=False)
class Line:
    """The motion that is wanted: from A to B [m] in a straight line."""

    A: FloatArray
    B: FloatArray
    duration_s: float
    # Which measure of the distance from the line is made small.
    objective: Objective = "mix"
    # Where the tool was seen from outside, less where the encoders have it, at even times from begin to end [m], shape
    # (k, 3); None: nobody looked.
    unseen_m: FloatArray | None = None

    def request(self, seed: int, **more: Any) -> OptimizeRequest:
        """The line as the optimiser's request, with more of its fields."""
        asked: dict[str, Any] = {"via": (), "objective": self.objective, **more}
        from_m, to_m = tuple(self.A.tolist()), tuple(self.B.tolist())
        return OptimizeRequest(from_m=from_m, to_m=to_m, duration_s=self.duration_s, seed=seed, **asked)

    def errors_mm(self, tool_m: FloatArray) -> tuple[float, float]:
        """Mean and largest distance of tool points, shape (m, 3), from the line [mm]."""
        distance = distance_to_line(tool_m, self.A, self.B) * 1e3
        return float(distance.mean()), float(distance.max())


@dataclass(frozen=True, eq=False)
class Course:
    """A plan that is being worked out: its unrounded waypoints, and what the arm is expected to do along it.

    All on the grid of the rig's ticks from the plan's begin to its end, m = duration / period + 1 rows.
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

    @property
    def goals_rad(self) -> FloatArray:
        return joint_path(self.waypoints, self.knots, progress_of_ticks(len(self.lag_rad)), self.kind)

    @property
    def expected_rad(self) -> FloatArray:
        """Where the joints are expected."""
        return self.goals_rad - self.lag_rad


def progress_of_ticks(m: int) -> FloatArray:
    """Progress along the line at each of m ticks, exactly 0 at the first and 1 at the last."""
    s = time_law(np.linspace(0.0, 1.0, m))
    s[0], s[-1] = 0.0, 1.0
    return np.asarray(s)


def ticks_of(duration_s: float, period_s: float) -> int:
    """How many ticks see the motion, both ends included."""
    return max(3, round(duration_s / period_s) + 1)


def courses(rig: Rig, line: Line, via: int | None, ways: FloatArray) -> Iterator[Course]:
    """Courses along a line, the most promising first.

    Args:
        via: How many via points; None: a goal every tick.
        ways: Joint positions [rad] along the line, shape (ways, stations, n); see `line_paths`.
    """
    chain = rig.robot.chain
    if via is None:
        yield from (_course(rig, line, None, way) for way in ways[:TRIED_WAYS])
        return

    # What few waypoints cannot follow counts as well as what the servos get wrong: a joint that turns around on the way
    # jumps by twice its friction, and only a goal every tick can make up for that.
    def cost(q: FloatArray) -> FloatArray:
        bent = np.sqrt((distance_to_line(tool_position(chain, q), line.A, line.B) ** 2).mean(axis=-1))
        return np.asarray(bent + SERVO_ERROR_RAD * sensitivity_m(chain, q, line.A, line.B))

    knots = np.broadcast_to(np.linspace(0.0, 1.0, via + 2), (len(ways), via + 2))
    stations = np.broadcast_to(np.linspace(0.0, 1.0, ways.shape[1]), ways.shape[:2])
    kept = joint_path(ways, stations, knots[0], "cubic")
    plain = joint_path(kept, knots, progress_of_ticks(ticks_of(line.duration_s, rig.period_s)), "cubic")
    made = [_course(rig, line, via, ways[i]) for i in np.argsort(cost(plain), kind="stable")[:PLACED_WAYS]]
    yield from sorted(made, key=lambda course: float(cost(course.expected_rad)))


def _course(rig: Rig, line: Line, via: int | None, way: FloatArray) -> Course:
    m = ticks_of(line.duration_s, rig.period_s)
    s = progress_of_ticks(m)
    stations = np.linspace(0.0, 1.0, len(way))
    knots = s if via is None else np.linspace(0.0, 1.0, via + 2)
    kind: Interpolation = "linear" if via is None else "cubic"
    at_knots = joint_path(way, stations, knots, "cubic")
    offset = np.zeros((m, 3))
    if line.unseen_m is not None:
        offset = columns_at(np.linspace(0.0, 1.0, m), np.linspace(0.0, 1.0, len(line.unseen_m)), line.unseen_m)
    course = Course(line, kind, via is None, at_knots, knots, np.zeros((m, rig.robot.chain.n)), offset)
    for _ in range(1 if via is None else 3):
        course = placed(rig, course, move_knots=via is not None)
    return course


def placed(rig: Rig, course: Course, *, move_knots: bool = False, held: FloatArray | None = None) -> Course:
    """The course with its waypoints where the motion less the lag is straight.

    Args:
        move_knots: Whether the waypoints' places along the line are free as well.
        held: Which joints stay as they are, as weights from 0 to 1, shape (n,).
    """
    line, chain = course.line, rig.robot.chain
    limits: FloatArray = np.array([joint.limits_rad for joint in rig.arm.joints[: chain.n]])
    inside, objective = limits + np.array([SWING_RAD, -SWING_RAD]), "mix" if course.stream else line.objective
    motion = StraightMotion(chain, course.kind, line.A, line.B, inside, course.lag_rad, course.offset_m, objective)
    placement = place(motion, course.waypoints, course.knots, held=held, move_knots=move_knots)
    return replace(course, waypoints=placement.waypoints, knots=placement.knots)


def plan_of(rig: Rig, course: Course, seed: int) -> Plan:
    """The course as a plan for the daemon; its prediction is where the arm is expected, without rounding to ticks."""
    line = course.line
    points = tool_position(rig.robot.chain, course.expected_rad) + course.offset_m
    predicted_mm = [float(error(points, line.A, line.B)) * 1e3 for error in (mean_error, max_error)]
    # Joints beyond the chain, such as a gripper, have no part in the line.
    waypoints = np.pad(course.waypoints, ((0, 0), (0, len(rig.arm.joints) - rig.robot.chain.n)))
    return plan_through(rig.arm, line.request(seed, interpolation=course.kind), waypoints, course.knots, predicted_mm)


def sent_rad(arm: ArmConfig, goals_rad: FloatArray) -> FloatArray:
    """What the servos are really sent: goals in whole ticks, as angles [rad], shape (m, joints)."""
    columns = [
        [joint.position_rad(round(joint.tick(x))) for x in goals_rad[:, i]]
        for i, joint in enumerate(arm.joints[: goals_rad.shape[1]])
    ]
    return np.array(columns).T


def plan_goals_rad(rig: Rig, plan: Plan) -> FloatArray:
    """What the servos are sent at every tick of the plan [rad], shape (m, n)."""
    ticks = np.arange(ticks_of(plan.duration_s, rig.period_s))
    return sent_rad(rig.arm, plan_positions(plan, ticks * np.float64(rig.period_s))[:, : rig.robot.chain.n])


def too_heavy(rig: Rig, model: LagModel | None, plan: Plan) -> str:
    """Why the plan, or the way to its start, is more than the motors can carry; empty: it is not.

    An arm that nobody has measured gets a lower bound. An arm that stands close to the bound must be able to leave, so
    a little more than it bears there is allowed.
    """
    chain = rig.robot.chain
    model, bound = (lag.nominal(rig.arm, chain), UNKNOWN_HEAVIEST_RAD) if model is None else (model, HEAVIEST_RAD)
    whole = np.array(joint_trajectory(plan, rig.arm, rig.goals_rad, rig.period_s).positions_rad)[:, : chain.n]
    most = lag.heaviest_rad(model, chain, whole)
    borne = lag.heaviest_rad(model, chain, np.tile(whole[0], (2, 1)))
    allowed = np.maximum(bound, np.minimum(LEAVING * borne, HEAVIEST_RAD))
    if (most <= allowed).all():
        return ""
    worst = int((most / allowed).argmax())
    return (
        f"{rig.arm.joints[worst].name} would stay {np.degrees(most[worst]):.1f} deg behind its goal on the line or the "
        f"way there, at most {np.degrees(allowed[worst]):.1f} deg; move the line nearer to the base, or make the tool "
        "lighter"
    )
