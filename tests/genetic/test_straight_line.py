"""The straight line as a whole: optimum, genetic algorithm, free genes, plans, and what is refused."""

from collections.abc import Callable
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest

from armctl.config import ArmConfig, validate
from armctl.errors import ConfigError
from armctl.genetic import free_path as module
from armctl.genetic.algorithm import DEFAULT, PAPER, Settings
from armctl.genetic.alignment import MOST_CANDIDATES
from armctl.genetic.free_path import MOST_OFFSET_RAD, free_path
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import StraightLineResult, optimize
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray, IntArray
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.placement import POWER, Objective
from armctl.trajectory.plan import plan_from_text, plan_to_text, preflight
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.straightness import distance_to_line, errors_mm, mean_error
from armctl.trajectory.via_points import predict_tool_path
from tests.genetic import hand
from tests.host.doubles import refused
from tests.trajectory.conftest import CHAIN, LIMITS

ARM, ROBOT = hand.arm(), hand.robot()
SMALL = replace(DEFAULT, population=60, generations=40)
OBJECTIVES: tuple[Objective, ...] = ("mean", "mix", "max")


def request(**changes: Any) -> OptimizeRequest:
    """The hand's line, with something else about it."""
    line = {"from_m": hand.A.tolist(), "to_m": hand.B.tolist(), "via": (), "settings": SMALL}
    return validate(OptimizeRequest, {**line, **changes}, "optimize")


def optimized(recordings: list[FloatArray], arm: ArmConfig = ARM, **changes: Any) -> StraightLineResult:
    return optimize(recordings, arm, ROBOT, request(**changes))


@pytest.fixture(scope="module")
def five() -> StraightLineResult:
    return optimized(hand.recordings(5, 0), settings=DEFAULT, via=(0, 1, 2, 4))


def test_default_reaches_the_exact_optimum_of_five_recordings(five: StraightLineResult) -> None:
    assert five.feasible
    assert five.gap_ratio == pytest.approx(0.0, abs=1e-12)


@pytest.mark.parametrize("count", [7, 10, 15, 20])
def test_default_comes_within_1_percent_of_the_optimum(count: int) -> None:
    result = optimized(hand.recordings(count, count), settings=DEFAULT)
    assert result.feasible
    assert -1e-12 <= result.gap_ratio <= 0.01
    assert result.ga.path.mean_error_mm < 0.8 * min(line.mean_error_mm for line in result.baseline)


def test_evolution_without_a_table_to_search_in_falls_short_of_it() -> None:
    assert optimized(hand.recordings(15, 15), settings=replace(PAPER, generations=100)).gap_ratio > 0.01


def test_free_genes_are_straighter_than_any_recorded_ones_and_keep_the_same_limits(five: StraightLineResult) -> None:
    assert five.free is not None
    assert five.free.mean_error_mm < 0.05 * five.exact.mean_error_mm
    assert five.free.feasible
    assert 0.0 < five.free.largest_offset_rad <= MOST_OFFSET_RAD + 1e-12
    np.testing.assert_array_equal(five.free.positions_rad[[0, -1], :5], five.ga.path.positions_rad[[0, -1], :5])
    np.testing.assert_array_equal(five.free.tool_m, tool_position(ROBOT.chain, five.free.positions_rad[:, :5]))


def test_the_paper_s_procedure_plans_with_recorded_genes_alone(five: StraightLineResult) -> None:
    bound = optimized(hand.recordings(5, 0), via=(0, 1, 2), settings=DEFAULT, free=False)
    assert bound.free is None
    for plan, free in zip(bound.plans, five.plans, strict=False):
        for waypoint in plan.waypoints_rad:
            assert (np.abs(bound.ga.path.positions_rad - np.array(waypoint)).max(axis=1) == 0.0).any()
        assert plan.via == 0 or free.predicted_mean_error_mm <= plan.predicted_mean_error_mm + 1e-9
    assert five.plans[2].predicted_mean_error_mm < 0.5 * bound.plans[2].predicted_mean_error_mm


def test_each_objective_is_best_at_what_it_makes_small() -> None:
    recordings = hand.recordings(8, 11)
    paths = {each: optimized(recordings, objective=each, free=False).exact for each in OBJECTIVES}
    errors = {objective: distance_to_line(path.tool_m, hand.A, hand.B) for objective, path in paths.items()}
    for objective, power in POWER.items():
        norms = {other: float((distance**power).mean()) for other, distance in errors.items()}
        assert norms[objective] == pytest.approx(min(norms.values()), rel=1e-9)
        own = norms[objective] ** (1.0 / power) * 1e3
        assert paths[objective].cost_mm == pytest.approx(own)
    assert paths["max"].max_error_mm <= paths["mean"].max_error_mm


