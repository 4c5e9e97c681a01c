import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import UnreachableTarget
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.inverse import pose_errors, refine_poses, solve_poses, solve_position, within_a_turn
from armctl.kinematics.solution import within_limits

CHAIN = robots.get("ax12-line").chain
LIMITS = np.radians([[-145, 145], [-10, 160], [-145, 145], [-110, 110], [-110, 110]])


@given(st.integers(0, 2**32 - 1))
@settings(max_examples=200)
def test_a_reachable_target_is_found_within_limits_from_nearby(seed: int) -> None:
    rng = np.random.default_rng(seed)
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


@given(st.sampled_from(robots.names()), st.integers(0, 2**32 - 1))
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
    robot = robots.get("puma560")
    T = forward_kinematics(robot.chain, np.random.default_rng(3).uniform(-3.0, 3.0, (5, 6)))
    first, second = (solve_poses(robot.chain, T, robot.limits_rad, np.random.default_rng(9)) for _ in range(2))
    np.testing.assert_array_equal(first, second)


def test_angles_are_moved_by_whole_turns_into_their_range() -> None:
    limits = np.radians([[-180.0, 180.0], [-200.0, 20.0], [7.0, 131.0]])
    found = within_a_turn(np.radians([[370.0, 175.0, 367.0 + 20.0], [-190.0, 90.0, 200.0]]), limits)
    np.testing.assert_allclose(np.degrees(found), [[10.0, -185.0, 27.0], [170.0, 90.0, -160.0]], atol=1e-9)
