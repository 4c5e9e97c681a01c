import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.kinematics.transform import FloatArray
from armctl.trajectory.straightness import distance_to_line, max_error, mean_error, progress_along_line

A, B = np.array([0.18, -0.125, 0.10]), np.array([0.18, 0.125, 0.10])
seeds = st.integers(0, 2**32 - 1)


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
    assert float(max_error(points, A, B)) == pytest.approx(0.02)
    assert mean_error(np.stack([points, points]), A, B).shape == (2,)


def test_a_line_needs_two_points() -> None:
    with pytest.raises(ValueError, match="same point"):
        distance_to_line(np.zeros((4, 3)), A, A)
    with pytest.raises(ValueError, match="x, y, z"):
        progress_along_line(np.zeros((4, 2)), A, B)
