"""Frames of a chain, its Jacobian, and the tool's velocity and acceleration, at singularities too."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.kinematics import differential, robots
from armctl.kinematics.chain import BLOCK, DHRow, SerialChain, forward_kinematics, jacobian, link_frames, tool_pose
from armctl.kinematics.chain import tool_position as tool
from armctl.kinematics.differential import MOST_DAMPING, dexterity, jacobian_rate, joint_rates, tool_velocity
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, quaternion_from_columns, quaternion_from_matrix, rotation_error
from tests.kinematics.conftest import X, Y, Z, screw, seeds, some_q

length = st.floats(-0.5, 0.5)
alpha = st.one_of(st.sampled_from([0.0, math.pi / 2, -math.pi / 2, math.pi]), st.floats(-math.pi, math.pi))
row = st.builds(DHRow, a=length, alpha=alpha, d=length, offset=st.floats(-math.pi, math.pi))
anywhere = st.builds(DHRow, length, alpha, length, alpha, length, alpha)
rows, conventions = st.lists(row, min_size=1, max_size=7).map(tuple), st.sampled_from(["standard", "modified"])
tools = st.one_of(st.just(DHRow()), anywhere)
chains = st.one_of(
    st.builds(SerialChain, rows, conventions, st.sampled_from([0.0, 0.13]), tools),
    st.builds(SerialChain, st.lists(anywhere, min_size=1, max_size=7).map(tuple), st.just("modified"), tool=tools),
)


small = st.floats(-0.05, 0.05)
soft_row = st.builds(replace, row, waves=st.tuples(small, small, small, small), bend=small)
soft = st.builds(
    SerialChain,
    st.lists(soft_row, min_size=1, max_size=6).map(tuple),
    conventions,
    tool=st.builds(replace, anywhere, bend=small),
)


def anywhere_by_hand(r: DHRow, angle: float) -> FloatArray:
    """A modified row: about x, then along x, y and z, about y, about z."""
    along = screw(X, 0.0, r.a) @ screw(Y, 0.0, r.b) @ screw(Z, 0.0, r.d)
    return np.asarray(screw(X, r.alpha) @ along @ screw(Y, r.beta) @ screw(Z, r.offset + angle))


def frames_by_hand(chain: SerialChain, q: FloatArray) -> FloatArray:
    """The base, every link frame, and the tool if it is another."""
    frames = [np.eye(4)]
    for r, angle in zip(chain.rows, q, strict=True):
        about_z, about_x = screw(Z, angle + r.offset, r.d), screw(X, r.alpha, r.a)
        standard = chain.convention == "standard"
        frames.append(frames[-1] @ (about_z @ about_x if standard else anywhere_by_hand(r, angle)))
    tool = [frames[-1] @ screw(X, 0.0, chain.tool_m) @ anywhere_by_hand(chain.tool, 0.0)] if chain.has_tool else []
    return np.array(frames + tool)


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
    for i, step in enumerate(h * np.eye(chain.n)):
        rate = (forward_kinematics(chain, q + step) - forward_kinematics(chain, q - step)) / (2.0 * h)
        spin = rate[:3, :3] @ forward_kinematics(chain, q)[:3, :3].T
        np.testing.assert_allclose(J[:, i], [*rate[:3, 3], spin[2, 1], spin[0, 2], spin[1, 0]], atol=1e-8)


def links_by_hand(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Positions of the links: weight bends each joint by the slope of what all of it has in potential."""
    u = 1.2 * q
    shares = np.array([row.waves for row in chain.rows])
    waves = np.einsum("ik,ki->i", shares, np.array([np.cos(u), np.sin(u), np.cos(2.0 * u), np.sin(2.0 * u)]))
    weights = [row.bend for row in (*chain.rows, *([chain.tool] if chain.has_tool else ()))]

    def potential(at: FloatArray) -> float:
        return float(np.array(weights) @ frames_by_hand(chain, at)[1:, 2, 3])

    h = 1e-5
    slopes = [potential(q + waves + step) - potential(q + waves - step) for step in h * np.eye(chain.n)]
    return np.asarray(q + waves - np.array(slopes) / (2.0 * h))


@given(soft, seeds)
def test_sensors_have_waves_and_weight_bends_joints(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed)
    np.testing.assert_allclose(link_frames(chain, q), frames_by_hand(chain, links_by_hand(chain, q)), atol=1e-8)


