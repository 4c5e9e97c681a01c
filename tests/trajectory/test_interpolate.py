"""Ways between waypoints and their time law; quintics meet their boundary states, and are each other's derivatives."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.trajectory import interpolate
from armctl.trajectory.interpolate import PEAK_SPEED, Interpolation, joint_path, rest_to_rest, time_law
from armctl.trajectory.quintic import curves, quintic
from tests.kinematics.conftest import seeds

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
    assert q[[0, -1]].tolist() == [[1.0, 0.0], [2.0, -3.0]]
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
        both = [joint_path(waypoints, knots, knot + side * np.arange(4), "cubic") for side in (h, -h)]
        # One-sided differences, exact for cubics up to rounding.
        slope = [(-11 * q[0] + 18 * q[1] - 9 * q[2] + 2 * q[3]) / (6 * h) for q in both]
        bend = [(2 * q[0] - 5 * q[1] + 4 * q[2] - q[3]) / h**2 for q in both]
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


# -------------------------------------------------------------------------------------------------------------- quintic


states = st.lists(st.floats(-3.0, 3.0), min_size=6, max_size=6)


@given(states, st.floats(0.1, 20.0))
def test_both_ends_have_the_position_velocity_and_acceleration_asked_for(
    values: list[float], duration_s: float
) -> None:
    p0, p1, v0, v1, a0, a1 = (np.array([value, -value]) for value in values)
    motion = quintic(p0, p1, duration_s, v0=v0, v1=v1, a0=a0, a1=a1)
    position, velocity, acceleration = motion.sample(np.array([0.0, duration_s]))
    np.testing.assert_allclose(position, [p0, p1], atol=1e-9 * max(1.0, duration_s**2))
    np.testing.assert_allclose(velocity, [v0, v1], atol=1e-9 * max(1.0, duration_s, 1.0 / duration_s))
    np.testing.assert_allclose(acceleration, [a0, a1], atol=1e-8 * max(1.0, 1.0 / duration_s**2))


@given(states)
def test_velocity_and_acceleration_are_derivatives(values: list[float]) -> None:
    motion = quintic(np.array(values[:1]), np.array(values[1:2]), 2.0, v0=values[2], v1=values[3], a0=values[4])
    t, h = np.linspace(0.1, 1.9, 7), 1e-5
    _, velocity, acceleration = motion.sample(t)
    after, before = motion.sample(t + h), motion.sample(t - h)
    np.testing.assert_allclose(velocity, (after[0] - before[0]) / (2.0 * h), atol=1e-6)
    np.testing.assert_allclose(acceleration, (after[1] - before[1]) / (2.0 * h), atol=1e-6)


def test_rest_to_rest_is_the_quintic_of_the_approach() -> None:
    q0, q1, u = np.array([0.1, -0.4]), np.array([1.0, 0.3]), np.linspace(-0.2, 1.2, 30)
    np.testing.assert_allclose(quintic(q0, q1, 3.0).sample(u * 3.0)[0], rest_to_rest(q0, q1, u), atol=1e-14)


def test_the_tool_curves_belong_to_the_joint_curves() -> None:
    chain = robots.get("transfer-6dof").chain
    motion = quintic(np.zeros(6), np.array([0.5, -0.7, 0.4, 0.3, 0.8, -0.2]), 1.5, v0=0.1)
    t, h = np.linspace(0.0, 1.5, 16), 1e-5
    found = curves(chain, t, *motion.sample(t))
    inner = t[1:-1]
    after, before = (curves(chain, time_s, *motion.sample(time_s)) for time_s in (inner + h, inner - h))
    velocity = (after.tool_position_m - before.tool_position_m) / (2.0 * h)
    np.testing.assert_allclose(found.tool_velocity_m_s[1:-1], velocity, atol=1e-8)
    acceleration = (after.tool_velocity_m_s - before.tool_velocity_m_s) / (2.0 * h)
    np.testing.assert_allclose(found.tool_acceleration_m_s2[1:-1], acceleration, atol=1e-7)
    spin = (after.tool_angular_velocity_rad_s - before.tool_angular_velocity_rad_s) / (2.0 * h)
    np.testing.assert_allclose(found.tool_angular_acceleration_rad_s2[1:-1], spin, atol=1e-7)


@pytest.mark.parametrize(
    ("q1", "duration_s", "message"),
    [
        ([1.0, 2.0], 1.0, "as many joints"),
        ([1.0], 0.0, "above 0"),
        ([1.0], math.nan, "above 0"),
        ([math.inf], 1.0, "not finite"),
    ],
)
def test_what_is_no_trajectory_is_refused(q1: list[float], duration_s: float, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        quintic(np.zeros(1), np.array(q1), duration_s)
    with pytest.raises(ConfigError, match="one or 1 numbers"):
        quintic(np.zeros(1), np.ones(1), 1.0, v0=np.zeros(3))