def test_a_stalled_run_goes_on_from_the_recordings_and_never_loses_its_best() -> None:
    settings = replace(SMALL, generations=120)
    stalled, plain = (
        optimized(hand.recordings(6, 3), settings=replace(settings, stall_generations=some)).ga for some in (3, 0)
    )
    assert list(stalled.best_cost_mm) == sorted(stalled.best_cost_mm, reverse=True)
    # A fresh start shows as a rise of the mean; a run that never restarts rises at its three changes of charges only.
    rises = [sum(b > 1.5 * a for a, b in pairwise(run.mean_cost_mm)) for run in (stalled, plain)]
    assert rises[0] > 3 >= rises[1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("settings", [SMALL, replace(PAPER, generations=40)])
def test_the_genetic_algorithm_never_beats_the_exact_search(settings: Settings, seed: int) -> None:
    assert optimized(hand.recordings(6, seed), settings=settings, seed=seed).gap_ratio >= -1e-12


def test_a_path_is_made_of_recorded_genes_and_holds_both_ends(five: StraightLineResult) -> None:
    for path in (five.ga.path, five.exact):
        picked = five.candidates.positions_rad[path.genes, np.arange(50)]
        assert np.array_equal(path.positions_rad[:, :5], picked[:, :5])
        assert np.array_equal(path.tool_m, tool_position(ROBOT.chain, path.positions_rad[:, :5]))
        np.testing.assert_allclose(path.tool_m[[0, -1]], [hand.A, hand.B], atol=1e-8)
        assert path.mean_error_mm == pytest.approx(float(mean_error(path.tool_m, hand.A, hand.B)) * 1e3)
        assert path.max_error_mm == pytest.approx(errors_mm(path.tool_m, hand.A, hand.B)[1])
        assert path.cost_mm == pytest.approx(path.mean_error_mm)  # no charges: it is feasible


def test_the_roll_joint_is_the_mean_of_the_recordings(five: StraightLineResult) -> None:
    mean = five.candidates.positions_rad[:5, :, 5].mean(axis=0)
    np.testing.assert_allclose(five.ga.path.positions_rad[:, 5], mean, atol=1e-15)


def test_plans_begin_on_A_end_on_B_and_predict_what_they_simulate(five: StraightLineResult) -> None:
    assert [plan.via for plan in five.plans] == [0, 1, 2, 4]
    for plan in five.plans:
        waypoints, knots = np.array(plan.waypoints_rad)[:, :5], np.array(plan.waypoint_progress)
        tool = predict_tool_path(ROBOT.chain, waypoints, knots, plan.interpolation)
        ends = tool_position(ROBOT.chain, np.array(plan.waypoints_rad)[[0, -1], :5])
        np.testing.assert_allclose(ends, [hand.A, hand.B], atol=1e-8)
        np.testing.assert_allclose(tool[[0, -1]], ends, atol=1e-12)
        assert plan.predicted_mean_error_mm == pytest.approx(float(mean_error(tool, hand.A, hand.B)) * 1e3)
        assert plan.predicted_max_error_mm == pytest.approx(errors_mm(tool, hand.A, hand.B)[1])
        assert plan_from_text(plan_to_text(plan), "line.plan") == plan


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_every_plan_passes_pre_flight_from_the_rest_pose(interpolation: Interpolation) -> None:
    for plan in optimized(hand.recordings(5, 4), via=(0, 1, 2), interpolation=interpolation).plans:
        assert plan.interpolation == interpolation
        assert preflight(plan, DrivenArm(ARM, ROBOT, 0.1), [joint.rest_rad for joint in ARM.joints]) == ()


def test_via_points_make_the_motion_several_times_straighter(five: StraightLineResult) -> None:
    none, one, two, _ = (plan.predicted_mean_error_mm for plan in five.plans)
    assert max(one, two) < 3.0 < 15.0 < none


@pytest.mark.parametrize("settings", [SMALL, PAPER])
def test_same_seed_gives_the_same_bits(settings: Settings) -> None:
    recordings = hand.recordings(5, 2)
    first, second = (optimized(recordings, settings=settings, via=(1,), seed=9) for _ in range(2))
    for told in ("best_cost_mm", "mean_cost_mm"):
        assert getattr(first.ga, told) == getattr(second.ga, told)
    assert np.array_equal(first.ga.path.genes, second.ga.path.genes)
    assert first.plans == second.plans


def test_progress_is_told_after_every_generation_and_kept_as_history() -> None:
    told: list[tuple[int, float, float]] = []
    asked = request(duration_s=3.0, seed=1, settings=replace(SMALL, generations=10))
    result = optimize(hand.recordings(3, 5), ARM, ROBOT, asked, lambda *args: told.append(args))
    assert told == list(zip(range(1, 11), result.ga.best_cost_mm, result.ga.mean_cost_mm, strict=True))
    assert (result.ga.generations, result.ga.evaluations, len(result.ga.path.genes)) == (10, 600, 30)
    assert result.ga.best_cost_mm[-1] == pytest.approx(result.ga.path.cost_mm)


def test_every_station_counts_for_each_take_that_its_gene_is_made_of(five: StraightLineResult) -> None:
    used = five.candidates.takes[five.ga.path.genes].tolist()
    assert [take.genes for take in five.baseline] == [sum(take in pair for pair in used) for take in range(5)]
    bound = optimized(hand.recordings(5, 0), free=False)
    assert sum(take.genes for take in bound.baseline) == len(bound.ga.path.genes)


def test_a_blend_is_the_mean_of_two_takes_whose_ends_are_put_on_A_and_B(five: StraightLineResult) -> None:
    q, takes = five.candidates.positions_rad, five.candidates.takes
    assert takes.tolist() == [[take, take] for take in range(5)] + [list(pair) for pair in takes.tolist()[5:]]
    assert sorted(map(sorted, takes.tolist()[5:])) == [[a, b] for a in range(5) for b in range(a + 1, 5)]
    np.testing.assert_allclose(q[5:, 1:-1], q[takes[5:], 1:-1].mean(axis=1), atol=1e-15)
    for end, point in ((0, hand.A), (-1, hand.B)):
        np.testing.assert_allclose(five.candidates.tool_m[:, end], np.tile(point, (15, 1)), atol=1e-8)


@pytest.mark.parametrize("seed", range(3))
def test_a_path_that_changes_takes_as_fast_as_it_may_still_comes_onto_the_line(seed: int) -> None:
    result = optimized(hand.recordings(5, seed), settings=DEFAULT)
    assert result.free is not None
    assert result.free.feasible
    assert result.free.mean_error_mm < 0.01 < result.ga.path.mean_error_mm


@pytest.mark.parametrize("seed", range(3))
def test_evolution_begins_with_the_takes_and_blends_them_to_less_than_recorded_genes_reach(seed: int) -> None:
    takes = hand.recordings(5, seed)
    free, bound = (optimized(takes, settings=DEFAULT, free=free) for free in (True, False))
    assert free.ga.best_cost_mm[0] >= min(take.mean_error_mm for take in free.baseline)
    assert free.ga.path.mean_error_mm < 0.8 * bound.ga.path.mean_error_mm
    assert free.gap_ratio <= 0.01


@pytest.mark.parametrize("count", [7, 30])
def test_no_more_blends_are_made_than_the_tables_have_room_for_the_straightest_takes_first(count: int) -> None:
    result = optimized(hand.recordings(count, 1), settings=replace(SMALL, generations=4))
    pairs = result.candidates.takes[count:].tolist()
    assert len(pairs) == max(0, MOST_CANDIDATES - count)
    straightest = int(np.argmin([take.mean_error_mm for take in result.baseline]))
    assert all(straightest in pair for pair in pairs[: count - 1])


def test_one_recording_alone_is_its_own_optimum() -> None:
    result = optimized(hand.recordings(1, 6))
    assert result.gap_ratio == 0.0
    assert result.ga.path.mean_error_mm == result.baseline[0].mean_error_mm


def test_recordings_too_different_to_combine_are_not_mixed() -> None:
    # The same line with the elbow bent the other way: tens of degrees apart everywhere.
    flipped = hand.recordings(2, 7, hand.FLIPPED)
    result = optimized([*hand.recordings(2, 7), *flipped])
    assert result.feasible
    groups: IntArray = result.candidates.takes[result.ga.path.genes] // 2
    assert len(set(groups.ravel().tolist())) == 1


def test_when_no_path_keeps_the_limits_the_result_says_so() -> None:
    slow = ARM.model_copy(update={"joints": tuple(j.model_copy(update={"speed_limit_deg_s": 5.0}) for j in ARM.joints)})
    result = optimized(hand.recordings(3, 8), slow, via=(1,), duration_s=2.0)
    assert (result.feasible, result.exact.feasible) == (False, False)
    assert result.ga.path.cost_mm > result.ga.path.mean_error_mm
    assert result.gap_ratio >= -1e-12
    least_s = result.least_duration_s
    assert least_s is not None
    assert optimized(hand.recordings(3, 8), slow, duration_s=least_s).exact.feasible


@pytest.mark.parametrize(("changes", "match"), hand.refusals("requests"))
def test_an_unfit_request_is_refused_with_field_value_and_bound(changes: dict[str, object], match: str) -> None:
    with pytest.raises(ConfigError, match=match) as caught:
        request(**changes)
    assert str(caught.value).startswith("optimize: ")


def test_every_fault_of_a_request_is_named_at_once() -> None:
    with pytest.raises(ConfigError) as caught:
        request(from_m=(11.0, 0.0, 0.0), via=(-1,), duration_s=-1.0, seed=-1)
    assert [name in str(caught.value) for name in ("from_m.0", "via.0", "duration_s", "seed")] == [True] * 4


def test_each_end_below_the_floor_is_named() -> None:
    with refused("BAD_REQUEST") as caught:
        optimized([], from_m=(0.18, -0.125, -0.01), to_m=(0.18, 0.125, -1.0))
    found = [reason.split(",")[0] for reason in caught.value.reasons]
    assert found == ["A lies at height -0.010 m", "B lies at height -1.000 m"]


# ----------------------------------------------------------------------------------------------------------- free genes


PROGRESS = np.linspace(0.0, 1.0, 30)


def wobbly(seed: int, wobble_rad: float) -> FloatArray:
    line = hand.joint_line()
    path = np.stack([np.interp(PROGRESS * 64.0, range(65), joint) for joint in line.T], axis=1)
    path[1:-1] += np.random.default_rng(seed).uniform(-wobble_rad, wobble_rad, path[1:-1].shape)
    return path


def freed(
    path: FloatArray, limits: FloatArray = LIMITS, breaks: Callable[[FloatArray], float] = lambda _: 0.0
) -> FloatArray:
    return free_path(CHAIN, path, PROGRESS, (hand.A, hand.B), limits, breaks)


def error_mm(path: FloatArray) -> float:
    return float(mean_error(tool_position(CHAIN, path), hand.A, hand.B)) * 1e3


@pytest.mark.parametrize("seed", range(4))
def test_small_wobbles_vanish_within_the_bound_of_the_offsets_and_the_ends_stay(seed: int) -> None:
    path = wobbly(seed, 0.02)
    moved = freed(path)
    assert error_mm(path) > 1.0
    assert error_mm(moved) < 0.05
    assert np.abs(moved - path).max() <= MOST_OFFSET_RAD + 1e-12
    assert np.array_equal(moved[[0, -1]], path[[0, -1]])


def test_offsets_that_would_have_to_be_larger_are_cut_off_at_the_bound() -> None:
    path = wobbly(1, 0.0)
    path[1:-1, 1] += 0.3
    moved = freed(path)
    assert np.abs(moved - path).max() == pytest.approx(MOST_OFFSET_RAD)
    assert 0.0 < error_mm(moved) < error_mm(path)


def test_joint_limits_are_kept() -> None:
    path = wobbly(2, 0.02)
    tight = np.stack([path.min(axis=0), path.max(axis=0)], axis=1)
    moved = freed(path, tight)
    assert ((tight[:, 0] <= moved) & (moved <= tight[:, 1])).all()


def test_a_step_that_breaks_more_limits_is_not_taken() -> None:
    path = wobbly(3, 0.02)
    assert np.array_equal(freed(path, breaks=lambda q: float(not np.array_equal(q, path))), path)


def test_a_share_of_a_step_is_taken_where_the_whole_would_break_a_limit() -> None:
    path = wobbly(4, 0.02)
    whole = np.abs(freed(path) - path).max()

    def breaks(q: FloatArray) -> float:
        return float(np.abs(q - path).max() > 0.5 * whole)

    moved = freed(path, breaks=breaks)
    assert breaks(moved) == 0.0
    assert error_mm(moved) < error_mm(path)
    assert min(module.SHARES) < 0.5
