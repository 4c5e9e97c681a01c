"""Closed form of arms with a spherical wrist."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics
from armctl.kinematics.spherical_wrist import SphericalWrist
from armctl.kinematics.transform import finite
from tests.kinematics.conftest import assert_at, turned

QUARTER = math.pi / 2.0
seeds = st.integers(0, 2**32 - 1)
lengths = st.floats(-0.2, 0.2)
arms = st.builds(
    SphericalWrist,
    a1=lengths,
    a2=st.floats(0.2, 0.6),
    a3=lengths,
    shoulder=lengths,
    d4=st.floats(0.2, 0.5),
    d6=lengths,
    mirrored=st.booleans(),
)


def chain_of(arm: SphericalWrist) -> SerialChain:
    sign = -1.0 if arm.mirrored else 1.0
    return SerialChain(
        (
            DHRow(a=arm.a1, alpha=sign * QUARTER),
            DHRow(a=arm.a2, d=arm.shoulder),
            DHRow(a=arm.a3, alpha=-sign * QUARTER),
            DHRow(alpha=sign * QUARTER, d=arm.d4),
            DHRow(alpha=-sign * QUARTER),
            DHRow(d=arm.d6),
        )
    )


@given(arms, seeds)
def test_every_branch_reaches_the_pose_and_one_is_where_it_came_from(arm: SphericalWrist, seed: int) -> None:
    chain = chain_of(arm)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (20, 6))
    T = forward_kinematics(chain, q)
    for q_i, T_i, found in zip(q, T, arm.poses(T), strict=True):
        found = finite(found)
        assert len(found) in (4, 8)  # the waist turned round may not reach
        assert_at(chain, found, T_i)
        assert turned(found, q_i).min() < 1e-4


@given(arms, seeds)
def test_plain_floats_and_arrays_give_the_same_solutions_in_the_same_order(arm: SphericalWrist, seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (10, 6))
    T = forward_kinematics(chain_of(arm), q)
    for T_i, found in zip(T, arm.poses(T), strict=True):
        alone = np.array(arm.pose(T_i.tolist()))
        assert alone.shape == finite(found).shape
        assert turned(alone, finite(found)).max() < 1e-6


@given(arms, st.integers(0, 2), seeds)
def test_at_singular_poses_the_tool_is_exact_all_the_same(arm: SphericalWrist, kind: int, seed: int) -> None:
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, 6)
    if kind == 0:
        q[4] = 0.0  # the wrist straight
    elif kind == 1:
        q[2] = -math.atan2(arm.d4 * (-1.0 if arm.mirrored else 1.0), arm.a3)  # the elbow stretched
    else:
        q[4] = 1e-11  # the wrist nearly straight
    chain = chain_of(arm)
    T = forward_kinematics(chain, q)
    for found in (finite(arm.poses(T[None])), np.array(arm.pose(T.tolist()))):
        errors = np.abs(forward_kinematics(chain, found) - T).max(axis=(-1, -2))
        assert len(found) >= 4
        assert errors.max() < 1e-7
        assert errors.min() < 1e-11


def test_out_of_reach_there_is_no_solution_but_a_nearest_pose() -> None:
    arm = SphericalWrist(0.1, 0.4, 0.0, 0.05, 0.3, 0.1)
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.3, 0.4]
    assert arm.pose(T.tolist()) == []
    assert np.isnan(arm.poses(T[None])).all()
    q, distance = arm.nearest_pose(T)
    reached = forward_kinematics(chain_of(arm), q[0])
    np.testing.assert_allclose(reached[:3, :3], np.eye(3), atol=1e-12)
    assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) == pytest.approx(distance, abs=1e-12)
    q, nearer = arm.nearest_position(T[:3, 3])
    reached = forward_kinematics(chain_of(arm), q[0])
    assert np.linalg.norm(reached[:3, 3] - T[:3, 3]) == pytest.approx(nearer, abs=1e-12)
    assert nearer < distance


@pytest.mark.parametrize("d6", [0.1, -0.1])
def test_positions_hold_the_point_in_many_directions(d6: float) -> None:
    arm = SphericalWrist(0.1, 0.4, 0.02, 0.05, 0.3, d6, mirrored=True)
    points = np.array([[0.3, 0.2, 0.25], [0.4, -0.1, 0.1]])
    q = arm.positions(points)
    assert q.shape[:2] == (2, 8)
    for point, found in zip(points, q, strict=True):
        T = forward_kinematics(chain_of(arm), finite(found))
        assert len(T) > 100
        np.testing.assert_allclose(T[:, :3, 3], np.broadcast_to(point, (len(T), 3)), atol=1e-12)


def test_an_arm_without_links_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be above 0 m"):
        SphericalWrist(0.1, 0.0, 0.1, 0.0, 0.3, 0.0)
