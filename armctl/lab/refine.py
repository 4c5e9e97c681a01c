"""Plans that an arm that sags and lags runs straight: predicted first, then corrected by what was measured.

Rules.
1. What a joint stays behind its goal is its lag: goal less position, a function of time along one plan. The sag model
   predicts it; what the model leaves is learnt from the runs, smoothed, with a gain that falls from round to round: a
   constant one creeps or, close to 2, diverges.
2. A plan is corrected as a whole: its waypoints are placed again such that the motion less the lag is straight
   (`trajectory/placement.py`), as near as can be to where they were. With a waypoint every tick that is a stream.
3. A joint that hardly moves stands in its friction; pushing it further would wind it up until it jumps. It is held out,
   and the others make up for where it stands.
4. A motion is repeatable, its readings are not: the same plan, run again, seems straighter or less straight by the
   repeat noise. So a plan that seems better than the kept one is run a second time, and takes its place only if the
   mean of both is better by more than that noise. Kept plans therefore get better from one to the next. Now and then a
   joint sticks in one run where it slips in another: two runs that differ by far more than the noise ask for a third,
   and the median of the three counts, for choosing as for learning.
5. A plan that is not kept is forgotten: the next one starts from the kept plan again, with a smaller gain and with all
   that was measured of it by then. Rounds end when `PATIENCE` in a row were not kept.
6. Goals go to the nearest whole tick, each joint by itself. Choosing every tick's goals together, among the 2^n
   neighbours, so that the tool is nearest to the line is 5 times better on paper and does not pay on servos with
   friction, which jump to a goal that goes to and fro, or do not follow it (12 arms by truth, with only such choices as
   turn no joint back: first run 9 % worse, outcome 5 % better in the mean but on 7 of the 12 only; with any: worse).
7. Nothing here knows where the tool really is, unless somebody measured it.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import sag_model
from armctl.lab.rig import Measured, Rig
from armctl.lab.sag_model import SagModel
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.line_path import sensitivity_m
from armctl.trajectory.placement import Objective, StraightMotion, place
from armctl.trajectory.plan import LEAD_RAD, LEAD_SHARE, Plan, joint_trajectory, plan_positions
from armctl.trajectory.straightness import distance_to_line, max_error, mean_error

GAINS = (0.8, 0.6, 0.5, 0.4, 0.35, 0.3)
LESS = 0.5
"""Of the gain, after each plan in a row that was not kept: stiction answers a large correction with a jump."""
RUNS, MOST_RUNS = 2, 3
"""How often a plan is run before it may be kept: at least, and where two runs disagree."""
DISAGREE = 4.0 * 2.0**0.5
"""Deviations of the noise between two runs that noise alone hardly ever makes."""
SMOOTH_S = 0.25
"""Standard deviation of the window over which readings are averaged."""
STILL_RAD = 3.0 * TICK_RAD
"""A joint that travels less hardly moves."""
PATIENCE = 2
NOISE_MM = 0.07
NOISE_RUNS = 2
"""Standard deviation of `filtered_mm` from run to run of one plan, as it was on simulated arms (half a tick of noise in
each reading), and how many runs of this arm's own count as much."""
DRAWN_WAYS, PLACED_WAYS, TRIED_WAYS = 400, 32, 30
"""How many ways along the line are considered at all, placed as via points, and offered to the arm."""
SERVO_ERROR_RAD = 0.3 * TICK_RAD
"""What a servo is off after correction, one with another."""
HEAVIEST_RAD = np.radians(7.0)
UNKNOWN_HEAVIEST_RAD = np.radians(5.0)
"""A lag that is larger is near to where the daemon takes a joint for blocked."""
LEAVING = 1.1
SWING_RAD = np.radians(2.0)
"""Kept free before each joint limit."""


@dataclass(frozen=True, eq=False)
class Line:
    """What is wanted."""

    A: FloatArray
    B: FloatArray
    duration_s: float
    objective: Objective = "mix"
    unseen_m: FloatArray | None = None
    """Where the tool was seen from outside, less where the encoders have it, at even times from begin to end [m],
    shape (k, 3); None: nobody looked."""


@dataclass(frozen=True, eq=False)
class Course:
    """A plan being worked out: its waypoints, unrounded, and what is expected of the arm along it.

    All on the grid of the rig's ticks from the plan's begin to its end, m = duration / period + 1 rows.
    """

    line: Line
    kind: Interpolation
    stream: bool
    waypoints: FloatArray
    """[rad], shape (k, n)."""
    knots: FloatArray
    lag_rad: FloatArray
    """Goal less position: what the model says at first, then corrected by what was measured; shape (m, n)."""
    offset_m: FloatArray
    """The line's `unseen_m`, shape (m, 3)."""

    @property
    def goals_rad(self) -> FloatArray:
        return joint_path(self.waypoints, self.knots, progress_of_ticks(len(self.lag_rad)), self.kind)

    @property
    def expected_rad(self) -> FloatArray:
        """Where the joints are expected."""
        return self.goals_rad - self.lag_rad


