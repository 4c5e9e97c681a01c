from dataclasses import replace
from functools import cache
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics.chain import tool_position
from armctl.lab import correction
from armctl.lab.course import UNKNOWN_HEAVIEST_RAD, Course, Line, courses, plan_of, too_heavy
from armctl.lab.line_experiment import Budget, experiment, run_rounds
from armctl.lab.line_results import true_mm
from armctl.lab.rig import Measured, VirtualRig
from armctl.messages import LagModel
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory import lag
from armctl.trajectory.interpolate import joint_path, time_law
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan, plan_from_text, plan_positions, plan_to_text
from armctl.trajectory.straightness import distance_to_line
from proving.line_trials import via_speed_ratio
from tests.genetic import hand
from tests.host.doubles import refused
from tests.lab.daemon import true_path
from tests.trajectory.test_plan import make_plan

LINE = Line(hand.A, hand.B, 5.0)
ROBOT = hand.robot()


def rig(seed: int = 2) -> VirtualRig:
    return VirtualRig(SimulatedArm(hand.arm(), seed=seed, spec=RANDOM_SPEC))


@pytest.fixture
def on() -> VirtualRig:
    return rig()


@cache
def ways() -> np.ndarray:
    return line_paths(hand.arm(), ROBOT, LINE.A, LINE.B, LINE.duration_s, np.random.default_rng(0), most=24)


def first_run(on: VirtualRig, via: int | None, known: LagModel | None = None) -> correction.Round:
    return correction.first_run(on, courses(on, LINE, via, ways()), known, 0, corrected=False)


def model(gravity_share: float = 1.0) -> LagModel:
    """The nominal arm's, of another weight."""
    plain = lag.nominal(hand.arm(), ROBOT.chain)
    return replace(plain, rows=tuple((*[gravity_share * g for g in row[:5]], *row[5:]) for row in plain.rows))


@pytest.mark.parametrize("via", [2, None])
def test_an_arm_nobody_has_measured_gets_straight_by_its_own_encoders(on: VirtualRig, via: int | None) -> None:
    first = first_run(on, via)
    rounds = correction.refine(on, first, 4)
    assert [one.number for one in rounds] == list(range(len(rounds)))
    before, better, best = (true_mm(one.measured, LINE)[0] for one in (first, rounds[1], correction.best_of(rounds)))
    assert before > 8.0
    assert better < 0.5 * before
    assert best < 1.6


def test_the_plan_of_a_round_is_a_plain_plan_that_text_keeps(on: VirtualRig) -> None:
    for via in (None, 0, 3):
        plan = plan_of(on, next(courses(on, LINE, via, ways())), 7)
        assert plan.via == (49 if via is None else via)
        assert plan_from_text(plan_to_text(plan), "plan") == plan


def test_a_stream_has_a_goal_for_every_tick_exactly(on: VirtualRig) -> None:
    course = next(courses(on, LINE, None, ways()))
    q = plan_positions(plan_of(on, course, 0), np.arange(51) * np.float64(0.1))
    np.testing.assert_allclose(q[:, :5], course.waypoints, atol=1e-9)


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


def begun(on: Scripted) -> correction.Round:
    course = next(courses(on, LINE, None, ways()[:1]))
    return correction.run(on, course, plan_of(on, course, 0), 0)


def refined(on: Scripted, rounds: int) -> list[correction.Round]:
    return correction.refine(on, begun(on), rounds)


def test_rounds_end_by_themselves_once_they_are_no_better() -> None:
    rounds = refined(Scripted(0.02, 0.02, 0.01, 0.01, 0.011), 20)
    assert [(one.kept, len(one.runs)) for one in rounds] == [(True, 2), (True, 2), (False, 1), (False, 1)]
    assert correction.best_of(rounds) is rounds[1]


def test_a_plan_that_is_better_once_by_luck_is_not_kept() -> None:
    lucky_once, within_noise = (0.01, 0.01, 0.004, 0.016), (0.01, 0.0103, 0.0099, 0.0099)
    for off_rad in (lucky_once, within_noise):
        assert [one.kept for one in refined(Scripted(*off_rad), 1)] == [True, False]


