"""Where the tool is to be along a motion, and the two distances from there."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.kinematics.transform import FloatArray
from armctl.trajectory.reference import NEAR_M, ReferencePath
from armctl.trajectory.straightness import distance_to_line

SEEDS = st.integers(0, 2**32 - 1)


def wound(seed: int, count: int = 60) -> ReferencePath:
    """A path that winds, at an uneven pace, and rests in between."""
    rng = np.random.default_rng(seed)
    progress = np.concatenate([[0.0], np.sort(rng.uniform(0.0, 1.0, count - 2)), [1.0]])
    points = np.cumsum(rng.normal(0.0, 0.004, (count, 3)), axis=0)
    points[count // 2] = points[count // 2 - 1]
    return ReferencePath(progress, points)


def square() -> ReferencePath:
    corners = np.array([[0, 0, 0], [0.1, 0, 0], [0.1, 0.1, 0], [0, 0.1, 0], [0, 0, 0]])
    return ReferencePath(np.linspace(0.0, 1.0, 5), corners)


@given(SEEDS)
def test_the_path_itself_is_nowhere_off_at_equal_progress(seed: int) -> None:
    path = wound(seed)
    progress = np.linspace(0.0, 1.0, 101)
    there = path.at(progress)
    np.testing.assert_array_equal(path.apart_m(there, progress), 0.0)
    np.testing.assert_allclose(path.off_m(there, progress), 0.0, atol=1e-9)


@given(SEEDS)
def test_it_is_never_farther_to_the_path_than_to_the_place_of_equal_progress(seed: int) -> None:
    path, rng = wound(seed), np.random.default_rng(seed)
    progress = np.linspace(0.0, 1.0, 50)
    tool = path.at(progress) + rng.normal(0.0, 0.002, (50, 3))
    assert (path.off_m(tool, progress) <= path.apart_m(tool, progress) + 1e-12).all()


@given(SEEDS)
def test_off_a_line_is_the_distance_of_the_paper(seed: int) -> None:
    rng = np.random.default_rng(seed)
    A, B = rng.uniform(-0.3, 0.3, (2, 3))
    tool = rng.uniform(-0.5, 0.5, (20, 3))
    off = ReferencePath.line(A, B).off_m(tool, rng.uniform(0.0, 1.0, 20))
    np.testing.assert_allclose(off, distance_to_line(tool, A, B), atol=1e-12)


def test_to_be_late_costs_nothing_off_the_path_and_counts_at_equal_progress() -> None:
    path, progress = square(), np.linspace(0.1, 0.2, 11)
    late = path.at(progress - 0.02)
    np.testing.assert_allclose(path.off_m(late, progress), 0.0, atol=1e-12)
    np.testing.assert_allclose(path.apart_m(late, progress), 0.02 * 0.4)


@pytest.mark.parametrize("beside_m", [0.0, 0.03])
def test_another_side_of_the_figure_is_not_taken_for_the_one_that_is_due(beside_m: float) -> None:
    due = np.array([0.125])
    there: FloatArray = np.array([[0.05, 0.1 - beside_m, 0.0]])
    assert square().off_m(there, due)[0] == pytest.approx(0.1 - beside_m)
    assert 0.1 - beside_m > NEAR_M