@dataclass(frozen=True, eq=False)
class Round:
    """One run of a refinement."""

    number: int
    course: Course
    plan: Plan
    runs: tuple[Measured, ...]
    run_mm: tuple[float, ...]
    """Of each run, see `seen_mm`."""
    kept: bool = False
    """Whether it was the best when it was made."""

    @property
    def measured(self) -> Measured:
        return self.runs[0]

    @property
    def filtered_mm(self) -> float:
        """What rounds are compared by."""
        return float(np.median(self.run_mm))


def progress_of_ticks(m: int) -> FloatArray:
    s = time_law(np.linspace(0.0, 1.0, m))
    s[0], s[-1] = 0.0, 1.0
    return np.asarray(s)


def _waypoint_limits(arm: ArmConfig, n: int) -> FloatArray:
    """Where waypoints may be [rad], shape (n, 2): a curve through them swings a little further."""
    limits: FloatArray = np.array([joint.limits_rad for joint in arm.joints[:n]])
    return np.asarray(limits + np.array([SWING_RAD, -SWING_RAD]))


def rows_of(line: Line, period_s: float) -> int:
    return max(3, round(line.duration_s / period_s) + 1)


def courses(rig: Rig, line: Line, via: int | None, model: SagModel | None, ways: FloatArray) -> Iterator[Course]:
    """Courses along a line, the most promising first.

    Args:
        via: How many via points; None: a goal every tick.
        ways: Joint positions [rad] along the line, shape (ways, stations, n); see `line_paths`.
    """
    chain = rig.robot.chain
    if via is None:
        yield from (_course(rig, line, None, model, way) for way in ways[:TRIED_WAYS])
        return

    # What few waypoints cannot follow counts as well as what the servos get wrong: a joint that turns around on the way
    # jumps by twice its friction, and only a goal every tick can make up for that.
    def cost(q: FloatArray) -> FloatArray:
        bent = np.sqrt((distance_to_line(tool_position(chain, q), line.A, line.B) ** 2).mean(axis=-1))
        return np.asarray(bent + SERVO_ERROR_RAD * sensitivity_m(chain, q, line.A, line.B))

    knots = np.broadcast_to(np.linspace(0.0, 1.0, via + 2), (len(ways), via + 2))
    stations = np.broadcast_to(np.linspace(0.0, 1.0, ways.shape[1]), ways.shape[:2])
    kept = joint_path(ways, stations, knots[0], "cubic")
    plain = joint_path(kept, knots, progress_of_ticks(rows_of(line, rig.period_s)), "cubic")
    made = [_course(rig, line, via, model, ways[i]) for i in np.argsort(cost(plain), kind="stable")[:PLACED_WAYS]]
    yield from sorted(made, key=lambda course: float(cost(course.expected_rad)))


def _course(rig: Rig, line: Line, via: int | None, model: SagModel | None, way: FloatArray) -> Course:
    m = rows_of(line, rig.period_s)
    s = progress_of_ticks(m)
    stations = np.linspace(0.0, 1.0, len(way))
    knots = s if via is None else np.linspace(0.0, 1.0, via + 2)
    kind: Interpolation = "linear" if via is None else "cubic"
    on_ticks = joint_path(way, stations, s, "cubic")
    lag = _model_lag(rig, model, on_ticks)
    at_knots = joint_path(way + _between(lag, s, stations), stations, knots, "cubic")
    offset = np.zeros((m, 3))
    if line.unseen_m is not None:
        offset = _between(line.unseen_m, np.linspace(0.0, 1.0, len(line.unseen_m)), np.linspace(0.0, 1.0, m))
    course = Course(line, kind, via is None, at_knots, knots, lag, offset)
    for _ in range(1 if via is None else 3):
        course = _placed(rig, course, move_knots=via is not None)
        course = replace(course, lag_rad=_model_lag(rig, model, course.expected_rad))
    return course


def _between(values: FloatArray, s: FloatArray, at: FloatArray) -> FloatArray:
    return np.stack([np.interp(at, s, column) for column in values.T], axis=1)


def _model_lag(rig: Rig, model: SagModel | None, q: FloatArray) -> FloatArray:
    if model is None:
        return np.zeros_like(q)
    early = q[min(len(q) - 1, round(LEAD_SHARE * (len(q) - 1)))]
    before = np.clip(early - q[0], -LEAD_RAD, LEAD_RAD)
    return sag_model.predict(model, sag_model.regressors(rig.robot.chain, q, before, rig.period_s))


