"""The rules by which a plan is corrected, on an arm that a test writes down run by run."""

from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import RequestRefused, UnreachableTarget
from armctl.kinematics.chain import tool_position
from armctl.messages import LagModel
from armctl.trajectory import refinement
from armctl.trajectory.course import Course, Line, bent, course_of, placed, plan_of, progress_of_ticks
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan, plan_positions
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.refinement import (
    DISAGREE,
    MOST_RUNS,
    NOISE_MM,
    RUNS,
    Measured,
    Refinement,
    Round,
    best_of,
    following,
    learn,
    repeat_noise_mm,
    smoothed,
)
from tests.genetic import hand
from tests.host.doubles import refused

LINE = Line(hand.A, hand.B, 5.0)
ROBOT = hand.robot()


@cache
def ways() -> np.ndarray:
    return line_paths(DrivenArm(hand.arm(), ROBOT, 0.1), LINE, np.random.default_rng(0), most=24)


class Scripted:
    """An arm that is off by what the test says, run by run, whatever the plan; then for ever by the last."""

    arm, robot, period_s = hand.arm(), ROBOT, 0.1
    goals_rad = tuple(joint.rest_rad for joint in hand.arm().joints)

    def __init__(self, *off_rad: float) -> None:
        self.off_rad = list(off_rad)
        self.plans: list[Plan] = []

    def use(self, model: LagModel) -> None:
        raise NotImplementedError

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        time_s: np.ndarray = np.arange(51) * 0.1
        s = time_law(time_s / 5.0)
        q = np.column_stack([joint_path(ways()[0], np.linspace(0.0, 1.0, 41), s, "cubic"), np.zeros(51)])
        q[:, 1] += self.off_rad[min(len(self.plans), len(self.off_rad) - 1)]
        self.plans.append(plan)
        return Measured(time_s, q, 5.0, "")


class Lagging(Scripted):
    """An arm whose joints stay behind every plan by a constant."""

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        time_s: np.ndarray = np.arange(51) * 0.1
        self.plans.append(plan)
        q = plan_positions(plan, time_s)
        q[:, :5] -= np.array([0.004, 0.03, -0.02, 0.01, 0.002])
        return Measured(time_s, q, 5.0, "")


def first(on: Scripted, via: int | None = None) -> Round:
    """The plan along the first way, before it is run."""
    knots = progress_of_ticks(51) if via is None else np.linspace(0.0, 1.0, via + 2)
    waypoints = joint_path(ways()[0], np.linspace(0.0, 1.0, 41), knots, "cubic")
    none = np.zeros((51, 5))
    kind: Interpolation = "linear" if via is None else "cubic"
    course = Course(LINE, kind, via is None, waypoints, knots, none, none[:, :3], np.zeros((len(knots), 1)))
    course = placed(on, course)
    return Round(0, course, plan_of(on, course, 0), corrected=True)


def refined(on: Scripted, rounds: int, further: int | None = None, via: int | None = None) -> list[Round]:
    work = Refinement(on, first(on, via), rounds, runs_left=lambda: further and 1 + further - len(on.plans))
    steps = work.steps()
    one = following(steps)
    while one is not None:
        one = following(steps, on.run(one.plan))
    return work.rounds


def test_rounds_end_by_themselves_once_they_are_no_better() -> None:
    rounds = refined(Scripted(0.02, 0.02, 0.01, 0.01, 0.011), 20)
    assert [one.kept for one in rounds] == [True, True, False, False]
    assert [len(one.runs) for one in rounds] == [2, 2, 1, 1]
    assert best_of(rounds) is rounds[1]


def test_a_plan_that_is_better_once_by_luck_is_not_kept() -> None:
    lucky_once, within_noise = (0.01, 0.01, 0.004, 0.016), (0.01, 0.0103, 0.0099, 0.0099)
    for off_rad in (lucky_once, within_noise):
        assert [one.kept for one in refined(Scripted(*off_rad), 1)] == [True, False]


def test_runs_of_one_plan_that_disagree_ask_for_a_third_and_two_of_three_count() -> None:
    begun, lucky = refined(Scripted(0.004, 0.02, 0.02, 0.01, 0.03, 0.01), 1)
    assert [len(begun.runs), len(lucky.runs)] == [3, 3]
    assert begun.filtered_mm == begun.run_mm[1] == pytest.approx(begun.run_mm[2])
    assert lucky.kept
    assert lucky.filtered_mm == pytest.approx(lucky.run_mm[0])