def test_runs_of_one_plan_that_disagree_ask_for_a_third_and_two_of_three_count() -> None:
    first, lucky = refined(Scripted(0.004, 0.02, 0.02, 0.01, 0.03, 0.01), 1)
    assert (len(first.runs), len(lucky.runs), lucky.kept) == (3, 3, True)
    assert first.filtered_mm == first.run_mm[1] == pytest.approx(first.run_mm[2])
    assert lucky.filtered_mm == pytest.approx(lucky.run_mm[0])


def test_a_jump_in_one_run_neither_counts_as_noise_nor_is_it_learnt() -> None:
    on = Scripted(0.02, 0.004, 0.02)
    jumped, steady = refined(on, 0)[0], refined(Scripted(0.02), 0)[0]
    assert len(jumped.runs) == 3
    assert correction.repeat_noise_mm([jumped]) < correction.NOISE_MM
    learnt, wanted = (correction.learn(on, one, 0.8) for one in (jumped, steady))
    np.testing.assert_allclose(learnt.lag_rad, wanted.lag_rad, atol=1e-12)


@given(st.lists(st.floats(0.001, 0.03), min_size=2, max_size=12))
@settings(max_examples=15)
def test_whatever_the_arm_does_kept_plans_get_better_and_the_last_of_them_is_the_outcome(off_rad: list[float]) -> None:
    rounds = refined(Scripted(*off_rad), 4)
    kept = [one.filtered_mm for one in rounds if one.kept]
    assert all(after < before for before, after in pairwise(kept))
    assert correction.best_of(rounds).filtered_mm == kept[-1] == min(kept)
    assert all(correction.RUNS <= len(one.runs) <= correction.MOST_RUNS for one in rounds if one.kept)
    assert len(rounds) <= 5


def test_the_repeat_noise_is_that_of_the_readings_of_one_plan() -> None:
    off = 0.01 + 0.0005 * np.random.default_rng(0).standard_normal(400)
    on = Scripted(*off.tolist())
    rounds = [correction.again(on, begun(on)) for _ in range(100)]
    runs_mm = [run_mm for one in rounds for run_mm in one.run_mm]
    assert correction.repeat_noise_mm(rounds) == pytest.approx(np.std(runs_mm), rel=0.1)
    assert correction.repeat_noise_mm([]) == pytest.approx(correction.NOISE_MM)


def test_the_last_plan_that_was_kept_is_the_outcome_and_is_run_anew(on: VirtualRig) -> None:
    (outcome,) = experiment(on, LINE, [1], Budget(rounds=2, repeats=2, seed=0), model(), ways=ways())
    assert ([one.number for one in outcome.rounds], len(outcome.runs)) == ([0, 1, 2], 2)
    assert outcome.best is correction.best_of(outcome.rounds)
    assert outcome.runs[0] is not outcome.best.measured


def test_a_model_that_does_harm_is_left_aside(on: VirtualRig) -> None:
    rounds = run_rounds(on, LINE, None, Budget(rounds=3, repeats=0, seed=0), model(-1.0), ways())
    assert [one.number for one in rounds] == [0, 1, 2, 3]
    assert rounds[1].filtered_mm > rounds[0].filtered_mm
    assert [one.kept for one in rounds[:3]] == [True, False, True]
    assert correction.best_of(rounds).filtered_mm < 0.5 * rounds[0].filtered_mm


def test_a_line_too_heavy_for_the_motors_is_refused_before_anything_moves(on: VirtualRig) -> None:
    with refused("TOO_HEAVY", "behind its goal"):
        first_run(on, 2, model(8.0))


