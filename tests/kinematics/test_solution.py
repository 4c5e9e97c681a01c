"""Inverse kinematics: targets, every solution, the best of them, and what is out of reach."""

import dataclasses
import math
from typing import Literal, get_args

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import ConfigError, UnreachableTarget
from armctl.kinematics import robots, solution
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.inverse import pose_errors, refine_poses, solve_position, within_a_turn
from armctl.kinematics.robots import papers
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import solve, weighted_travel, within_limits
from armctl.kinematics.target import point_target, pose_target
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy
from tests.kinematics.conftest import rngs, seeds

# On ax12-line, whose shoulder is as high, so that each posture has its mirror image.
MIRRORED_M = np.array([0.18, 0.05, 0.1])

Method = Literal["closed", "numeric"]


def in_range(robot: Robot, count: int, seed: int = 5) -> FloatArray:
    limits = robot.limits_rad
    return np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (count, robot.chain.n))


def test_every_pose_in_range_is_reached_in_range(robot: Robot) -> None:
    for q in in_range(robot, 30):
        answer = solve(robot, pose_target(forward_kinematics(robot.chain, q)))
        assert (answer.reachable, answer.least_position_error_m) == (True, 0.0)
        assert all(max(one.position_error_m, one.orientation_error_rad) < 1e-12 for one in answer.solutions)
        assert answer.solutions[0].within_limits


@pytest.mark.parametrize("name", ["lanzhou-4dof", "puma560", "transfer-6dof", "xiang-6dof"])
def test_the_configuration_a_pose_came_from_is_among_its_solutions(name: str) -> None:
    robot = robots.get(name)
    for q in in_range(robot, 50, seed=8):
        answer = solve(robot, pose_target(forward_kinematics(robot.chain, q)), present=q)
        away = np.abs((np.array(answer.solutions[0].q_rad) - q + np.pi) % (2.0 * np.pi) - np.pi)
        # Where the arm is nearly straight, an angle is only as good as the square root of the pose's last digit.
        assert away.max() < 1e-7
        assert float(np.median(away)) < 1e-12


@pytest.mark.parametrize("method", get_args(Method))
def test_every_point_in_range_is_reached_to_1e_9(robot: Robot, method: Method) -> None:
    for q in in_range(robot, 10):
        answer = solve(robot, point_target(tool_position(robot.chain, q)), method=method)
        assert answer.reachable
        assert answer.solutions[0].position_error_m < 1e-9
        assert answer.solutions[0].orientation_error_rad == 0.0


