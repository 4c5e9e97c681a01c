"""Velocity and acceleration of the tool against differences, and behaviour at singularities."""

import math

import numpy as np
import pytest

from armctl.kinematics import differential, robots
from armctl.kinematics.chain import forward_kinematics, jacobian
from armctl.kinematics.differential import MOST_DAMPING, dexterity, jacobian_rate, joint_rates, tool_velocity
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, rotation_error

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