def _placed(rig: Rig, course: Course, *, move_knots: bool = False, held: FloatArray | None = None) -> Course:
    line, chain = course.line, rig.robot.chain
    limits, objective = _waypoint_limits(rig.arm, chain.n), "mix" if course.stream else line.objective
    motion = StraightMotion(chain, course.kind, line.A, line.B, limits, course.lag_rad, course.offset_m, objective)
    placement = place(motion, course.waypoints, course.knots, held=held, move_knots=move_knots)
    return replace(course, waypoints=placement.waypoints, knots=placement.knots)


def plan_of(rig: Rig, course: Course, seed: int) -> Plan:
    """The course as the daemon runs it; what it predicts is where the arm is expected, whole ticks left out."""
    arm, chain, line = rig.arm, rig.robot.chain, course.line
    points = tool_position(chain, course.expected_rad) + course.offset_m
    waypoints = np.tile([joint.rest_rad for joint in arm.joints], (len(course.knots), 1))
    waypoints[:, : chain.n] = course.waypoints
    waypoints[:, chain.n :] = 0.0
    return Plan(
        arm_id=arm.arm_id,
        calibration_hash=arm.calibration_hash,
        from_m=tuple(line.A.tolist()),
        to_m=tuple(line.B.tolist()),
        duration_s=line.duration_s,
        via=len(course.knots) - 2,
        interpolation=course.kind,
        waypoints_rad=tuple(map(tuple, waypoints.tolist())),
        waypoint_progress=tuple(course.knots.tolist()),
        predicted_mean_error_mm=float(mean_error(points, line.A, line.B)) * 1e3,
        predicted_max_error_mm=float(max_error(points, line.A, line.B)) * 1e3,
        seed=seed,
    )


def sent_rad(arm: ArmConfig, goals_rad: FloatArray) -> FloatArray:
    """What the servos are really sent: goals in whole ticks, as angles [rad], shape (m, joints)."""
    columns = [
        [joint.position_rad(round(joint.tick(x))) for x in goals_rad[:, i]]
        for i, joint in enumerate(arm.joints[: goals_rad.shape[1]])
    ]
    return np.array(columns).T


def plan_goals_rad(rig: Rig, plan: Plan) -> FloatArray:
    """What the servos are sent at every tick of the plan [rad], shape (m, n)."""
    m = max(3, round(plan.duration_s / rig.period_s) + 1)
    return sent_rad(rig.arm, plan_positions(plan, np.arange(m) * np.float64(rig.period_s))[:, : rig.robot.chain.n])


def lag_of(rig: Rig, plan: Plan, measured: Measured) -> FloatArray:
    """Goal less encoder at every tick of the plan [rad], shape (m, n)."""
    n = rig.robot.chain.n
    goals = plan_goals_rad(rig, plan)
    time_s: FloatArray = np.arange(len(goals)) * np.float64(rig.period_s)
    at = measured.time_s
    between = np.stack([np.interp(at, time_s, column) for column in goals.T], axis=1)
    lag = between - measured.positions_rad[:, :n]
    return np.stack([np.interp(time_s, at, column) for column in lag.T], axis=1)


def smoothed(values: FloatArray, period_s: float) -> FloatArray:
    """Averaged over time with a Gaussian window, the ends by what there is; shape (m, ...)."""
    reach = np.arange(len(values)) * period_s
    window = np.exp(-0.5 * ((reach[:, None] - reach) / SMOOTH_S) ** 2)
    return np.asarray(np.tensordot(window / window.sum(axis=1, keepdims=True), values, axes=1))


def learn(rig: Rig, last: Round, gain: float) -> Course:
    """The round's course corrected by what its runs showed."""
    course = last.course
    lag = np.median([lag_of(rig, last.plan, run) for run in last.runs], axis=0)
    surprise = gain * smoothed(lag - course.lag_rad, rig.period_s)
    held = (np.ptp(course.expected_rad, axis=0) < STILL_RAD).astype(float)
    return _placed(rig, replace(course, lag_rad=course.lag_rad + surprise), held=held)


def run(rig: Rig, course: Course, plan: Plan, number: int) -> Round:
    """A round of one run.

    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    return again(rig, Round(number, course, plan, (), ()))


def again(rig: Rig, one: Round) -> Round:
    """The round with one run more.

    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    measured = rig.run(one.plan)
    return replace(one, runs=(*one.runs, measured), run_mm=(*one.run_mm, seen_mm(rig, one, measured)))


