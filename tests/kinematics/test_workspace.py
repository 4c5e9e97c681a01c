"""Exact extents against what is known and against random configurations; the map of a grid."""

import dataclasses

import numpy as np
import pytest

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.workspace import cloud, cloud_extents, extents, grid, reachability

WHOLE_TURN = np.tile([-np.pi, np.pi], (5, 1))


def test_extents_of_arms_without_ranges_are_their_reach() -> None:
    rng = np.random.default_rng(0)
    found = extents(robots.get("xiang-6dof").chain, WHOLE_TURN, rng)
    np.testing.assert_allclose(found, [[-0.416, 0.416], [-0.416, 0.416], [-0.315, 0.517]], atol=1e-12)
    found = extents(robots.get("ax12-line").chain, WHOLE_TURN, rng)
    np.testing.assert_allclose(found, [[-0.38, 0.38], [-0.38, 0.38], [-0.28, 0.48]], atol=1e-12)
    reach = 0.4318 + np.hypot(0.0203, 0.4318)
    puma = robots.get("puma560")
    found = extents(puma.chain, puma.limits_rad, rng)
    side = np.hypot(reach, 0.1491)
    np.testing.assert_allclose(found, [[-side, side], [-side, side], [-reach, reach]], atol=1e-12)


def test_no_random_configuration_lies_outside_the_exact_extents_and_some_come_near(robot: Robot) -> None:
    rng = np.random.default_rng(1)
    exact = extents(robot.chain, robot.limits_rad, rng)
    random = cloud_extents(cloud(robot.chain, robot.limits_rad, 50_000, rng))
    assert (random[:, 0] >= exact[:, 0] - 1e-12).all()
    assert (random[:, 1] <= exact[:, 1] + 1e-12).all()
    assert np.abs(exact - random).max() < 0.04


def test_extents_of_lanzhou_within_its_ranges() -> None:
    robot = robots.get("lanzhou-4dof")
    found = extents(robot.chain, robot.limits_rad, np.random.default_rng(2))
    assert found[2, 0] == pytest.approx(-0.307, abs=1e-12)  # straight down: 77 + 97 + 133 mm
    # Forward and up the fine grid of the three pitches knows no better place.
    q1 = np.linspace(-np.pi / 2.0, np.pi / 2.0, 181)
    ranges = [np.linspace(low, high, 60) for low, high in robot.limits_rad[1:]]
    pitches = np.stack(np.meshgrid(*ranges), axis=-1).reshape(-1, 3)
    points = tool_position(robot.chain, np.concatenate((np.zeros((len(pitches), 1)), pitches), axis=1))
    z = points[:, 2]
    x = np.max(np.cos(q1)[:, None] * points[:, 0].max() - np.sin(q1)[:, None] * 0.042)
    assert z.max() <= found[2, 1] + 1e-12
    assert found[2, 1] - z.max() < 2e-3
    assert x <= found[0, 1] + 1e-12
    assert found[0, 1] - x < 2e-3


def test_the_map_of_a_grid_says_what_inverse_kinematics_says() -> None:
    robot = robots.get("xiang-6dof")
    points = grid(np.array([[-0.5, 0.5]] * 3), 7)
    found = reachability(robot, points)
    shoulder = np.linalg.norm(points - [0.0, 0.0, 0.101], axis=1)
    np.testing.assert_array_equal(found.reachable, shoulder <= 0.416)
    assert ((found.share >= 0.0) & (found.share <= 1.0)).all()


def test_joint_ranges_shrink_the_map() -> None:
    robot = robots.get("lanzhou-4dof")
    points = grid(np.array([[-0.3, 0.3]] * 3), 6)
    narrow, wide = reachability(robot, points), reachability(robot, points, np.tile([-np.pi, np.pi], (4, 1)))
    assert not (narrow.reachable & ~wide.reachable).any()
    assert narrow.reachable.sum() < wide.reachable.sum()
    with pytest.raises(ConfigError, match="no closed form"):
        reachability(dataclasses.replace(robot, make_closed_form=None), points)
