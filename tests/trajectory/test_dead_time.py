"""Dead time at both ends goes, and nothing else."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.trajectory.dead_time import moving_part


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
