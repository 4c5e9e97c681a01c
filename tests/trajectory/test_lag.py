from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import STALL_TORQUE_NM, TICK_RAD
from armctl.kinematics.chain import link_frames
from armctl.trajectory.lag import (
    SERVO_KG,
    TOOL_KG,
    fitted,
    heaviest_rad,
    lags_rad,
    nominal,
    predict,
    regressors,
    side_after,
    sides,
    summary,
)
from tests.genetic import hand

ARM, CHAIN = hand.arm(), hand.robot().chain
PERIOD_S = 0.1


def motion(rng: np.random.Generator, m: int = 51) -> np.ndarray:
    limits = np.array([joint.limits_rad for joint in ARM.joints])[:5]
    ends = rng.uniform(0.8 * limits[:, 0], 0.8 * limits[:, 1], (2, 5))
    return np.asarray(ends[0] + np.linspace(0.0, 1.0, m)[:, None] * (ends[1] - ends[0]) * 0.5)


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_coefficients_are_found_again_in_what_they_make(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X = [regressors(CHAIN, motion(rng), rng.uniform(-0.05, 0.05, 5), PERIOD_S) for _ in range(8)]
    plain = nominal(ARM, CHAIN)
    truth = replace(plain, rows=tuple(tuple(g * rng.uniform(0.7, 1.3) for g in row) for row in plain.rows))
    lags = [predict(truth, rows) + 0.3 * TICK_RAD * rng.standard_normal((51, 5)) for rows in X]
    found = fitted(ARM, CHAIN, [summary(lag, rows) for lag, rows in zip(lags, X, strict=True)])
    assert max(found.residual_tick) < 0.36
    for rows in X:
        assert np.abs(predict(found, rows) - predict(truth, rows)).mean() < 0.2 * TICK_RAD


def test_friction_keeps_its_side_at_rest_and_turns_over_within_a_tick() -> None:
    q = np.concatenate([np.linspace(0.0, 0.1, 11), np.full(5, 0.1), np.linspace(0.1, 0.0, 11)])[:, None]
    h = sides(q, [0.0])[:, 0]
    assert h[0] == 0.0
    assert h[5] > 0.99
    assert (h[10:16] > 0.99).all()
    assert h[-1] < -0.99
    np.testing.assert_array_equal(sides(-q, [0.0])[:, 0], -h)


def test_a_joint_that_came_from_one_side_begins_with_friction_on_it() -> None:
    assert sides(np.zeros((2, 1)), [side_after(0.0, -0.05)])[0, 0] == pytest.approx(-1.0, abs=2e-3)


def potential_J(q: np.ndarray) -> float:
    points = link_frames(CHAIN, q)[1:, :3, 3]
    return 9.81 * float(SERVO_KG * points[:-1, 2].sum() + SERVO_KG * points[-2:, 2].mean() + TOOL_KG * points[-1, 2])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_the_nominal_arm_sags_by_the_slope_of_its_potential_energy(seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-1.5, 1.5, 5)
    slope = np.array([(potential_J(q + step) - potential_J(q - step)) / 2e-6 for step in 1e-6 * np.eye(5)])
    stiffness = STALL_TORQUE_NM * (1.0 - 32.0 / 1023.0) / (32.0 * TICK_RAD)
    reach = regressors(CHAIN, np.tile(q, (2, 1)), np.zeros(5), 1.0)[:, 0, :5]
    sag = (np.array(nominal(ARM, CHAIN).rows)[:, :5] * reach).sum(axis=1)
    np.testing.assert_allclose(sag, slope / stiffness, atol=1e-7)


def test_a_stretched_arm_is_heavier_than_a_folded_one() -> None:
    model = nominal(ARM, CHAIN)
    stretched = heaviest_rad(model, CHAIN, np.zeros((2, 5)), 0.1)
    folded = heaviest_rad(model, CHAIN, np.tile([0.0, 1.4, -2.4, 0.5, 0.0], (2, 1)), 0.1)
    assert stretched[1] > np.radians(5.0) > folded[1]
    assert stretched[0] == pytest.approx(model.rows[0][5])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_what_the_control_step_foresees_is_what_the_fit_explains(seed: int) -> None:
    rng = np.random.default_rng(seed)
    q, before = motion(rng), rng.uniform(-0.05, 0.05, 5)
    model = nominal(ARM, CHAIN)
    model = replace(model, rows=tuple(tuple(g * rng.uniform(0.5, 1.5) for g in row) for row in model.rows))
    pushed = sides(q, [side_after(0.0, float(way)) for way in before])
    velocities = np.gradient(q, PERIOD_S, axis=0)
    foreseen = [
        lags_rad(model, CHAIN, *some) for some in zip(q.tolist(), pushed.tolist(), velocities.tolist(), strict=True)
    ]
    np.testing.assert_allclose(foreseen, predict(model, regressors(CHAIN, q, before, PERIOD_S)), atol=1e-12)


@given(st.floats(-1.0, 1.0), st.floats(-0.2, 0.2))
def test_friction_s_side_stays_within_one_and_goes_the_way_of_the_motion(side: float, way_rad: float) -> None:
    after = side_after(side, way_rad)
    assert -1.0 <= after <= 1.0
    assert (after - side) * way_rad >= -1e-15


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=20)
def test_sums_tell_of_a_model_what_the_samples_tell(seed: int) -> None:
    rng = np.random.default_rng(seed)
    X = regressors(CHAIN, motion(rng), rng.uniform(-0.05, 0.05, 5), PERIOD_S)
    lags, heard = 0.01 * rng.standard_normal((51, 5)), rng.random((51, 5)) < 0.7
    known = heard & (np.abs(X[:, :, 5].T) >= 0.9)
    assume(known.any(axis=0).all())
    model = nominal(ARM, CHAIN)
    left = lags - predict(model, X)
    rms = [float(np.sqrt((left[known[:, i], i] ** 2).mean())) for i in range(5)]
    halves = [summary(lags[part], X[:, part], heard[part]) for part in (slice(20), slice(20, None))]
    np.testing.assert_allclose((halves[0] + halves[1]).rms_rad(np.array(model.rows)), rms, rtol=1e-6)


def test_what_holds_a_joint_before_it_has_gone_a_way_tells_nothing() -> None:
    q = np.tile(np.radians([-20.0, 130.0, -115.0, 60.0, 0.0]), (51, 1))
    q[20:, 0] += np.radians(np.arange(1.0, 32.0))
    seen = summary(np.full((51, 5), 0.02), regressors(CHAIN, q, np.zeros(5), PERIOD_S))
    assert seen.count.tolist() == [31, 0, 0, 0, 0]
