"""Quintic trajectories meet their boundary states, and their curves are each other's derivatives."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.trajectory.interpolate import rest_to_rest
from armctl.trajectory.quintic import curves, quintic

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
