"""A plan corrected by what was measured: run it, learn how far each joint stays behind its goal, place it again.

Rules.
1. The control step corrects what it foresees of the lag of each joint. What that leaves is learnt from the runs,
   smoothed, with a gain that falls from round to round. A constant gain creeps or, close to 2, diverges.
2. A plan is corrected as a whole: its waypoints are placed again such that the motion less the lag is straight.
3. A joint that hardly moves stands in its friction; pushing it further would wind it up until it jumps. It is held, and
   the others make up for where it stands.
4. A motion is repeatable, its readings are not: the same plan, run again, seems straighter or less straight by the
   repeat noise. So a plan that seems better than the kept one is run a second time. It takes the kept one's place only
   if the mean of both runs is better by more than that noise. Kept plans therefore get better from one to the next. Now
   and then a joint sticks in one run where it slips in another. Two runs that differ by far more than the noise ask for
   a third; then the median of the three counts, for choosing as for learning.
5. A plan that is not kept is forgotten. The next one starts from the kept plan again, with a smaller gain and with all
   that was measured of the kept plan by then. Rounds end when `PATIENCE` in a row were not kept.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.course import Course, placed, plan_goals_rad, plan_of, too_heavy
from armctl.lab.rig import Measured, Rig
from armctl.messages import LagModel
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.plan import Plan
from armctl.trajectory.straightness import distance_to_line

GAINS = (0.8, 0.6, 0.5, 0.4, 0.35, 0.3)
# Of the gain, after each plan in a row that was not kept: stiction answers a large correction with a jump.
LESS = 0.5
# How often a plan is run before it may be kept: at least, and where two runs disagree.
RUNS, MOST_RUNS = 2, 3
# Deviations of the noise between two runs that noise alone hardly ever makes.
DISAGREE = 4.0 * 2.0**0.5
# Standard deviation of the window over which readings are averaged.
SMOOTH_S = 0.25
# A joint that travels less hardly moves.
STILL_RAD = 3.0 * TICK_RAD
PATIENCE = 2
# Standard deviation of `filtered_mm` from run to run of one plan, as it was on simulated arms (half a tick of noise in
# each reading), and how many runs of this arm's own count as much.
NOISE_MM = 0.07
NOISE_RUNS = 2


@dataclass(frozen=True, eq=False)
class Round:
    """One run of a refinement."""

    number: int
    course: Course
    plan: Plan
    runs: tuple[Measured, ...]
    # Of each run, see `seen_mm`.
    run_mm: tuple[float, ...]
    # Whether the control step corrects its runs.
    corrected: bool
    # Whether it was the best when it was made.
    kept: bool = False

    @property
    def measured(self) -> Measured:
        return self.runs[0]

    @property
    def filtered_mm(self) -> float:
        """The figure by which rounds are compared: the median over the runs."""
        return float(np.median(self.run_mm))


def lag_of(rig: Rig, plan: Plan, measured: Measured) -> FloatArray:
    """Goal less encoder at every tick of the plan [rad], shape (m, n)."""
    goals, at = plan_goals_rad(rig, plan), measured.time_s
    time_s: FloatArray = np.arange(len(goals)) * np.float64(rig.period_s)
    return columns_at(time_s, at, columns_at(at, time_s, goals) - measured.positions_rad[:, : rig.robot.chain.n])


def smoothed(values: FloatArray, period_s: float) -> FloatArray:
    """Values averaged over time with a Gaussian window, shape (m, ...); at the ends the window is cut off."""
    reach = np.arange(len(values)) * period_s
    window = np.exp(-0.5 * ((reach[:, None] - reach) / SMOOTH_S) ** 2)
    return np.asarray(np.tensordot(window / window.sum(axis=1, keepdims=True), values, axes=1))


def learn(rig: Rig, last: Round, gain: float) -> Course:
    """The course of a round, corrected by what the runs of the round showed."""
    course = last.course
    lag = np.median([lag_of(rig, last.plan, run) for run in last.runs], axis=0)
    surprise = gain * smoothed(lag - course.lag_rad, rig.period_s)
    held = (np.ptp(course.expected_rad, axis=0) < STILL_RAD).astype(float)
    return placed(rig, replace(course, lag_rad=course.lag_rad + surprise), held=held)


def run(rig: Rig, course: Course, plan: Plan, number: int, *, corrected: bool = True) -> Round:
    """A round of one run.

    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    return again(rig, Round(number, course, plan, (), (), corrected))


def again(rig: Rig, one: Round) -> Round:
    """The round with one run more.

    Raises:
        RequestRefused: the plan may not run, or was stopped.
    """
    measured = rig.run(one.plan, corrected=one.corrected)
    return replace(one, runs=(*one.runs, measured), run_mm=(*one.run_mm, seen_mm(rig, one, measured)))


def often_enough(rig: Rig, one: Round, noise_mm: float) -> Round:
    """The round, run again until its runs can be trusted.

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
    course, expected = one.course, one.course.expected_rad
    q = plan_goals_rad(rig, one.plan) - lag_of(rig, one.plan, measured)
    seen = tool_position(rig.robot.chain, expected + smoothed(q - expected, rig.period_s)) + course.offset_m
    return float(np.sqrt((distance_to_line(seen, course.line.A, course.line.B) ** 2).mean())) * 1e3


def first_run(
    rig: Rig, candidates: Iterable[Course], model: LagModel | None, seed: int, number: int = 0, *, corrected: bool
) -> Round:
    """The first course whose plan may run and is not too heavy by the model, and its run.

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
            return run(rig, course, plan, number, corrected=corrected)
        except RequestRefused as refusal:
            if refusal.code not in ("PREFLIGHT", "LIMIT"):
                raise
            refused = refused or refusal
    assert refused is not None
    raise refused


def refine(rig: Rig, first: Round, rounds: int, show: Callable[[Round], None] = lambda _: None) -> list[Round]:
    """Measure, correct and run again, at most `rounds` times. Returns `first` and the new rounds, in order.

    The last of them that is `kept` is the outcome.
    """
    best = replace(often_enough(rig, first, NOISE_MM), kept=True)
    done = [best]
    unkept = 0
    for number in range(first.number + 1, first.number + 1 + rounds):
        gain = GAINS[min(len(done), len(GAINS)) - 1] * LESS**unkept
        course = learn(rig, best, gain)
        try:
            one = run(rig, course, plan_of(rig, course, first.plan.seed), number, corrected=first.corrected)
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
    """The last round that was kept."""
    return [one for one in rounds if one.kept][-1]