def often_enough(rig: Rig, one: Round, noise_mm: float) -> Round:
    """The round with as many runs as it takes to believe them.

    Args:
        noise_mm: Of `filtered_mm` from run to run, as far as it is known without this round.
    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    while len(one.runs) < RUNS or (len(one.runs) < MOST_RUNS and np.ptp(one.run_mm) > DISAGREE * noise_mm):
        one = again(rig, one)
    return one


def seen_mm(rig: Rig, one: Round, measured: Measured) -> float:
    """Root mean square of the smoothed readings' distances to the line [mm], of a run of the round's plan."""
    course = one.course
    expected = course.expected_rad
    q = plan_goals_rad(rig, one.plan) - lag_of(rig, one.plan, measured)
    seen = tool_position(rig.robot.chain, expected + smoothed(q - expected, rig.period_s)) + course.offset_m
    return float(np.sqrt((distance_to_line(seen, course.line.A, course.line.B) ** 2).mean())) * 1e3


def too_heavy(rig: Rig, model: SagModel | None, plan: Plan) -> str:
    """Why the plan, or the way to its start, is more than the motors can carry; empty: it is not.

    Of an arm nobody has measured less is believed. Where it stands close to the bound it must get away, so a little
    more than it bears there is allowed.
    """
    chain = rig.robot.chain
    model, bound = (sag_model.nominal(rig.arm, chain), UNKNOWN_HEAVIEST_RAD) if model is None else (model, HEAVIEST_RAD)
    whole = np.array(joint_trajectory(plan, rig.arm, rig.goals_rad, rig.period_s).positions_rad)[:, : chain.n]
    most = sag_model.heaviest_rad(model, chain, whole)
    borne = sag_model.heaviest_rad(model, chain, np.tile(whole[0], (2, 1)))
    allowed = np.maximum(bound, np.minimum(LEAVING * borne, HEAVIEST_RAD))
    if (most <= allowed).all():
        return ""
    worst = int((most / allowed).argmax())
    return (
        f"{rig.arm.joints[worst].name} would stay {np.degrees(most[worst]):.1f} deg behind its goal on the line or the "
        f"way there, at most {np.degrees(allowed[worst]):.1f} deg; move the line nearer to the base, or make the tool "
        "lighter"
    )


def first_run(rig: Rig, candidates: Iterable[Course], model: SagModel | None, seed: int, number: int = 0) -> Round:
    """The first course whose plan may run and whose loads the model does not find too heavy, and its run.

    Raises:
        RequestRefused: none may; the reasons of the most promising.
    """
    refused: RequestRefused | None = None
    for course in candidates:
        plan = plan_of(rig, course, seed)
        if reason := too_heavy(rig, model, plan):
            refused = refused or RequestRefused("TOO_HEAVY", reason)
            continue
        try:
            return run(rig, course, plan, number)
        except RequestRefused as refusal:
            if refusal.code not in ("PREFLIGHT", "LIMIT"):
                raise
            refused = refused or refusal
    assert refused is not None
    raise refused


def refine(rig: Rig, first: Round, rounds: int, show: Callable[[Round], None] = lambda _: None) -> list[Round]:
    """Measure, correct, run again, at most `rounds` times; `first` and the rounds that came, in order.

    The last of them that is `kept` is the outcome.
    """
    best = replace(often_enough(rig, first, NOISE_MM), kept=True)
    done = [best]
    unkept = 0
    for number in range(first.number + 1, first.number + 1 + rounds):
        gain = GAINS[min(len(done), len(GAINS)) - 1] * LESS**unkept
        course = learn(rig, best, gain)
        try:
            one = run(rig, course, plan_of(rig, course, first.plan.seed), number)
            if one.filtered_mm < best.filtered_mm:
                one = often_enough(rig, one, repeat_noise_mm(done))
        except RequestRefused as refusal:
            if refusal.code not in ("PREFLIGHT", "LIMIT"):
                raise
            break  # the correction leads where the arm must not go: what there is stays
        noise_mm = repeat_noise_mm([*done, one]) * (1.0 / len(one.runs) + 1.0 / len(best.runs)) ** 0.5
        if len(one.runs) >= RUNS and one.filtered_mm + noise_mm < best.filtered_mm:
            best, unkept = replace(one, kept=True), 0
            one = best
        else:
            unkept += 1
        done.append(one)
        show(one)
        if unkept == PATIENCE:
            break
    return done


def repeat_noise_mm(rounds: Iterable[Round]) -> float:
    """Standard deviation of `filtered_mm` from run to run of one plan, by the rounds that were run more than once.

    Of a round whose runs disagreed the two that are nearest to each other count.
    """
    squares, freedom = NOISE_RUNS * NOISE_MM**2, NOISE_RUNS
    for one in rounds:
        if len(one.run_mm) >= RUNS:
            squares += float(np.diff(np.sort(one.run_mm)).min() ** 2) / 2.0
            freedom += 1
    return float(np.sqrt(squares / freedom))


def best_of(rounds: Sequence[Round]) -> Round:
    """The last one that was kept."""
    return [one for one in rounds if one.kept][-1]
