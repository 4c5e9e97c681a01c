from dataclasses import replace

import numpy as np
import pytest

from armctl.kinematics.chain import tool_position
from armctl.lab import correction
from armctl.lab.course import UNKNOWN_HEAVIEST_RAD, courses, too_heavy
from armctl.lab.line_experiment import Budget, experiment, run_rounds
from armctl.lab.line_results import true_mm
from armctl.lab.rig import VirtualRig
from armctl.lab.stage import silent
from armctl.messages import LagModel
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory import lag
from armctl.trajectory.course import plan_of
from armctl.trajectory.plan import plan_from_text, plan_positions, plan_to_text
from armctl.trajectory.refinement import Round, best_of
from armctl.trajectory.straightness import distance_to_line
from proving.line_trials import via_speed_ratio
from tests.genetic import hand
from tests.host.doubles import refused
from tests.trajectory.test_plan import make_plan
from tests.trajectory.test_refinement import LINE, Scripted, ways

ROBOT = hand.robot()


def rig(seed: int = 2) -> VirtualRig:
    return VirtualRig(SimulatedArm(hand.arm(), seed=seed, spec=RANDOM_SPEC))


@pytest.fixture
def on() -> VirtualRig:
    return rig()


def first_run(on: VirtualRig, via: int | None, known: LagModel | None = None) -> Round:
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
    before, better, best = (true_mm(one.measured, LINE)[0] for one in (first, rounds[1], best_of(rounds)))
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


def test_the_last_plan_that_was_kept_is_the_outcome_and_is_run_anew(on: VirtualRig) -> None:
    (outcome,) = experiment(on, LINE, [1], Budget(rounds=2, repeats=2, seed=0), model(), ways(), silent)
    assert [one.number for one in outcome.rounds] == [0, 1, 2]
    assert outcome.best is best_of(outcome.rounds)
    assert len(outcome.runs) == 2
    assert outcome.runs[0] is not outcome.best.measured


def test_a_model_that_does_harm_is_left_aside(on: VirtualRig) -> None:
    offered, budget = courses(on, LINE, None, ways()), Budget(rounds=3, repeats=0, seed=0)
    rounds = run_rounds(on, offered, budget, model(-1.0), lambda _done, _note: None)
    assert [one.number for one in rounds] == [0, 1, 2, 3]
    assert rounds[1].filtered_mm > rounds[0].filtered_mm
    assert [one.kept for one in rounds[:3]] == [True, False, True]
    assert best_of(rounds).filtered_mm < 0.5 * rounds[0].filtered_mm


def test_a_line_too_heavy_for_the_motors_is_refused_before_anything_moves(on: VirtualRig) -> None:
    with refused("TOO_HEAVY", "behind its goal"):
        first_run(on, 2, model(8.0))


def test_an_arm_that_stands_close_to_what_it_can_carry_may_leave_by_a_little_more() -> None:
    stands = np.radians([-35.0, 51.5, -103.0, 67.0, 42.0, 0.0])
    there = stands - np.radians([0.0, 1.5, 0.0, 0.0, 0.0, 0.0])
    borne, most = (
        np.degrees(lag.heaviest_rad(model(), ROBOT.chain, np.tile(q[:5], (2, 1)), 0.1)[1]) for q in (stands, there)
    )
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
    aside = LINE._replace(unseen_m=np.tile([0.0, 0.0, 0.01], (5, 1)))
    tool = tool_position(ROBOT.chain, next(courses(on, aside, None, ways())).expected_rad)
    np.testing.assert_allclose(tool[:, 2], hand.A[2] - 0.01, atol=5e-4)


@pytest.mark.parametrize("seed", [2, 5])
def test_the_tool_does_not_slow_down_at_via_points_and_they_cost_no_time(seed: int) -> None:
    on, durations_s = rig(seed), []
    for via in (0, 1, 2, 5):
        first = first_run(on, via)
        assert via_speed_ratio(first.plan, first.measured) > (0.0 if via == 0 else 0.5)
        durations_s.append(first.measured.duration_s)
    assert durations_s == pytest.approx([LINE.duration_s] * 4, rel=0.02)


def test_a_tool_that_stops_at_a_via_point_is_seen(on: VirtualRig) -> None:
    first = first_run(on, 1)
    time_s, tool_m = first.measured.true_time_s, first.measured.true_tool_m
    assert time_s is not None
    assert tool_m is not None
    stopped_s = np.where(time_s < 2.4, time_s, np.where(time_s < 2.7, 2.4, time_s - 0.3))
    still = np.stack([np.interp(stopped_s, time_s, column) for column in tool_m.T], axis=1)
    (progress,) = first.plan.waypoint_progress[1:-1]
    assert progress == pytest.approx(0.5, abs=0.03)
    assert via_speed_ratio(first.plan, first.measured._replace(true_tool_m=still)) < 0.2