def test_a_jump_in_one_run_neither_counts_as_noise_nor_is_it_learnt() -> None:
    on = Scripted(0.02, 0.004, 0.02)
    jumped, steady = refined(on, 0)[0], refined(Scripted(0.02), 0)[0]
    assert len(jumped.runs) == 3
    assert repeat_noise_mm([jumped]) < NOISE_MM
    learnt, wanted = (learn(on, one, 0.8) for one in (jumped, steady))
    np.testing.assert_allclose(learnt.lag_rad, wanted.lag_rad, atol=1e-12)


@given(st.lists(st.floats(0.001, 0.03), min_size=2, max_size=12))
@settings(max_examples=15)
def test_whatever_the_arm_does_kept_plans_get_better_and_the_last_of_them_is_the_outcome(off_rad: list[float]) -> None:
    rounds = refined(Scripted(*off_rad), 4)
    kept = [one.filtered_mm for one in rounds if one.kept]
    assert all(after < before for before, after in pairwise(kept))
    assert best_of(rounds).filtered_mm == kept[-1] == min(kept)
    assert all(RUNS <= len(one.runs) <= MOST_RUNS for one in rounds if one.kept)
    assert len(rounds) <= 5


def test_the_repeat_noise_is_that_of_the_readings_of_one_plan() -> None:
    off = 0.01 + 0.0005 * np.random.default_rng(0).standard_normal(400)
    on = Scripted(*off.tolist())
    begun = first(on)
    rounds = []
    for _ in range(100):
        runs = tuple(on.run(begun.plan) for _ in range(2))
        rounds.append(begun._replace(runs=runs, run_mm=tuple(refinement.seen_mm(on, begun, run) for run in runs)))
    runs_mm = [run_mm for one in rounds for run_mm in one.run_mm]
    assert repeat_noise_mm(rounds) == pytest.approx(np.std(runs_mm), rel=0.1)
    assert repeat_noise_mm([]) == pytest.approx(NOISE_MM)


def test_smoothing_keeps_what_is_constant_and_averages_noise() -> None:
    np.testing.assert_allclose(smoothed(np.full((51, 2), 3.0), 0.1), 3.0)
    assert smoothed(np.random.default_rng(0).standard_normal((501, 1)), 0.1).std() < 0.5


@pytest.fixture
def figures(monkeypatch: pytest.MonkeyPatch) -> list[float]:
    """What the runs are judged by from now on, in order [mm]."""
    seen: list[float] = []
    monkeypatch.setattr(refinement, "seen_mm", lambda *_: seen.pop(0))
    return seen


def test_a_correction_that_did_not_help_is_tried_again_from_the_kept_plan_at_half_the_gain(
    monkeypatch: pytest.MonkeyPatch, figures: list[float]
) -> None:
    figures += [9.0, 9.0, 5.0, 5.0, 8.0, 3.0, 3.0, 6.0, 6.0]  # kept, kept, worse, kept, worse, worse
    gains = []

    def learnt(_on: object, last: Round, gain: float) -> Course:
        assert last.kept
        gains.append(gain)
        return last.course

    monkeypatch.setattr(refinement, "learn", learnt)
    refined(Scripted(0.01), 5)
    assert gains == [0.8, 0.6, 0.25, 0.4, 0.175]


# ------------------------------------------------------------------------------------- runs that are counted


@given(st.lists(st.floats(0.001, 0.03), min_size=1, max_size=12), st.integers(1, 8))
@settings(max_examples=15)
def test_no_more_runs_are_made_than_were_granted_and_kept_plans_get_better(off_rad: list[float], further: int) -> None:
    on = Scripted(*off_rad)
    rounds = refined(on, further, further)
    assert 2 <= len(on.plans) <= 1 + further
    assert len(on.plans) == sum(len(one.runs) for one in rounds)
    kept = [one.filtered_mm for one in rounds if one.kept]
    assert all(after < before for before, after in pairwise(kept))


def test_one_run_is_enough_to_correct_a_lag_that_nobody_foresaw() -> None:
    before, after = refined(Lagging(), 1, 1, via=2)
    assert (before.kept, after.kept) == (True, True)
    assert after.filtered_mm < 0.35 * before.filtered_mm


