import numpy as np
import pytest

from armctl.genetic import free_path as module
from armctl.genetic.free_path import MOST_OFFSET_RAD, free_path
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.straightness import mean_error
from tests.genetic import hand

CHAIN = hand.robot().chain
LIMITS = np.array([joint.limits_rad for joint in hand.arm().joints[: CHAIN.n]])
PROGRESS = np.linspace(0.0, 1.0, 30)


def wobbly(seed: int, wobble_rad: float) -> FloatArray:
    line = hand.joint_line()
    path = np.stack([np.interp(PROGRESS * 64.0, range(65), joint) for joint in line.T], axis=1)
    path[1:-1] += np.random.default_rng(seed).uniform(-wobble_rad, wobble_rad, path[1:-1].shape)
    return path


def freed(path: FloatArray, limits: FloatArray = LIMITS, breaks: float = 0.0) -> FloatArray:
    return free_path(CHAIN, path, PROGRESS, hand.A, hand.B, limits, lambda _: breaks)


def error_mm(path: FloatArray) -> float:
    return float(mean_error(tool_position(CHAIN, path), hand.A, hand.B)) * 1e3


@pytest.mark.parametrize("seed", range(4))
def test_small_wobbles_vanish_within_the_bound_of_the_offsets_and_the_ends_stay(seed: int) -> None:
    path = wobbly(seed, 0.02)
    moved = freed(path)
    assert error_mm(path) > 1.0
    assert error_mm(moved) < 0.05
    assert np.abs(moved - path).max() <= MOST_OFFSET_RAD + 1e-12
    assert np.array_equal(moved[[0, -1]], path[[0, -1]])


def test_offsets_that_would_have_to_be_larger_are_cut_off_at_the_bound() -> None:
    path = wobbly(1, 0.0)
    path[1:-1, 1] += 0.3
    moved = freed(path)
    assert np.abs(moved - path).max() == pytest.approx(MOST_OFFSET_RAD)
    assert 0.0 < error_mm(moved) < error_mm(path)


def test_joint_limits_are_kept() -> None:
    path = wobbly(2, 0.02)
    tight = np.stack([path.min(axis=0), path.max(axis=0)], axis=1)
    moved = freed(path, tight)
    assert ((tight[:, 0] <= moved) & (moved <= tight[:, 1])).all()


def test_a_step_that_breaks_more_limits_is_not_taken() -> None:
    path = wobbly(3, 0.02)

    def breaks(q: FloatArray) -> float:
        return 0.0 if np.array_equal(q, path) else 1.0

    assert np.array_equal(free_path(CHAIN, path, PROGRESS, hand.A, hand.B, LIMITS, breaks), path)


def test_a_share_of_a_step_is_taken_where_the_whole_would_break_a_limit() -> None:
    path = wobbly(4, 0.02)
    whole = np.abs(freed(path) - path).max()

    def breaks(q: FloatArray) -> float:
        return float(np.abs(q - path).max() > 0.5 * whole)

    moved = free_path(CHAIN, path, PROGRESS, hand.A, hand.B, LIMITS, breaks)
    assert breaks(moved) == 0.0
    assert error_mm(moved) < error_mm(path)
    assert min(module.SHARES) < 0.5
