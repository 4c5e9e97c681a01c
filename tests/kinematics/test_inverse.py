from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import UnreachableTarget
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.inverse import solve_position

CHAIN = robots.get("ax12-line").chain
LIMITS = np.radians([[-145, 145], [-10, 160], [-145, 145], [-110, 110], [-110, 110]])


@given(st.integers(0, 2**32 - 1))
@settings(deadline=None, max_examples=200)
def test_a_reachable_target_is_found_within_limits_from_nearby(seed: int) -> None:
    rng = np.random.default_rng(seed)
    # Away from the folded and the stretched arm, where nearby is not near enough.
    truth = np.array([*rng.uniform([-2.0, 0.5], [2.0, 2.0]), *rng.uniform([-1.8, -0.8, -0.8], [-0.6, 0.8, 0.8])])
    target = tool_position(CHAIN, truth)
    q = solve_position(CHAIN, target, truth + rng.uniform(-0.15, 0.15, 5), LIMITS)
    assert np.linalg.norm(tool_position(CHAIN, q) - target) <= 1e-9
    assert (q >= LIMITS[:, 0]).all()
    assert (q <= LIMITS[:, 1]).all()


def test_out_of_reach_is_refused_with_the_least_distance() -> None:
    q = np.array([0.0, 0.3, -0.3, 0.1, 0.1])
    with pytest.raises(UnreachableTarget, match=r"no nearer than 120\.0 mm") as caught:
        solve_position(CHAIN, np.array([0.5, 0.0, 0.1]), q, LIMITS)
    assert caught.value.least_error_m == pytest.approx(0.12, abs=1e-5)


def test_a_start_outside_the_limits_is_clipped_to_them() -> None:
    q = solve_position(
        CHAIN, np.array([0.18, 0.0, 0.1]), np.array([4.0, 1.9, -1.6, -0.9, 5.0]) * [0, 1, 1, 1, 1], LIMITS
    )
    assert q[4] <= LIMITS[4, 1]
    np.testing.assert_allclose(tool_position(CHAIN, q), [0.18, 0.0, 0.1], atol=1e-9)


def test_a_joint_at_its_limit_leaves_the_work_to_the_others() -> None:
    limits = LIMITS.copy()
    limits[4] = [0.0, 1e-12]
    q = solve_position(CHAIN, np.array([0.2, 0.1, 0.12]), np.array([0.3, 1.6, -1.5, -0.8, 0.0]), limits)
    assert abs(q[4]) <= 1e-12
    np.testing.assert_allclose(tool_position(CHAIN, q), [0.2, 0.1, 0.12], atol=1e-9)


def test_rest_pulls_redundancy_without_moving_the_tool() -> None:
    start, target = np.array([0.0, 1.6, -1.5, -0.8, 0.4]), np.array([0.2, 0.0, 0.15])
    rest = np.array([0.0, 1.6, -1.5, -0.8, -0.4])
    free = solve_position(CHAIN, target, start, LIMITS)
    pulled = solve_position(CHAIN, target, start, LIMITS, rest=rest, rest_gain=0.3)
    np.testing.assert_allclose(tool_position(CHAIN, pulled), target, atol=1e-9)
    assert np.linalg.norm(pulled - rest) < np.linalg.norm(free - rest)
    assert math.isfinite(float(pulled.sum()))