def test_an_arm_that_stands_close_to_what_it_can_carry_may_leave_by_a_little_more() -> None:
    stands = np.radians([-35.0, 51.5, -103.0, 67.0, 42.0, 0.0])
    there = stands - np.radians([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])
    twice = [np.tile(q[:5], (2, 1)) for q in (stands, there)]
    borne, most = (np.degrees(lag.heaviest_rad(model(), ROBOT.chain, q)[1]) for q in twice)
    assert borne < np.degrees(UNKNOWN_HEAVIEST_RAD) < most
    plan = make_plan(via=0, waypoints_rad=(tuple(stands), tuple(there)), waypoint_progress=(0.0, 1.0))
    on = Scripted(0.0)
    assert too_heavy(on, None, plan).startswith("shoulder would stay 5.")
    on.goals_rad = tuple(stands.tolist())
    assert too_heavy(on, None, plan) == ""


def test_a_joint_that_turns_around_makes_a_way_unfit_for_few_via_points(on: VirtualRig) -> None:
    course = next(courses(on, LINE, 2, ways()))
    off = distance_to_line(tool_position(ROBOT.chain, course.expected_rad), LINE.A, LINE.B)
    assert off.max() < 0.003
    steps = np.diff(course.expected_rad, axis=0)
    assert np.minimum(np.maximum(steps, 0.0).sum(axis=0), np.maximum(-steps, 0.0).sum(axis=0)).max() < np.radians(12.0)


def test_a_tool_seen_beside_where_the_encoders_have_it_is_brought_to_the_line(on: VirtualRig) -> None:
    aside = replace(LINE, unseen_m=np.tile([0.0, 0.0, 0.01], (5, 1)))
    tool = tool_position(ROBOT.chain, next(courses(on, aside, None, ways())).expected_rad)
    np.testing.assert_allclose(tool[:, 2], hand.A[2] - 0.01, atol=5e-4)


def test_smoothing_keeps_what_is_constant_and_averages_noise() -> None:
    np.testing.assert_allclose(correction.smoothed(np.full((51, 2), 3.0), 0.1), 3.0)
    assert correction.smoothed(np.random.default_rng(0).standard_normal((501, 1)), 0.1).std() < 0.5


def test_a_correction_that_did_not_help_is_tried_anew_from_the_kept_plan_at_half(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    on, gains = rig(), []
    first = first_run(on, 2)
    seen = iter([5.0, 8.0, 3.0, 6.0, 6.0])  # kept, worse, kept, worse, worse

    def learn(_rig: object, last: correction.Round, gain: float) -> Course:
        assert last.kept
        gains.append(gain)
        return last.course

    def run(_rig: object, course: Course, plan: Plan, number: int, *, corrected: bool) -> correction.Round:
        return replace(first, course=course, plan=plan, number=number, run_mm=(next(seen),))

    monkeypatch.setattr(correction, "learn", learn)
    monkeypatch.setattr(correction, "run", run)
    monkeypatch.setattr(correction, "again", lambda _rig, one: replace(one, runs=one.runs * 2, run_mm=one.run_mm * 2))
    correction.refine(on, replace(first, run_mm=(9.0, 9.0)), 5)
    assert gains == [0.8, 0.6, 0.25, 0.4, 0.175]


@pytest.mark.parametrize("seed", [2, 5])
def test_the_tool_does_not_slow_down_at_via_points_and_they_cost_no_time(seed: int) -> None:
    on = rig(seed)
    for via in (0, 1, 2, 5):
        first = first_run(on, via)
        assert via_speed_ratio(first.plan, first.measured) > (0.0 if via == 0 else 0.5)
        assert first.measured.duration_s == pytest.approx(LINE.duration_s, rel=0.02)


def test_a_tool_that_stops_at_a_via_point_is_seen(on: VirtualRig) -> None:
    first = first_run(on, 1)
    time_s, tool_m = true_path(first.measured)
    stopped_s = np.where(time_s < 2.4, time_s, np.where(time_s < 2.7, 2.4, time_s - 0.3))
    still = np.stack([np.interp(stopped_s, time_s, column) for column in tool_m.T], axis=1)
    (progress,) = first.plan.waypoint_progress[1:-1]
    assert progress == pytest.approx(0.5, abs=0.03)
    assert via_speed_ratio(first.plan, replace(first.measured, true_tool_m=still)) < 0.2