@pytest.mark.no_cover
@pytest.mark.parametrize("method", get_args(Method))
def test_out_of_reach_the_nearest_configuration_is_at_the_least_distance(
    robot: Robot, method: Method, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(solution, "ROUNDS", 1)  # more of them would find no more
    T = forward_kinematics(robot.chain, in_range(robot, 1)[0])
    T[:3, 3] = [1.1, -0.4, 0.2]
    cloud = tool_position(robot.chain, np.random.default_rng(0).uniform(-np.pi, np.pi, (20000, robot.chain.n)))
    nearest_sample = float(np.linalg.norm(cloud - T[:3, 3], axis=1).min())
    for target in (point_target(T[:3, 3]), pose_target(T)):
        answer = solve(robot, target, method=method)
        assert not answer.reachable
        for one in answer.solutions:
            assert one.position_error_m == pytest.approx(answer.least_position_error_m, abs=1e-9)
    assert solve(robot, point_target(T[:3, 3])).least_position_error_m <= nearest_sample


def test_three_of_the_hundred_grid_targets_of_xiang_are_out_of_reach_by_known_distances() -> None:
    robot = robots.get("xiang-6dof")
    missed = {}
    for x in range(21, 31):
        for y in range(21, 31):
            answer = solve(robot, point_target((x / 100.0, y / 100.0, 0.10)))
            if answer.reachable:
                assert answer.solutions[0].position_error_m < 1e-9
            else:
                missed[x, y] = answer.least_position_error_m
    # The shoulder is 0.1 cm above the grid, the reach 12.3 + 13.8 + 15.5 cm.
    assert missed == {
        (x, y): pytest.approx(math.hypot(x, y, 0.1) / 100.0 - 0.416, abs=1e-15)
        for x, y in ((29, 30), (30, 29), (30, 30))
    }
    assert sum(missed.values()) == pytest.approx(0.0107, abs=1e-4)


@pytest.mark.no_cover
def test_two_hundred_puma_poses_are_solved_numerically_to_1e_6() -> None:
    robot = dataclasses.replace(robots.get("puma560"), closes=False)
    for T in forward_kinematics(robot.chain, in_range(robot, 200)):
        found = solve(robot, pose_target(T)).solutions[0]
        assert max(found.position_error_m, found.orientation_error_rad) <= 1e-6


def test_the_puma_of_table_2_has_eight_solutions() -> None:
    target = pose_target(pose_from_xyz_rpy(*papers.WANTED_XYZ_RPY))
    answer = solve(robots.get("puma560"), target, polish=False)
    assert len(answer.solutions) == 8
    assert all(one.position_error_m < 1e-12 and one.orientation_error_rad < 1e-12 for one in answer.solutions)


def test_the_solution_nearest_to_the_present_comes_first() -> None:
    robot = robots.get("puma560")
    target = pose_target(forward_kinematics(robot.chain, in_range(robot, 1)[0]))
    answer = solve(robot, target)
    for one in answer.solutions:
        near = np.array(one.q_rad) + 0.01
        np.testing.assert_allclose(solve(robot, target, present=near).solutions[0].q_rad, one.q_rad, atol=1e-9)
    travels = [float(weighted_travel(np.array(one.q_rad), np.zeros(6), robot.limits_rad)) for one in answer.solutions]
    assert travels == sorted(travels)


@pytest.mark.no_cover
@given(rngs, st.floats(-16.0, -11.0))
@settings(max_examples=30)
def test_of_mirror_images_that_are_as_near_the_same_comes_first_however_numbers_are_rounded(
    rng: np.random.Generator, digits: float
) -> None:
    rounded_m = rng.normal(size=3) * 10.0**digits
    found = solve(robots.get("ax12-line"), point_target(MIRRORED_M + rounded_m), present=np.zeros(5)).solutions
    assert found[0].q_rad[1] == pytest.approx(0.8782203, abs=1e-6)


def test_a_point_that_is_hardly_beside_the_plane_of_the_arm_is_solved() -> None:
    """Its base angle is so small that a way divided by it is more than a float can hold."""
    robot = robots.get("xiang-6dof")
    assert solve(robot, point_target(np.array([0.25, 5e-310, 0.1])), present=np.zeros(5)).reachable


def test_eq_10_weighs_the_first_joint_double_and_goes_the_short_way_round() -> None:
    limits = np.array([[-np.pi, np.pi], [-1.0, 3.0], [-1.0, 3.0], [-1.0, 3.0]])
    q = np.array([3.1, 2.0, 0.0, 0.0])
    assert float(weighted_travel(q, np.array([-3.1, -0.5, 0.1, 0.0]), limits)) == pytest.approx(
        1.0 * (2.0 * np.pi - 6.2) + 0.5 * 2.5 + 0.5 * 0.1
    )


def test_solutions_outside_the_ranges_are_marked_and_come_last() -> None:
    robot = robots.get("lanzhou-4dof")
    q = np.radians([20.0, 60.0, 70.0, 40.0])
    answer = solve(robot, pose_target(forward_kinematics(robot.chain, q)))
    assert [one.within_limits for one in answer.solutions] == [True, False]
    assert not within_limits(np.array(answer.solutions[1].q_rad), robot.limits_rad)
    np.testing.assert_allclose(answer.solutions[0].q_rad, q, atol=1e-12)
    wider = np.radians([[-180.0, 180.0]] * 4)
    again = solve(robot, pose_target(forward_kinematics(robot.chain, q)), limits=wider)
    assert [one.within_limits for one in again.solutions] == [True, True]


def test_a_rotation_the_arm_cannot_take_leaves_the_position_exact() -> None:
    answer = solve(robots.get("lanzhou-4dof"), pose_target(pose_from_xyz_rpy(0.2, 0.1, -0.05, 0.4, 0.3, -0.2)))
    assert (answer.reachable, answer.least_position_error_m) == (False, 0.0)
    assert answer.solutions[0].position_error_m < 1e-12
    assert answer.solutions[0].orientation_error_rad > 0.1


@pytest.mark.parametrize(
    ("T", "message"),
    [
        (np.eye(3), "shape"),
        (np.full((4, 4), np.nan), "not finite"),
        (np.diag([1.0, 1.0, 2.0, 1.0]), "not a rotation: R R"),
        (np.diag([1.0, 1.0, -1.0, 1.0]), "reflection"),
        (np.ones((4, 4)), "last row"),
    ],
)
def test_what_is_no_pose_is_refused(T: FloatArray, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        pose_target(T)


def test_what_is_no_point_is_refused() -> None:
    for wrong in (np.zeros(2), np.array([0.0, np.inf, 0.0])):
        with pytest.raises(ConfigError, match="three finite numbers"):
            point_target(wrong)
    with pytest.raises(ConfigError, match="the chain has 6 joints"):
        solve(robots.get("puma560"), point_target((0.1, 0.2, 0.3)), present=np.zeros(5))


def test_typed_rounding_of_a_rotation_is_removed() -> None:
    T = np.round(pose_from_xyz_rpy(0.1, 0.2, 0.3, 0.4, 0.5, 0.6), 5)
    clean = pose_target(T).T
    np.testing.assert_allclose(clean[:3, :3] @ clean[:3, :3].T, np.eye(3), atol=1e-15)
    np.testing.assert_allclose(clean, T, atol=2e-5)


def test_without_a_closed_form_the_numeric_one_answers(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(solution, "ROUNDS", 1)
    robot = dataclasses.replace(robots.get("lanzhou-4dof"), closes=False)
    assert solve(robot, pose_target(forward_kinematics(robot.chain, in_range(robot, 1)[0]))).reachable
    far = solve(robot, point_target((1.0, 0.0, 0.0)))
    assert not far.reachable
    assert far.least_position_error_m == pytest.approx(far.solutions[0].position_error_m)


# ------------------------------------------------------------------------------------------------------ the numeric one


CHAIN = robots.get("ax12-line").chain
LIMITS = np.radians([[-145, 145], [-10, 160], [-145, 145], [-110, 110], [-110, 110]])


@given(rngs)
@settings(max_examples=200)
def test_a_reachable_target_is_found_within_limits_from_nearby(rng: np.random.Generator) -> None:
    # Away from the folded and the stretched arm, where nearby is not near enough.
    truth = np.array([*rng.uniform([-2.0, 0.5], [2.0, 2.0]), *rng.uniform([-1.8, -0.8, -0.8], [-0.6, 0.8, 0.8])])
    target = tool_position(CHAIN, truth)
    q = solve_position(CHAIN, target, truth + rng.uniform(-0.15, 0.15, 5), LIMITS)
    assert np.linalg.norm(tool_position(CHAIN, q) - target) <= 1e-9
    assert ((q >= LIMITS[:, 0]) & (q <= LIMITS[:, 1])).all()


def test_out_of_reach_is_refused_with_the_least_distance() -> None:
    q = np.array([0.0, 0.3, -0.3, 0.1, 0.1])
    with pytest.raises(UnreachableTarget, match=r"no nearer than 120\.0 mm") as caught:
        solve_position(CHAIN, np.array([0.5, 0.0, 0.1]), q, LIMITS)
    assert caught.value.least_error_m == pytest.approx(0.12, abs=1e-5)


@pytest.mark.parametrize("last_rad", [tuple(LIMITS[4]), (0.0, 1e-12)])
def test_a_joint_at_its_limit_leaves_the_work_to_the_others_and_a_start_beyond_it_is_clipped(
    last_rad: tuple[float, float],
) -> None:
    limits = np.array([*LIMITS[:4], last_rad])
    target = np.array([0.18, 0.0, 0.1])
    q = solve_position(CHAIN, target, np.array([0.0, 1.9, -1.6, -0.9, 5.0]), limits)
    assert last_rad[0] <= q[4] <= last_rad[1]
    np.testing.assert_allclose(tool_position(CHAIN, q), target, atol=1e-9)


@given(st.sampled_from(robots.names()), seeds)
@settings(max_examples=30)
def test_poses_are_refined_to_1e_12_from_nearby_and_stay_within_limits(name: str, seed: int) -> None:
    robot, rng = robots.get(name), np.random.default_rng(seed)
    limits = robot.limits_rad
    truth = rng.uniform(limits[:, 0], limits[:, 1], (20, robot.chain.n))
    T = forward_kinematics(robot.chain, truth)
    starts = truth + rng.uniform(-0.05, 0.05, truth.shape)
    q = refine_poses(robot.chain, T, starts, limits)
    assert within_limits(q, limits).all()
    before, after = (pose_errors(robot.chain, some_q, T) for some_q in (starts, q))
    assert np.median(after, axis=1).max() < 1e-12
    assert (np.hypot(*after) <= np.hypot(*before) * 2.0).all()


def test_a_position_alone_is_refined_whatever_the_rotation() -> None:
    robot = robots.get("lanzhou-4dof")
    q = np.radians([[20.0, 60.0, 40.0, 10.0]])
    T = forward_kinematics(robot.chain, q)
    T[:, :3, :3] = np.eye(3)
    found = refine_poses(robot.chain, T, q + 0.05, robot.limits_rad, turned=False)
    np.testing.assert_allclose(tool_position(robot.chain, found), T[:, :3, 3], atol=1e-12)


def test_a_search_is_repeated_by_its_seed() -> None:
    robot = dataclasses.replace(robots.get("puma560"), closes=False)
    target = pose_target(forward_kinematics(robot.chain, np.random.default_rng(3).uniform(-3.0, 3.0, 6)))
    first, second = (solve(robot, target, seed=9).solutions for _ in range(2))
    assert first == second


def test_angles_are_moved_by_whole_turns_into_their_range() -> None:
    limits = np.radians([[-180.0, 180.0], [-200.0, 20.0], [7.0, 131.0]])
    found = within_a_turn(np.radians([[370.0, 175.0, 367.0 + 20.0], [-190.0, 90.0, 200.0]]), limits)
    np.testing.assert_allclose(np.degrees(found), [[10.0, -185.0, 27.0], [170.0, 90.0, -160.0]], atol=1e-9)
