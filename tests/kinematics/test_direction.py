"""Inverse kinematics of a point and where the tool points there: about that direction the tool may turn."""

import numpy as np
import pytest

from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, jacobian, link_frames
from armctl.kinematics.inverse import masked_jacobian, pointing, pose_errors, turn_left
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import solve, within_limits
from armctl.kinematics.target import direction_target
from armctl.kinematics.transform import FloatArray

ARMS = (
    "ax12-line", "crane-plus-v2", "lanzhou-4dof", "phantomx-pincher", "phantomx-reactor", "transfer-6dof", "xiang-6dof",
)  # fmt: skip


def robot_of(name: str) -> Robot:
    return robots.of(load_arm(name))


def points_along(robot: Robot, q: FloatArray) -> FloatArray:
    return np.asarray(forward_kinematics(robot.chain, q)[..., :3, :3] @ pointing(robot.chain))


@pytest.mark.parametrize("name", ARMS)
def test_the_tool_points_along_the_last_link(name: str) -> None:
    """Which ends at the tool point; of these arms none has a wrist in its tool point."""
    robot, rng = robot_of(name), np.random.default_rng(1)
    low, high = robot.limits_rad.T
    for q in rng.uniform(low, high, (5, robot.chain.n)):
        places = link_frames(robot.chain, q)[:, :3, 3]
        ways = places[-1] - places
        away = np.linalg.norm(ways, axis=1)
        last = int(np.flatnonzero(away > 1e-9)[-1])
        np.testing.assert_allclose(points_along(robot, q), ways[last] / away[last], atol=1e-12)


@pytest.mark.parametrize("name", ARMS)
def test_where_a_posture_within_limits_is_and_points_is_reached_within_limits(
    name: str,
) -> None:
    robot, rng = robot_of(name), np.random.default_rng(2)
    low, high = robot.limits_rad.T
    for q in rng.uniform(low, high, (8, robot.chain.n)):
        T, d = forward_kinematics(robot.chain, q), points_along(robot, q)
        found = solve(robot, direction_target(T[:3, 3], 2.5 * d), present=rng.uniform(low, high))
        assert found.reachable
        best = np.array(found.solutions[0].q_rad)
        assert within_limits(best, robot.limits_rad)
        np.testing.assert_allclose(forward_kinematics(robot.chain, best)[:3, 3], T[:3, 3], atol=1e-6)
        np.testing.assert_allclose(points_along(robot, best), d, atol=2e-6)


def test_a_hand_that_only_has_to_point_travels_less_than_one_that_is_turned_as_well() -> None:
    robot = robot_of("transfer-6dof")
    present = np.radians((0.0, -80.0, 40.0, 10.0, 30.0, 90.0))
    T = forward_kinematics(robot.chain, present + np.radians((5.0, 5.0, 5.0, 5.0, 5.0, 60.0)))
    free = solve(robot, direction_target(T[:3, 3], T[:3, 2]), present=present).solutions[0].q_rad
    assert abs(free[5] - present[5]) < np.radians(20.0), "the last joint turns about the direction itself"


def test_where_the_arm_points_already_it_stays() -> None:
    robot = robot_of("crane-plus-v2")
    q = np.radians((20.0, -30.0, -60.0, -50.0))
    T = forward_kinematics(robot.chain, q)
    found = solve(robot, direction_target(T[:3, 3], points_along(robot, q)), present=q)
    assert found.solutions[0].q_rad == tuple(q.tolist())


def test_an_arm_that_cannot_point_there_says_so() -> None:
    """Its four joints keep the tool in a plane through the waist."""
    robot = robot_of("crane-plus-v2")
    found = solve(robot, direction_target((0.2, 0.0, 0.1), (0.0, 1.0, 0.0)))
    assert not found.reachable


def test_the_turn_left_points_the_tool_there_from_anywhere_also_from_the_opposite() -> None:
    robot, rng = robot_of("xiang-6dof"), np.random.default_rng(3)
    q = rng.uniform(-1.0, 1.0, (20, robot.chain.n))
    T = forward_kinematics(robot.chain, q)
    directions = rng.standard_normal((20, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    directions[0], directions[1] = points_along(robot, q)[0], -points_along(robot, q)[1]
    angles = np.arccos(np.clip((points_along(robot, q) * directions).sum(axis=1), -1.0, 1.0))
    for pose, d, angle, joints in zip(T, directions, angles, q, strict=True):
        turn = turn_left(robot.chain, pose[:3, :3], pose, d)
        assert np.linalg.norm(turn) == pytest.approx(angle, abs=1e-7)
        assert abs(turn @ d) < 1e-7
        assert pose_errors(robot.chain, joints, pose, d)[1] == pytest.approx(angle, abs=1e-7)


def test_turns_about_the_direction_are_no_part_of_the_jacobian() -> None:
    robot, d = robot_of("ax12-line"), np.array([0.6, 0.0, -0.8])
    q = np.full((3, robot.chain.n), 0.3)
    J = masked_jacobian(robot.chain, q, d)
    np.testing.assert_allclose(d @ J[:, 3:], 0.0, atol=1e-15)
    np.testing.assert_array_equal(J[:, :3], jacobian(robot.chain, q)[:, :3])
    np.testing.assert_array_equal(masked_jacobian(robot.chain, q, None), jacobian(robot.chain, q))


@pytest.mark.parametrize("direction", [(0.0, 0.0, 0.0), (0.0, float("nan"), 1.0), (1.0, 0.0)])
def test_what_is_no_direction_is_refused(direction: tuple[float, ...]) -> None:
    with pytest.raises(ConfigError, match=r"target: direction: .* is no direction; give x,y,z in the base frame"):
        direction_target((0.1, 0.0, 0.1), direction)