@given(st.one_of(chains, soft), seeds)
def test_one_pose_and_a_batch_give_the_same_bits(chain: SerialChain, seed: int) -> None:
    q = some_q(chain, seed, 2, 3)
    batch = forward_kinematics(chain, q)
    for at in np.ndindex(2, 3):
        assert np.array_equal(batch[at], forward_kinematics(chain, q[at]))
        assert np.array_equal(batch[at][:3, 3], tool(chain, q[at]))
        assert np.array_equal(jacobian(chain, q)[at], jacobian(chain, q[at]))
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


# -------------------------------------- velocity and acceleration of the tool against differences, and at singularities


H = 1e-5


def test_tool_velocity_and_acceleration_are_the_derivatives_of_its_motion(robot: Robot) -> None:
    chain = robot.chain
    q, rate, rate2 = np.random.default_rng(2).uniform(-1.5, 1.5, (3, chain.n))

    def at(t: float) -> FloatArray:
        return np.asarray(q + rate * t + 0.5 * rate2 * t * t)

    velocity, acceleration = tool_velocity(chain, q, rate), differential.tool_acceleration(chain, q, rate, rate2)
    before, now, after = (forward_kinematics(chain, at(t)) for t in (-H, 0.0, H))
    np.testing.assert_allclose(velocity[:3], (after - before)[:3, 3] / (2.0 * H), atol=1e-8)
    np.testing.assert_allclose(velocity[3:], rotation_error(before[:3, :3], after[:3, :3]) / (2.0 * H), atol=1e-8)
    np.testing.assert_allclose(acceleration[:3], (after - 2.0 * now + before)[:3, 3] / H**2, atol=1e-4)
    later, earlier = (tool_velocity(chain, at(t), rate + rate2 * t) for t in (H, -H))
    np.testing.assert_allclose(acceleration, (later - earlier) / (2.0 * H), atol=1e-8)


def test_jacobian_rate_is_the_derivative_of_the_jacobian(robot: Robot) -> None:
    chain = robot.chain
    q, rate = np.random.default_rng(3).uniform(-1.5, 1.5, (2, 4, chain.n))
    differences = (jacobian(chain, q + H * rate) - jacobian(chain, q - H * rate)) / (2.0 * H)
    np.testing.assert_allclose(jacobian_rate(chain, q, rate), differences, atol=1e-8)


def test_rank_and_manipulability_tell_a_singular_arm() -> None:
    chain = robots.get("transfer-6dof").chain
    J = jacobian(chain, np.array([0.1, -1.0, 0.4, 0.2, 0.7, 0.3]))
    free = dexterity(J)
    assert free.rank == 6
    assert free.manipulability == pytest.approx(math.sqrt(np.linalg.det(J @ J.T)), rel=1e-9)
    straight = dexterity(jacobian(chain, np.array([0.1, -1.0, 0.4, 0.2, 0.0, 0.3])))
    assert straight.rank == 5
    assert straight.manipulability < 1e-15
    flat = jacobian(robots.get("lanzhou-4dof").chain, np.zeros(4))
    volume = math.sqrt(max(0.0, float(np.linalg.det(flat.T @ flat))))
    assert dexterity(flat).manipulability == pytest.approx(volume, abs=1e-12)
    assert dexterity(np.zeros((6, 2))).rank == 0


def test_joint_rates_follow_exactly_where_the_arm_is_free() -> None:
    J = jacobian(robots.get("puma560").chain, np.array([0.1, -1.0, 0.4, 0.2, 0.9, 0.3]))
    wanted = np.array([0.1, -0.05, 0.02, 0.3, -0.2, 0.1])
    np.testing.assert_allclose(J @ joint_rates(J, wanted), wanted, atol=1e-12)


def test_joint_rates_stay_bounded_at_a_singularity() -> None:
    chain = robots.get("puma560").chain
    for bend in (0.0, 1e-9, 1e-4):
        J = jacobian(chain, np.array([0.1, -1.0, 0.4, 0.2, bend, 0.3]))
        for axis in np.eye(6):
            assert np.linalg.norm(joint_rates(J, axis)) < 1.0 / (2.0 * MOST_DAMPING) + 1.0 / 0.05
