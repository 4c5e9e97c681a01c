from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from armctl.errors import RequestRefused
from armctl.genetic.algorithm import DEFAULT, PAPER, Settings
from armctl.genetic.straight_line import StraightLineResult, optimize
from armctl.genetic.triple_cost import IntArray
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.plan import plan_from_text, plan_to_text, preflight
from armctl.trajectory.straightness import max_error, mean_error
from tests.genetic import hand

ARM, ROBOT = hand.arm(), hand.robot()
SMALL = replace(DEFAULT, population=300, generations=40)


def optimized(
    recordings: list[FloatArray],
    settings: Settings = SMALL,
    via: tuple[int, ...] = (),
    seed: int = 0,
    interpolation: Interpolation = "cubic",
) -> StraightLineResult:
    return optimize(
        recordings, ARM, ROBOT, hand.A, hand.B,
        via=via, duration_s=5.0, seed=seed, settings=settings, interpolation=interpolation,
    )  # fmt: skip


@pytest.fixture(scope="module")
def five() -> StraightLineResult:
    return optimized(hand.recordings(5, 0), DEFAULT, (0, 1, 2, 4))


def test_default_reaches_the_exact_optimum_of_five_recordings(five: StraightLineResult) -> None:
    assert five.feasible
    assert five.gap_ratio == pytest.approx(0.0, abs=1e-12)


def test_default_comes_within_5_percent_of_the_optimum_of_fifteen_recordings() -> None:
    result = optimized(hand.recordings(15, 1), DEFAULT)
    assert result.feasible
    assert 0.0 <= result.gap_ratio <= 0.05
    assert result.ga.mean_error_mm < 0.8 * min(line.mean_error_mm for line in result.baseline)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("settings", [SMALL, replace(PAPER, generations=40)])
def test_the_genetic_algorithm_never_beats_the_exact_search(settings: Settings, seed: int) -> None:
    result = optimized(hand.recordings(6, seed), settings, seed=seed)
    assert result.gap_ratio >= -1e-12


def test_a_path_is_made_of_recorded_genes_and_holds_both_ends(five: StraightLineResult) -> None:
    for path in (five.ga.path, five.exact):
        station = np.arange(50)
        picked = five.candidates.positions_rad[path.genes, station]
        assert np.array_equal(path.positions_rad[:, :5], picked[:, :5])
        assert np.array_equal(path.tool_m, tool_position(ROBOT.chain, path.positions_rad[:, :5]))
        np.testing.assert_allclose(path.tool_m[[0, -1]], [hand.A, hand.B], atol=1e-8)
        assert path.mean_error_mm == pytest.approx(float(mean_error(path.tool_m, hand.A, hand.B)) * 1e3)
        assert path.max_error_mm == pytest.approx(float(max_error(path.tool_m, hand.A, hand.B)) * 1e3)
        assert path.cost_mm == pytest.approx(path.mean_error_mm)  # no charges: it is feasible


def test_the_roll_joint_is_the_mean_of_the_recordings(five: StraightLineResult) -> None:
    mean = five.candidates.positions_rad[..., 5].mean(axis=0)
    np.testing.assert_allclose(five.ga.path.positions_rad[:, 5], mean, atol=1e-15)


def test_plans_begin_on_A_end_on_B_and_predict_what_they_simulate(five: StraightLineResult) -> None:
    assert [plan.via for plan in five.plans] == [0, 1, 2, 4]
    for plan, tool in zip(five.plans, five.plan_tool_m, strict=True):
        ends = tool_position(ROBOT.chain, np.array(plan.waypoints_rad)[[0, -1], :5])
        np.testing.assert_allclose(ends, [hand.A, hand.B], atol=1e-8)
        np.testing.assert_allclose(tool[[0, -1]], ends, atol=1e-12)
        assert plan.predicted_mean_error_mm == pytest.approx(float(mean_error(tool, hand.A, hand.B)) * 1e3)
        assert plan.predicted_max_error_mm == pytest.approx(float(max_error(tool, hand.A, hand.B)) * 1e3)
        assert plan_from_text(plan_to_text(plan), "line.plan") == plan


@pytest.mark.parametrize("interpolation", ["linear", "cubic"])
def test_every_plan_passes_pre_flight_from_the_rest_pose(interpolation: Interpolation) -> None:
    result = optimized(hand.recordings(5, 4), via=(0, 1, 2), interpolation=interpolation)
    for plan in result.plans:
        assert plan.interpolation == interpolation
        assert preflight(plan, ARM, ROBOT, [joint.rest_rad for joint in ARM.joints]) == ()


