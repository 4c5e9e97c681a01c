"""Where the tool can be: exact extents, the map of a grid, and the swept annulus: in it or how far from it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.random import Generator as Rng

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.annulus import PlaneReach, annulus
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.kinematics.workspace import cloud, cloud_extents, extents, grid, reachability
from tests.kinematics.conftest import rngs

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
        reachability(dataclasses.replace(robot, closes=False), points)


# ---------------------------------------------------------------------------------------------------- the swept annulus


offset = st.floats(-0.3, 0.3)
links = st.lists(st.floats(0.05, 0.6), min_size=2, max_size=4).map(tuple)
reaches = st.builds(PlaneReach, links, offset, offset, offset)
points = st.tuples(*[st.floats(-2.0, 2.0)] * 3).map(np.array)


def sweep(reach: PlaneReach, u: FloatArray, v: FloatArray, turn: FloatArray) -> FloatArray:
    c, s = np.cos(turn), np.sin(turn)
    out = u + reach.a1
    return np.stack((out * c + reach.offset * s, out * s - reach.offset * c, v + reach.height), axis=-1)


@given(reaches, points, rngs)
@example(PlaneReach((0.5, 0.25), 0.0, 0.0, 0.0), np.array([5e-324, 5e-324, 0.0]), np.random.default_rng(0))
def test_no_point_of_the_workspace_is_nearer_than_the_nearest(reach: PlaneReach, point: FloatArray, rng: Rng) -> None:
    near, distance = reach.nearest(point)
    assert np.linalg.norm(near - point) == pytest.approx(distance, abs=1e-12)
    radius, angle = rng.uniform(*annulus(reach.links_m), 3000), rng.uniform(-np.pi, np.pi, 3000)
    places = sweep(reach, radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-np.pi, np.pi, 3000))
    assert np.linalg.norm(places - point, axis=1).min() >= distance - 1e-9
    # The nearest point itself is in it: at distance 0 from it.
    again, rest = reach.nearest(near)
    assert rest < 1e-9
    np.testing.assert_allclose(again, near, atol=1e-9)


@given(reaches, rngs)
def test_every_place_of_the_links_is_in_reach(reach: PlaneReach, rng: Rng) -> None:
    angles = np.cumsum(rng.uniform(-np.pi, np.pi, len(reach.links_m)))
    u, v = np.stack((np.cos(angles), np.sin(angles))) @ reach.links_m
    assert reach.nearest(sweep(reach, u, v, np.array(rng.uniform(-3.0, 3.0))))[1] == 0.0


def test_known_distances() -> None:
    arm, beside = PlaneReach((0.3, 0.1), 0.0, 0.0, 0.5), PlaneReach((0.3, 0.1), 0.0, 0.05, 0.0)
    assert arm.nearest(np.array([1.0, 0.0, 0.5]))[1] == pytest.approx(0.6, abs=1e-15)
    assert arm.nearest(np.array([0.0, 0.0, 0.5]))[1] == pytest.approx(0.2, abs=1e-15)
    near, distance = beside.nearest(np.array([0.02, 0.0, 0.3]))
    assert distance == pytest.approx(0.03, abs=1e-15)
    np.testing.assert_allclose(near, [0.05, 0.0, 0.3], atol=1e-15)
    np.testing.assert_allclose([annulus((0.3, 0.1)), annulus((0.2, 0.2, 0.1))], [[0.2, 0.4], [0.0, 0.5]], atol=1e-15)
    assert np.isfinite(beside.nearest(np.zeros(3))[1])
