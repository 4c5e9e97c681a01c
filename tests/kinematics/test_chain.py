import math

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.kinematics.chain import BLOCK, DHRow, SerialChain, forward_kinematics, jacobian, link_frames, tool_pose
from armctl.kinematics.chain import tool_position as tool
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, quaternion_from_columns, quaternion_from_matrix
from tests.kinematics.conftest import X, Z, turn

length = st.floats(-0.5, 0.5)
alpha = st.one_of(st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi]), st.floats(-math.pi, math.pi))
row = st.builds(DHRow, a=length, alpha=alpha, d=length, offset=st.floats(-math.pi, math.pi))
chains = st.builds(
    SerialChain,
    st.lists(row, min_size=1, max_size=7).map(tuple),
    st.sampled_from(["standard", "modified"]),
    st.sampled_from([0.0, 0.13]),
)
seeds = st.integers(0, 2**32 - 1)


def translation(x: float, z: float) -> FloatArray:
    T = np.eye(4)
    T[0, 3], T[2, 3] = x, z
    return T


def frames_by_hand(chain: SerialChain, q: FloatArray) -> FloatArray:
    """The base, every link frame, and the tool if it is another."""
    frames = [np.eye(4)]
    for r, angle in zip(chain.rows, q, strict=True):
        about_z = turn(Z, angle + r.offset) @ translation(0.0, r.d)
        about_x = translation(r.a, 0.0) @ turn(X, r.alpha)
        standard = chain.convention == "standard"
        frames.append(frames[-1] @ (about_z @ about_x if standard else about_x @ about_z))
    tool = [frames[-1] @ translation(chain.tool_m, 0.0)] if chain.tool_m else []
    return np.array(frames + tool)


def some_q(chain: SerialChain, seed: int, *shape: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-math.pi, math.pi, (*shape, chain.n))


# Twisted by less than anybody measures, and by more than a float of zero or 90 deg is off.
NEARLY_PARALLEL = DHRow(a=0.0, alpha=1.5e-12, d=0.0)


@given(chains, seeds)
@example(SerialChain((NEARLY_PARALLEL,) * 7), 83)
def test_every_frame_is_the_product_of_screw_matrices(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed)
    expected = frames_by_hand(chain, q)
    np.testing.assert_allclose(link_frames(chain, q), expected, atol=1e-13)
    np.testing.assert_allclose(forward_kinematics(chain, q), expected[-1], atol=1e-12)


@given(chains, seeds)
def test_jacobian_equals_finite_differences(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed)
    J = jacobian(chain, q)
    h = 1e-6
    for i in range(chain.n):
        step = np.zeros(chain.n)
        step[i] = h
        ahead, behind = forward_kinematics(chain, q + step), forward_kinematics(chain, q - step)
        rate = (ahead - behind) / (2.0 * h)
        spin = rate[:3, :3] @ forward_kinematics(chain, q)[:3, :3].T
        np.testing.assert_allclose(J[:3, i], rate[:3, 3], atol=1e-8)
        np.testing.assert_allclose(J[3:, i], [spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)


@given(chains, seeds)
def test_one_pose_and_a_batch_give_the_same_bits(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed, 2, 3)
    batch = forward_kinematics(chain, q)
    for i in range(2):
        for j in range(3):
            assert np.array_equal(batch[i, j], forward_kinematics(chain, q[i, j]))
            assert np.array_equal(batch[i, j, :3, 3], tool(chain, q[i, j]))
            assert np.array_equal(jacobian(chain, q)[i, j], jacobian(chain, q[i, j]))
    assert jacobian(chain, q).shape == (2, 3, 6, chain.n)


@pytest.mark.parametrize("q", [np.zeros(3), np.zeros((2, 1)), np.float64(0.0)])
def test_wrong_number_of_joints_is_an_error(q: FloatArray) -> None:
    chain = SerialChain((DHRow(a=1.0), DHRow(a=1.0)))
    with pytest.raises(ValueError, match="last axis must be 2"):
        forward_kinematics(chain, q)


@given(chains, seeds)
@settings(max_examples=20)
def test_a_batch_larger_than_a_block_gives_the_bits_of_its_parts(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed, BLOCK + 5)
    T, J = forward_kinematics(chain, q), jacobian(chain, q)
    assert np.array_equal(T[BLOCK - 3 :], forward_kinematics(chain, q[BLOCK - 3 :]))
    assert np.array_equal(T[7], forward_kinematics(chain, q[7]))
    assert np.array_equal(J[-1], jacobian(chain, q[-1]))
    assert np.array_equal(tool(chain, q), T[:, :3, 3])
    assert np.array_equal(link_frames(chain, q)[:, -1], T)


def test_no_pose_in_no_pose_out() -> None:
    chain = SerialChain((DHRow(a=0.1),))
    assert forward_kinematics(chain, np.zeros((0, 1))).shape == (0, 4, 4)
    assert jacobian(chain, np.zeros((0, 1))).shape == (0, 6, 1)


def test_plain_floats_give_the_bits_of_forward_kinematics(robot: Robot) -> None:
    chain = robot.chain
    for q in np.random.default_rng(7).uniform(-np.pi, np.pi, (200, chain.n)):
        T = forward_kinematics(chain, q)
        columns = tool_pose(chain, q.tolist())
        np.testing.assert_array_equal(np.array(columns).T, T[:3])
        assert quaternion_from_columns(*columns[:3]) == quaternion_from_matrix(T[:3, :3])
