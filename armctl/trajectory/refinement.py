"""A plan corrected by what was measured: run it, learn how far each joint stays behind its goal, place it again.

Rules.
1. The control step corrects what it foresees of the lag of each joint. What that leaves is learnt from the runs,
   smoothed, with a gain that falls from round to round. A constant gain creeps or, close to 2, diverges.
2. A plan is corrected as a whole: its waypoints are placed again such that the motion less the lag is straight.
3. A joint that hardly moves stands in its friction; pushing it on the way would wind it up until it jumps. It is led
   elsewhere as a whole, by what it was off on the average.
4. A motion is repeatable, its readings are not: the same plan, run again, seems straighter or less straight by the
   repeat noise. So a plan that seems better than the kept one is run a second time. It takes the kept one's place only
   if the mean of both runs is better by more than that noise. Kept plans therefore get better from one to the next. Now
   and then a joint sticks in one run where it slips in another. Two runs that differ by far more than the noise ask for
   a third; then the median of the three counts, for choosing as for learning.
5. A plan that is not kept is forgotten. The next one starts from the kept plan again, with a smaller gain and with all
   that was measured of the kept plan by then. Rounds end when `PATIENCE` in a row were not kept.
6. Where runs are counted (`runs_left`), the first plan is not repeated, nor is one that is better by far; the last run
   counts alone.

Nothing here moves an arm: `Refinement.steps` yields what is to be run and is sent what was measured, so that a daemon,
which serves people between two runs, and an experiment share these rules.
"""

from collections.abc import Callable, Generator, Iterable, Sequence
from typing import NamedTuple

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.course import Course, placed, plan_goals_rad, plan_of
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.plan import Plan
from armctl.trajectory.preflight import Driven
from armctl.trajectory.straightness import distance_to_line

GAINS = (0.8, 0.6, 0.5, 0.4, 0.35, 0.3)
# Of the gain, after each plan in a row that was not kept: stiction answers a large correction with a jump.
LESS = 0.5
# How often a plan is run before it may be kept: at least, and where two runs disagree.
RUNS, MOST_RUNS = 2, 3
# Deviations of the noise between two runs that noise alone hardly ever makes.
DISAGREE = 4.0 * 2.0**0.5
# Standard deviation of the window over which readings are averaged, to compare runs by and to learn from: what is
# learnt of noise is put into the next plan.
SMOOTH_S, LEARN_S = 0.25, 0.5
# A joint that travels less hardly moves.
STILL_RAD = 3.0 * TICK_RAD
PATIENCE = 2
# Standard deviation of `filtered_mm` from run to run of one plan, as it was on simulated arms (half a tick of noise in
# each reading), and how many runs of this arm's own count as much.
NOISE_MM = 0.07
NOISE_RUNS = 2
# Codes of refusals that say that a correction leads where the arm must not go.
ASTRAY = ("PREFLIGHT", "LIMIT")
# Of a plan's time, for how much of it a run may wait.
WAITED_SHARE = 0.08


class Measured(NamedTuple):
    """One executed plan, as the encoders saw it; times count from the plan's begin.

    Shapes: times (m,), positions (m, joints), tool points (k, 3).
    """

    time_s: FloatArray
    # By the encoders, at `time_s`.
    positions_rad: FloatArray
    duration_s: float
    # Name of the log; empty where none was kept.
    recording: str
    # The tool's real path: known of a simulated arm only.
    true_time_s: FloatArray | None = None
    true_tool_m: FloatArray | None = None


class Round(NamedTuple):
    """One run of a refinement."""

    number: int
    course: Course
    plan: Plan
    # Whether the control step corrects its runs.
    corrected: bool
    runs: tuple[Measured, ...] = ()
    # Of each run, see `seen_mm`.
    run_mm: tuple[float, ...] = ()
    # Whether it was the best when it was made.
    kept: bool = False

    @property
    def measured(self) -> Measured:
        return self.runs[0]

    @property
    def filtered_mm(self) -> float:
        """The figure by which rounds are compared: the median over the runs."""
        return float(np.median(self.run_mm))


def waited_long(wanted_s: float, duration_s: float, period_s: float) -> bool:
    """Whether a run stood for so long (paused, or waiting for servos), or was so slow, that nothing is learnt of it."""
    return duration_s > (1.0 + WAITED_SHARE) * wanted_s + period_s / 2.0


def lag_of(on: Driven, plan: Plan, measured: Measured) -> FloatArray:
    """Goal less encoder at every tick of the plan [rad], shape (m, n)."""
    goals, at = plan_goals_rad(on, plan), measured.time_s
    time_s: FloatArray = np.arange(len(goals)) * np.float64(on.period_s)
    return columns_at(time_s, at, columns_at(at, time_s, goals) - measured.positions_rad[:, : on.robot.chain.n])


def smoothed(values: FloatArray, period_s: float, window_s: float = SMOOTH_S) -> FloatArray:
    """Values averaged over time with a Gaussian window, shape (m, ...); at the ends the window is cut off."""
    reach = np.arange(len(values)) * period_s
    window = np.exp(-0.5 * ((reach[:, None] - reach) / window_s) ** 2)
    return np.asarray(np.tensordot(window / window.sum(axis=1, keepdims=True), values, axes=1))