def test_via_points_make_the_motion_several_times_straighter(five: StraightLineResult) -> None:
    none, one, two, _ = (plan.predicted_mean_error_mm for plan in five.plans)
    assert none > 15.0
    assert one < 3.0
    assert two < 3.0


@pytest.mark.parametrize("settings", [SMALL, PAPER])
def test_same_seed_gives_the_same_bits(settings: Settings) -> None:
    recordings = hand.recordings(5, 2)
    first, second = (optimized(recordings, settings, (1,), seed=9) for _ in range(2))
    assert first.ga.best_cost_mm == second.ga.best_cost_mm
    assert first.ga.mean_cost_mm == second.ga.mean_cost_mm
    assert np.array_equal(first.ga.path.genes, second.ga.path.genes)
    assert first.plans == second.plans


def test_progress_is_told_after_every_generation_and_kept_as_history() -> None:
    told: list[tuple[int, float, float]] = []
    settings = replace(SMALL, generations=10)
    result = optimize(
        hand.recordings(3, 5), ARM, ROBOT, hand.A, hand.B,
        via=(), duration_s=3.0, seed=1, settings=settings, progress=lambda *args: told.append(args),
    )  # fmt: skip
    assert [generation for generation, _, _ in told] == list(range(1, 11))
    assert tuple(best for _, best, _ in told) == result.ga.best_cost_mm
    assert tuple(mean for _, _, mean in told) == result.ga.mean_cost_mm
    assert result.ga.generations == 10
    assert result.ga.evaluations == 3000
    assert result.ga.best_cost_mm[-1] == pytest.approx(result.ga.path.cost_mm)
    assert len(result.ga.path.genes) == 30


def test_one_recording_alone_is_its_own_optimum() -> None:
    result = optimized(hand.recordings(1, 6))
    assert result.gap_ratio == 0.0
    assert result.ga.mean_error_mm == result.baseline[0].mean_error_mm


def test_recordings_too_different_to_combine_are_not_mixed() -> None:
    # The same line with the elbow bent the other way: tens of degrees apart everywhere.
    flipped = hand.recordings(2, 7, posture=hand.FLIPPED)
    result = optimized([*hand.recordings(2, 7), *flipped])
    assert result.feasible
    groups: IntArray = result.ga.path.genes // 2
    assert len(set(groups.tolist())) == 1


def test_when_no_path_keeps_the_limits_the_result_says_so() -> None:
    slow = ARM.model_copy(update={"joints": tuple(j.model_copy(update={"speed_limit_deg_s": 5.0}) for j in ARM.joints)})
    result = optimize(
        hand.recordings(3, 8), slow, ROBOT, hand.A, hand.B, via=(1,), duration_s=2.0, seed=0, settings=SMALL
    )
    assert not result.feasible
    assert not result.exact.feasible
    assert result.ga.path.cost_mm > result.ga.mean_error_mm
    assert result.gap_ratio >= -1e-12


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"via": (-1,)}, "-1 via points wanted; give 0 to 20"),
        ({"via": (1, 21)}, "21 via points"),
        ({"duration_s": 0.0}, "duration 0.0 s"),
        ({"duration_s": float("nan")}, "duration nan s"),
        ({"seed": -1}, "seed -1"),
        ({"A": (0.1, 0.2)}, "A is .* three finite numbers"),
        ({"B": (0.1, 0.2, float("nan"))}, "B is .* three finite numbers"),
        ({"A": (0.18, -0.125, -0.01)}, r"A lies at height -0\.010 m, below the floor"),
    ],
)
def test_an_unfit_request_is_refused(changes: dict[str, object], match: str) -> None:
    arguments = {"A": hand.A, "B": hand.B, "via": (1,), "duration_s": 5.0, "seed": 0} | changes
    A, B = arguments.pop("A"), arguments.pop("B")
    with pytest.raises(RequestRefused, match=match):
        optimize(hand.recordings(1, 0), ARM, ROBOT, A, B, **arguments)  # type: ignore[arg-type]


def test_every_fault_of_a_request_is_named_at_once() -> None:
    with pytest.raises(RequestRefused) as caught:
        optimize([], ARM, ROBOT, hand.A, hand.B - [0, 0, 1], via=(-1,), duration_s=-1.0, seed=-1)
    assert len(caught.value.reasons) == 4
