import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.kinematics.transform import FloatArray
from armctl.trajectory import interpolate
from armctl.trajectory.interpolate import PEAK_SPEED, Interpolation, joint_path, rest_to_rest, time_law

seeds = st.integers(0, 2**32 - 1)
kinds = st.sampled_from(["linear", "cubic"])


def some_path(seed: int, count: int) -> tuple[FloatArray, FloatArray]:
    rng = np.random.default_rng(seed)
    steps = rng.uniform(0.2, 1.0, count - 1)
    return rng.uniform(-2.0, 2.0, (count, 3)), np.concatenate([[0.0], np.cumsum(steps) / steps.sum()])


def test_time_law_runs_from_0_to_1_and_never_stops_or_turns() -> None:
    u = np.linspace(-0.2, 1.2, 2001)
    s = time_law(u)
    assert (s[0], s[-1]) == (0.0, 1.0)
    assert (np.diff(s)[(u[:-1] >= 0.0) & (u[1:] <= 1.0)] > 0.0).all()
    np.testing.assert_allclose(time_law(1.0 - u), 1.0 - s, atol=1e-12)


def test_time_law_rests_at_both_ends_and_peaks_below_1_3_means() -> None:
    speed = np.diff(time_law(np.linspace(0.0, 1.0, 4001))) * 4000.0
    acceleration = np.diff(speed) * 4000.0
    assert max(speed[0], speed[-1]) < 1e-6
    assert speed.max() == pytest.approx(PEAK_SPEED, rel=1e-6)
    assert PEAK_SPEED <= 1.3
    assert max(abs(acceleration[0]), abs(acceleration[-1])) < 0.01
    assert np.abs(np.diff(acceleration)).max() < 0.1  # no jump in acceleration


@given(st.floats(0.0, 1.0))
def test_time_of_progress_inverts_the_time_law(s: float) -> None:
    assert float(time_law(interpolate.time_of_progress(np.array(s)))) == pytest.approx(s, abs=1e-5)


def test_a_way_from_rest_to_rest_rests_at_both_ends_with_the_stated_peaks() -> None:
    q = rest_to_rest(np.array([1.0, 0.0]), np.array([2.0, -3.0]), np.linspace(0.0, 1.0, 4001))
    assert q[0].tolist() == [1.0, 0.0]
    assert q[-1].tolist() == [2.0, -3.0]
    speed = np.diff(q[:, 0]) * 4000.0
    assert speed.max() == pytest.approx(interpolate.QUINTIC_PEAK_SPEED, rel=1e-5)
    assert np.abs(np.diff(speed)).max() * 4000.0 == pytest.approx(interpolate.QUINTIC_PEAK_ACCELERATION, rel=1e-4)
    np.testing.assert_allclose(q[:, 1], -3.0 * (q[:, 0] - 1.0), atol=1e-12)


@given(seeds, st.integers(2, 9), kinds)
def test_path_passes_every_waypoint_at_its_progress(seed: int, count: int, kind: Interpolation) -> None:
    waypoints, knots = some_path(seed, count)
    np.testing.assert_allclose(joint_path(waypoints, knots, knots, kind), waypoints, atol=1e-12)


@given(seeds, st.integers(3, 9))
def test_cubic_path_has_continuous_first_and_second_derivatives(seed: int, count: int) -> None:
    waypoints, knots = some_path(seed, count)
    h = 1e-4
    for knot in knots[1:-1]:
        side = np.arange(4) * h
        after = joint_path(waypoints, knots, knot + side, "cubic")
        before = joint_path(waypoints, knots, knot - side, "cubic")
        # One-sided differences, exact for cubics up to rounding.
        slope = [(-11 * q[0] + 18 * q[1] - 9 * q[2] + 2 * q[3]) / (6 * h) for q in (after, before)]
        bend = [(2 * q[0] - 5 * q[1] + 4 * q[2] - q[3]) / h**2 for q in (after, before)]
        np.testing.assert_allclose(slope[0], -slope[1], atol=1e-6)
        np.testing.assert_allclose(bend[0], bend[1], atol=1e-3)


def test_without_via_points_both_kinds_are_the_straight_joint_line() -> None:
    waypoints, knots = some_path(5, 2)
    s = np.linspace(0.0, 1.0, 11)
    line = waypoints[0] + s[:, None] * (waypoints[1] - waypoints[0])
    for kind in ("linear", "cubic"):
        np.testing.assert_allclose(joint_path(waypoints, knots, s, kind), line, atol=1e-15)


def test_a_parabola_through_three_waypoints_is_reproduced() -> None:
    knots, s = np.array([0.0, 0.3, 1.0]), np.linspace(0.0, 1.0, 21)
    np.testing.assert_allclose(joint_path(knots[:, None] ** 2, knots, s, "cubic")[:, 0], s**2, atol=1e-14)


@given(seeds, st.integers(3, 6), kinds)
def test_a_batch_gives_the_same_bits_as_one_by_one(seed: int, count: int, kind: Interpolation) -> None:
    paths = [some_path(seed + i, count) for i in range(4)]
    waypoints, knots = np.array([p[0] for p in paths]), np.array([p[1] for p in paths])
    s = np.linspace(0.0, 1.0, 33)
    batch = joint_path(waypoints, knots, s, kind)
    for i in range(4):
        assert np.array_equal(batch[i], joint_path(waypoints[i], knots[i], s, kind))


def test_outside_its_knots_the_path_stands_still() -> None:
    waypoints, knots = some_path(1, 4)
    ends = joint_path(waypoints, knots, np.array([-1.0, 2.0]), "cubic")
    np.testing.assert_allclose(ends, waypoints[[0, -1]], atol=1e-12)


@pytest.mark.parametrize(
    ("waypoints", "knots"),
    [(np.zeros((3, 2)), [0.0, 1.0]), (np.zeros((1, 2)), [0.0]), (np.zeros((3, 2)), [0.0, 0.0, 1.0]),
     (np.zeros((3, 2)), [0.0, math.nan, 1.0])],
)  # fmt: skip
def test_unfit_waypoints_are_errors(waypoints: FloatArray, knots: list[float]) -> None:
    with pytest.raises(ValueError, match="knots"):
        joint_path(waypoints, np.array(knots), np.array([0.5]), "cubic")
