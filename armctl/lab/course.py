"""The ways along a line that an arm may be sent: many are placed, the most promising offered; some are too heavy."""

from collections.abc import Iterator
from typing import Any, Literal

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.genetic.request import OptimizeRequest
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.rig import Rig
from armctl.messages import LagModel
from armctl.trajectory import lag
from armctl.trajectory.course import Course, Line, placed, progress_of_ticks, ticks_of
from armctl.trajectory.interpolate import Interpolation, columns_at, joint_path
from armctl.trajectory.line_path import sensitivity_m
from armctl.trajectory.plan import Plan, joint_trajectory
from armctl.trajectory.straightness import distance_to_line

# How many via points; auto: as few as will do; stream: a goal every tick.
Via = int | Literal["auto", "stream"]

# How many ways along the line are considered at all, placed as via points, and offered to the arm.
DRAWN_WAYS, PLACED_WAYS, TRIED_WAYS = 400, 32, 30
# What a servo is off after correction, one with another.
SERVO_ERROR_RAD = 0.3 * TICK_RAD
# Largest lag of a plan that may run: with what a trim takes, more of it is beyond the largest correction there is
# (`MOST_RAD`), and the tool falls off the line by centimetres.
HEAVIEST_RAD = np.radians(5.8)
UNKNOWN_HEAVIEST_RAD = np.radians(5.0)
# How much more than it bears where it stands an arm may bear on its way from there.
LEAVING = 1.1


def request_of(line: Line, seed: int, **more: Any) -> OptimizeRequest:
    """The line as the optimiser's request, with more of its fields."""
    asked: dict[str, Any] = {"via": (), "objective": line.objective, **more}
    from_m, to_m = tuple(line.A.tolist()), tuple(line.B.tolist())
    return OptimizeRequest(from_m=from_m, to_m=to_m, duration_s=line.duration_s, seed=seed, **asked)


def courses(rig: Rig, line: Line, via: int | None, ways: FloatArray) -> Iterator[Course]:
    """Courses along a line, the most promising first.

    Args:
        via: How many via points; None: a goal every tick.
        ways: Joint positions [rad] along the line, shape (ways, stations, n); see `line_paths`.
    """
    if via is None:
        yield from (_course(rig, line, None, way) for way in ways[:TRIED_WAYS])
        return

    # What few waypoints cannot follow counts as well as what the servos get wrong: a joint that turns around on the way
    # jumps by twice its friction, and only a goal every tick can make up for that.
    def cost(q: FloatArray) -> FloatArray:
        bent = np.sqrt((distance_to_line(tool_position(rig.robot.chain, q), line.A, line.B) ** 2).mean(axis=-1))
        return np.asarray(bent + SERVO_ERROR_RAD * sensitivity_m(rig.robot.chain, q, line.A, line.B))

    knots = np.broadcast_to(np.linspace(0.0, 1.0, via + 2), (len(ways), via + 2))
    kept = joint_path(ways, np.broadcast_to(np.linspace(0.0, 1.0, ways.shape[1]), ways.shape[:2]), knots[0], "cubic")
    plain = joint_path(kept, knots, progress_of_ticks(ticks_of(line.duration_s, rig.period_s)), "cubic")
    made = [_course(rig, line, via, ways[i]) for i in np.argsort(cost(plain), kind="stable")[:PLACED_WAYS]]
    yield from sorted(made, key=lambda course: float(cost(course.expected_rad)))


def _course(rig: Rig, line: Line, via: int | None, way: FloatArray) -> Course:
    m = ticks_of(line.duration_s, rig.period_s)
    knots = progress_of_ticks(m) if via is None else np.linspace(0.0, 1.0, via + 2)
    kind: Interpolation = "linear" if via is None else "cubic"
    at_knots = joint_path(way, np.linspace(0.0, 1.0, len(way)), knots, "cubic")
    offset = np.zeros((m, 3))
    if line.unseen_m is not None:
        offset = columns_at(np.linspace(0.0, 1.0, m), np.linspace(0.0, 1.0, len(line.unseen_m)), line.unseen_m)
    beyond = np.zeros((len(knots), len(rig.arm.joints) - rig.robot.chain.n))
    course = Course(line, kind, via is None, at_knots, knots, np.zeros((m, rig.robot.chain.n)), offset, beyond)
    for _ in range(1 if via is None else 3):
        course = placed(rig, course, move_knots=via is not None)
    return course


def too_heavy(rig: Rig, model: LagModel | None, plan: Plan) -> str:
    """Why the plan, or the way to its start, is more than the motors can carry; empty: it is not.

    An arm that nobody has measured gets a lower bound. An arm that stands close to the bound must be able to leave, so
    a little more than it bears there is allowed.
    """
    chain = rig.robot.chain
    model, bound = (lag.nominal(rig.arm, chain), UNKNOWN_HEAVIEST_RAD) if model is None else (model, HEAVIEST_RAD)
    whole = np.array(joint_trajectory(plan, rig, rig.goals_rad).positions_rad)[:, : chain.n]
    most = lag.heaviest_rad(model, chain, whole, rig.period_s)
    borne = lag.heaviest_rad(model, chain, np.tile(whole[0], (2, 1)), rig.period_s)
    allowed = np.maximum(bound, np.minimum(LEAVING * borne, HEAVIEST_RAD))
    if (most <= allowed).all():
        return ""
    worst = int((most / allowed).argmax())
    name, behind_deg, allowed_deg = rig.arm.joints[worst].name, *np.degrees([most[worst], allowed[worst]])
    text = f"{name} would stay {behind_deg:.1f} deg behind its goal on the line or the way there"
    return f"{text}, at most {allowed_deg:.1f} deg; move the line nearer to the base, or make the tool lighter"
