"""Via points that make the tool's motion straight, and what straight means."""

from itertools import combinations, product

import numpy as np
import pytest
from hypothesis import given

from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray, matrix_from_rpy
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.straightness import (
    best_line,
    distance_to_line,
    errors_mm,
    mean_error,
    own_chord_mm,
    progress_along_line,
)
from armctl.trajectory.via_points import SAMPLES, choose_via_points, predict_tool_path
from tests.genetic import hand
from tests.kinematics.conftest import seeds
from tests.trajectory.conftest import CHAIN

LINE = hand.joint_line()[::4]
PROGRESS = np.linspace(0.0, 1.0, len(LINE))


def error_mm(indices: tuple[int, ...], kind: Interpolation) -> float:
    kept = [0, *indices, len(LINE) - 1]
    return float(mean_error(predict_tool_path(CHAIN, LINE[kept], PROGRESS[kept], kind), hand.A, hand.B)) * 1e3


def chosen(count: int, kind: Interpolation, every: int = 1) -> tuple[int, ...]:
    return choose_via_points(CHAIN, LINE[::every], PROGRESS[::every], count, kind, (hand.A, hand.B))


@pytest.mark.parametrize("kind", ["linear", "cubic"])
@pytest.mark.parametrize("count", [1, 2])
def test_up_to_two_via_points_are_the_best_of_all_choices(kind: Interpolation, count: int) -> None:
    best = min(combinations(range(1, len(LINE) - 1), count), key=lambda indices: error_mm(indices, kind))
    assert error_mm(chosen(count, kind), kind) == error_mm(best, kind)


@pytest.mark.parametrize("count", [3, 5])
def test_no_exchange_of_one_via_point_improves_more_of_them(count: int) -> None:
    kept = chosen(count, "linear")
    assert len(set(kept)) == count
    assert list(kept) == sorted(kept)
    for old, new in product(kept, set(range(1, len(LINE) - 1)) - set(kept)):
        assert error_mm(tuple(sorted({*kept, new} - {old})), "linear") >= error_mm(kept, "linear")


def test_every_further_via_point_on_the_line_makes_it_straighter() -> None:
    errors = [error_mm(chosen(count, "linear"), "linear") for count in range(5)]
    assert errors == sorted(errors, reverse=True)
    assert errors[2] < 0.15 * errors[0]


def test_all_inner_points_and_none_are_possible_and_more_are_not() -> None:
    assert chosen(0, "cubic", every=4) == ()
    assert chosen(3, "cubic", every=4) == (1, 2, 3)
    with pytest.raises(ValueError, match="4 via points wanted from a path with 3"):
        chosen(4, "cubic", every=4)


def test_predicted_motion_begins_at_A_and_ends_at_B() -> None:
    tool = predict_tool_path(CHAIN, LINE[[0, 8, 16]], PROGRESS[[0, 8, 16]], "cubic")
    assert tool.shape == (SAMPLES, 3)
    np.testing.assert_allclose(tool[[0, -1]], tool_position(CHAIN, LINE[[0, 16]]), atol=1e-12)
    assert errors_mm(tool, hand.A, hand.B)[1] < 5.0


# --------------------------------------------------------------------------------------------------------- straightness


A, B = hand.A, hand.B


def line_and_points(seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    A = rng.uniform(-0.4, 0.4, 3)
    direction = rng.standard_normal(3)
    return A, A + direction / np.linalg.norm(direction) * rng.uniform(0.05, 0.5), rng.uniform(-0.4, 0.4, (3, 7, 3))


@given(seeds)
def test_distance_and_progress_are_those_of_the_perpendicular_foot(seed: int) -> None:
    A, B, points = line_and_points(seed)
    foot = A + progress_along_line(points, A, B)[..., None] * (B - A)
    np.testing.assert_allclose(distance_to_line(points, A, B), np.linalg.norm(points - foot, axis=-1), atol=1e-12)
    np.testing.assert_allclose(((points - foot) * (B - A)).sum(axis=-1), 0.0, atol=1e-12)


@given(seeds)
def test_swapping_the_ends_keeps_distance_and_mirrors_progress(seed: int) -> None:
    A, B, points = line_and_points(seed)
    np.testing.assert_allclose(distance_to_line(points, B, A), distance_to_line(points, A, B), atol=1e-12)
    np.testing.assert_allclose(progress_along_line(points, B, A), 1.0 - progress_along_line(points, A, B), atol=1e-9)


def test_points_on_the_line_even_beyond_its_ends_have_no_distance() -> None:
    points = A + np.array([-0.5, 0.0, 0.3, 1.0, 2.0])[:, None] * (B - A)
    np.testing.assert_allclose(distance_to_line(points, A, B), 0.0, atol=1e-15)
    np.testing.assert_allclose(progress_along_line(points, A, B), [-0.5, 0.0, 0.3, 1.0, 2.0], atol=1e-15)


def test_mean_and_max_error_of_a_known_path() -> None:
    points = np.array([[0.18, 0.0, 0.10], [0.19, 0.1, 0.10], [0.18, -0.1, 0.12]])
    assert float(mean_error(points, A, B)) == pytest.approx(0.01)
    assert errors_mm(points, A, B)[1] == pytest.approx(20.0)
    assert mean_error(np.stack([points, points]), A, B).shape == (2,)


def test_a_line_needs_two_points() -> None:
    with pytest.raises(ValueError, match="same point"):
        distance_to_line(np.zeros((4, 3)), A, A)
    with pytest.raises(ValueError, match="x, y, z"):
        progress_along_line(np.zeros((4, 2)), A, B)


# ------------------------------------------------------------------------------------------------- a path's own chord


@given(seeds)
def test_no_other_line_is_nearer_to_a_path_than_its_own_chord_root_mean_square(seed: int) -> None:
    A, B, (points, *_) = line_and_points(seed)
    own = (distance_to_line(points, *best_line(points)) ** 2).mean()
    assert own <= (distance_to_line(points, A, B) ** 2).mean() + 1e-15


@given(seeds)
def test_moving_and_turning_a_path_leaves_how_straight_it_is_in_itself(seed: int) -> None:
    *_, (points, *_) = line_and_points(seed)
    rng = np.random.default_rng(seed)
    moved = points @ matrix_from_rpy(*rng.uniform(-3.0, 3.0, 3)).T + rng.uniform(-1.0, 1.0, 3)
    np.testing.assert_allclose(own_chord_mm(moved), own_chord_mm(points), rtol=1e-6, atol=1e-9)


@given(seeds)
def test_a_straight_path_lies_on_its_own_chord_wherever_it_is(seed: int) -> None:
    A, B, _ = line_and_points(seed)
    points = A + np.random.default_rng(seed).uniform(-1.0, 2.0, 9)[:, None] * (B - A)
    np.testing.assert_allclose(own_chord_mm(points), 0.0, atol=1e-9)