@pytest.mark.parametrize("via", [2, None])
def test_a_joint_that_hardly_moves_is_led_elsewhere_as_a_whole_and_by_nothing_that_comes_and_goes(
    via: int | None,
) -> None:
    """The base along a radial line: it stands off by a constant, and seems to swing."""
    line, on = Line(np.array([0.16, 0.0, 0.1]), np.array([0.24, 0.0, 0.1]), 5.0), Lagging()
    [way] = line_paths(on, line, np.random.default_rng(0), most=1)
    knots = progress_of_ticks(51) if via is None else np.linspace(0.0, 1.0, via + 2)
    course = placed(
        on,
        first(on, via).course._replace(line=line, waypoints=joint_path(way, np.linspace(0.0, 1.0, 41), knots, "cubic")),
    )
    one = Round(0, course, plan_of(on, course, 0), corrected=True)
    run = on.run(one.plan)
    run.positions_rad[:, 0] += 0.003 * np.sin(run.time_s * 2.0 * np.pi / 2.5)
    after = learn(on, one._replace(runs=(run,)), 0.5)
    np.testing.assert_allclose((after.waypoints - course.waypoints)[:, 0], 0.5 * 0.004, atol=2e-4)


def test_a_plan_that_is_better_by_far_is_not_repeated_where_runs_are_counted(figures: list[float]) -> None:
    clear, doubtful = 9.0 - 1.1 * DISAGREE * NOISE_MM, 9.0 - 0.9 * DISAGREE * NOISE_MM
    figures += [9.0, clear, clear]
    assert [len(one.runs) for one in refined(Scripted(0.01), 1, 4)] == [1, 1]
    figures[:] = [9.0, doubtful, doubtful]
    assert [len(one.runs) for one in refined(Scripted(0.01), 1, 4)] == [1, 2]


@pytest.mark.parametrize("via", [0, 1, 2, 8, None])
def test_a_corrected_plan_stays_the_interpolation_of_as_many_points(via: int | None) -> None:
    on = Lagging()
    refined(on, 3, 3, via=via)
    begun, *others = on.plans
    kept = ("arm_id", "calibration_hash", "from_m", "to_m", "duration_s", "via", "interpolation", "waypoint_progress")
    limits = np.array([joint.limits_rad for joint in on.arm.joints])
    for plan in others:
        assert [getattr(plan, name) for name in kept] == [getattr(begun, name) for name in kept]
        assert plan.waypoints_rad != begun.waypoints_rad
        q = np.array(plan.waypoints_rad)
        assert (limits[:, 0] <= q).all()
        assert (q <= limits[:, 1]).all()


@pytest.mark.parametrize("via", [0, 2, None])
def test_a_plan_is_the_plan_of_its_course(via: int | None) -> None:
    plan = first(Scripted(0.0), via).plan
    gripping = [(*q[:5], 0.1 * i) for i, q in enumerate(plan.waypoints_rad)]
    plan = plan.model_copy(update={"waypoints_rad": tuple(gripping)})
    course = course_of(Scripted(0.0), plan)
    assert course.stream == (via is None)
    again = plan_of(Scripted(0.0), course, plan.seed)
    assert again.waypoints_rad == plan.waypoints_rad
    assert again.waypoint_progress == plan.waypoint_progress


def test_a_via_point_is_led_where_the_tool_is_to_be_and_the_rest_stays() -> None:
    on = Scripted(0.0)
    plan, chain = first(on, 2).plan, on.robot.chain
    was = np.array(plan.waypoints_rad)
    wanted = tool_position(chain, was[2, : chain.n]) + np.array([0.004, -0.003, 0.012])
    led = bent(on, plan, 2, wanted)
    now = np.array(led.waypoints_rad)
    np.testing.assert_allclose(tool_position(chain, now[2, : chain.n]), wanted, atol=1e-9)
    assert abs(now[2] - was[2]).max() < 0.2, "by the posture nearest to its own"
    np.testing.assert_array_equal(now[[0, 1, 3]], was[[0, 1, 3]])
    assert led.predicted_mean_error_mm > plan.predicted_mean_error_mm
    with refused("POINT"):
        bent(on, plan, 3, wanted)
    with pytest.raises(UnreachableTarget):
        bent(on, plan, 1, [0.9, 0.0, 0.1])


def test_a_correction_that_leads_astray_ends_it_and_what_there_is_stays() -> None:
    on = Lagging()
    work = Refinement(on, first(on, 2), 3, runs_left=lambda: 4 - len(on.plans))
    steps = work.steps()
    one = following(steps)
    assert one is not None
    one = following(steps, on.run(one.plan))
    assert following(steps, RequestRefused("LIMIT", "beyond")) is None
    assert work.best is work.rounds[0]


def test_a_stop_ends_it_and_what_there_is_stays() -> None:
    on = Lagging()
    work = Refinement(on, first(on, 2), 3, runs_left=lambda: 4 - len(on.plans))
    steps = work.steps()
    one = following(steps)
    assert one is not None
    assert following(steps, on.run(one.plan)) is not None
    with refused("STOPPED"):
        following(steps, RequestRefused("STOPPED", "stopped"))
    assert work.best is work.rounds[0]
