"""Of a motion as it was measured: its smooth derivatives, and dead time at both ends, which goes, and nothing else."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.polynomial import polynomial

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.trajectory.dead_time import moving_part
from armctl.trajectory.smoothing import local_cubics
from tests.kinematics.conftest import seeds

COEFFICIENTS = st.lists(st.floats(-2.0, 2.0), min_size=4, max_size=4)


@given(COEFFICIENTS, seeds)
def test_a_cubic_passes_unchanged_whenever_it_is_sampled(coefficients: list[float], seed: int) -> None:
    time_s = np.sort(np.arange(40) * 0.1 + np.random.default_rng(seed).uniform(0.0, 0.05, 40))
    at_s = np.linspace(0.5, 3.5, 7)
    values = np.asarray(polynomial.polyval(time_s, coefficients), dtype=np.float64)[:, None]
    for order, curve in enumerate(local_cubics(time_s, values, at_s, 0.55)):
        wanted = polynomial.polyval(at_s, polynomial.polyder(coefficients, order))
        assert curve[:, 0] == pytest.approx(wanted, abs=1e-8)


def test_whole_ticks_give_a_far_smoother_acceleration_than_their_differences_do() -> None:
    time_s = np.linspace(0.0, 9.9, 100)
    ticks = np.round(np.cos(time_s) / TICK_RAD) * TICK_RAD
    smooth = local_cubics(time_s, ticks[:, None], time_s[10:-10], 0.55)[2][:, 0]
    differences = np.diff(ticks, 2)[9:-9] / 0.01
    true_rad_s2 = -np.cos(time_s[10:-10])
    rms = [float(np.sqrt(((curve - true_rad_s2) ** 2).mean())) for curve in (smooth, differences)]
    assert rms[0] < 0.06
    assert rms[0] < rms[1] / 4.0


def test_too_few_samples_are_told() -> None:
    with pytest.raises(ValueError, match="4 samples within"):
        local_cubics(np.linspace(0.0, 0.3, 4), np.zeros((4, 1)), np.array([0.15]), 0.55)


# ------------------------------------------------------------------------------------------------------------ dead time


@given(st.integers(0, 30), st.integers(0, 30), st.integers(2, 40), st.integers(0, 2**31))
@settings(max_examples=60)
def test_rest_at_both_ends_goes_and_the_motion_stays(before: int, after: int, ticks: int, seed: int) -> None:
    way = np.linspace(0.0, 1.0, ticks + 1)[:, None] * np.array([ticks * 10.0 * TICK_RAD, -0.1])
    rest = np.concatenate([np.repeat(way[:1], before, axis=0), way, np.repeat(way[-1:], after, axis=0)])
    noise = np.random.default_rng(seed).integers(-1, 2, rest.shape) * TICK_RAD
    assert moving_part(rest + noise) == slice(before, len(rest) - after)


def test_an_arm_that_never_moves_keeps_all_its_samples() -> None:
    assert moving_part(np.zeros((7, 3))) == slice(0, 7)
    assert moving_part(np.zeros((1, 3))) == slice(0, 1)