def learn(on: Driven, last: Round, gain: float) -> Course:
    """The course of a round, corrected by what the runs of the round showed."""
    course = last.course
    lag = np.median([lag_of(on, last.plan, run) for run in last.runs], axis=0)
    more = surprise(lag - course.lag_rad, course.expected_rad, on.period_s, gain)
    still = np.ptp(course.expected_rad, axis=0) < STILL_RAD
    waypoints = course.waypoints + np.where(still, more.mean(axis=0), 0.0)
    return placed(on, course._replace(lag_rad=course.lag_rad + more, waypoints=waypoints), held=still.astype(float))


def surprise(off_rad: FloatArray, wanted_rad: FloatArray, period_s: float, gain: float) -> FloatArray:
    """What is to be learnt of how far joints were off [rad], shape (m, n); of one that hardly moves the average."""
    seen = gain * smoothed(off_rad, period_s, LEARN_S)
    return np.where(np.ptp(wanted_rad, axis=0) < STILL_RAD, seen.mean(axis=0), seen)


def seen_mm(on: Driven, one: Round, measured: Measured) -> float:
    """Root mean square of the smoothed readings' distances to the line [mm], of a run of the round's plan."""
    course, expected = one.course, one.course.expected_rad
    q = plan_goals_rad(on, one.plan) - lag_of(on, one.plan, measured)
    seen = tool_position(on.robot.chain, expected + smoothed(q - expected, on.period_s)) + course.offset_m
    return float(np.sqrt((distance_to_line(seen, course.line.A, course.line.B) ** 2).mean())) * 1e3


def with_run(on: Driven, one: Round, measured: Measured) -> Round:
    """The round with one run more of its plan."""
    return one._replace(runs=(*one.runs, measured), run_mm=(*one.run_mm, seen_mm(on, one, measured)))


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


# Yields a round whose plan is to be run once more, and is sent what was measured.
Steps = Generator[Round, Measured, None]
# Tells how many runs may still be made; None: as many as the rules ask for.
Left = Callable[[], int | None]
# Called with each further round that is over.
Shown = Callable[[Round], None]


class Refinement:
    """The rounds of one plan, as far as they have come."""

    def __init__(
        self, on: Driven, first: Round, rounds: int, *, runs_left: Left = lambda: None, show: Shown = lambda _: None
    ) -> None:
        """
        Args:
            first: What the arm does before any correction; may have been run.
            rounds: Corrections at most.
            runs_left: Asked after the first run; where it counts, one that tells nothing counts, too.
        """
        self.on, self.first, self.most, self.show = on, first, rounds, show
        self._left = runs_left
        # In order, as far as they are over; the last of them that is `kept` is the outcome.
        self.rounds: list[Round] = []

    @property
    def best(self) -> Round:
        """The last round that was kept."""
        return best_of(self.rounds)

    def steps(self) -> Steps:
        """Measure, correct and run again. A refusal to run a plan is thrown in; others than `ASTRAY` come out again."""
        best = self.first
        while not best.runs or (self._left() is None and not enough(best, NOISE_MM)):
            best = with_run(self.on, best, (yield best))
        best = best._replace(kept=True)
        self.rounds.append(best)
        unkept = 0
        for number in range(best.number + 1, best.number + 1 + self.most):
            if self._left() == 0 or unkept == PATIENCE:
                return
            course = learn(self.on, best, GAINS[min(len(self.rounds), len(GAINS)) - 1] * LESS**unkept)
            one = Round(number, course, plan_of(self.on, course, self.first.plan.seed), best.corrected)
            try:
                one = with_run(self.on, one, (yield one))
                noise_mm = repeat_noise_mm(self.rounds)
                while self._left() != 0 and self._in_doubt(one, best, noise_mm):
                    one = with_run(self.on, one, (yield one))
            except RequestRefused as refusal:
                if refusal.code not in ASTRAY:
                    raise
                return  # what there is stays
            if self._better(one, best):
                best, unkept = one._replace(kept=True), 0
                one = best
            else:
                unkept += 1
            self.rounds.append(one)
            self.show(one)

    def _in_doubt(self, one: Round, best: Round, noise_mm: float) -> bool:
        """Whether a plan that seems better has to be run again before that is believed."""
        if len(one.runs) > 1:
            return not enough(one, noise_mm)
        gain_mm = best.filtered_mm - one.filtered_mm
        return gain_mm > 0.0 and (self._left() is None or gain_mm < DISAGREE * noise_mm)

    def _better(self, one: Round, best: Round) -> bool:
        """Whether a plan takes the kept one's place."""
        noise_mm = repeat_noise_mm([*self.rounds, one]) * (1.0 / len(one.runs) + 1.0 / len(best.runs)) ** 0.5
        return (len(one.runs) >= RUNS or self._left() is not None) and one.filtered_mm + noise_mm < best.filtered_mm


def following(steps: Steps, told: Measured | RequestRefused | None = None) -> Round | None:
    """What is to be run next, after what the last run measured, or why it was refused; None: the refinement is over.

    Raises:
        RequestRefused: `told`, where it ends the refinement.
    """
    try:
        if isinstance(told, RequestRefused):
            return steps.throw(told)
        return next(steps) if told is None else steps.send(told)
    except StopIteration:
        return None


def enough(one: Round, noise_mm: float) -> bool:
    """Whether a round was run so often that its runs can be trusted.

    Args:
        noise_mm: Of `filtered_mm` from run to run, as far as it is known without this round.
    """
    if len(one.runs) < RUNS:
        return False
    return len(one.runs) >= MOST_RUNS or bool(np.ptp(one.run_mm) <= DISAGREE * noise_mm)
