"""What `solve` promises to who stands somewhere: the arm stays where it may, or comes to the nearest place."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, tool_position
from armctl.kinematics.genetic import solve as genetic
from armctl.kinematics.inverse import pose_errors, refine_poses, within_a_turn
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import solve, weighted_travel, within_limits
from armctl.kinematics.target import point_target, pose_target
from armctl.kinematics.transform import FloatArray, finite
from tests.kinematics.conftest import rngs

PUMA_DEG = ((-160, 160), (-225, 45), (-45, 225), (-110, 170), (-100, 100), (-266, 266))
AX_DEG = ((-145, 145),) * 6
NAMES = ("puma560", "transfer-6dof", "lanzhou-4dof", "xiang-6dof", "ax12-line")
# Six joints of which the last three do not meet: no closed form.
OFFSET_WRIST = SerialChain(
    (
        DHRow(alpha=np.pi / 2, d=0.1),
        DHRow(a=0.2),
        DHRow(a=0.03, alpha=-np.pi / 2),
        DHRow(alpha=np.pi / 2, d=0.17, a=0.02),
        DHRow(alpha=-np.pi / 2, a=0.015),
        DHRow(d=0.06),
    )
)
ARMS = {
    "offset wrist": Robot("offset", "", {}, lambda _: OFFSET_WRIST, ranges_deg=((-150.0, 150.0),) * 6),
    "three joints": Robot(
        "three", "", {}, lambda _: SerialChain(OFFSET_WRIST.rows[:3]), ranges_deg=((-150.0, 150.0),) * 3
    ),
}


def limits_of(name: str) -> FloatArray:
    """Ranges as joints of an arm have them: no joint turns all round."""
    n = robots.get(name).chain.n
    wanted = {"puma560": PUMA_DEG, "lanzhou-4dof": ((-90, 90), (7, 131), (-90, 123), (-90, 82))}.get(name, AX_DEG)
    return np.radians(np.array(wanted[:n], dtype=np.float64))


def drawn(limits: FloatArray, rng: np.random.Generator) -> FloatArray:
    low, high = limits.T
    return np.asarray(rng.uniform(low, high))


@pytest.mark.no_cover
@given(st.sampled_from(NAMES), rngs, st.booleans())
@settings(max_examples=60, deadline=None)
def test_an_arm_that_is_there_stays(name: str, rng: np.random.Generator, turned: bool) -> None:
    robot, limits = robots.get(name), limits_of(name)
    q = drawn(limits, rng)
    if robot.chain.n == 6 and rng.random() < 0.5:
        q[4] = 0.0  # two axes of the wrist fall into one line
    T = forward_kinematics(robot.chain, q)
    target = pose_target(T) if turned else point_target(T[:3, 3])
    found = solve(robot, target, present=q, limits=limits)
    assert found.reachable
    assert found.solutions[0].q_rad == tuple(q.tolist())
    assert not any(np.abs(q - other.q_rad).max() < 1e-6 for other in found.solutions[1:])


@given(st.sampled_from(["puma560", "transfer-6dof"]), rngs)
@settings(max_examples=60, deadline=None)
def test_where_a_wrist_is_straight_the_nearest_within_limits_is_found(name: str, rng: np.random.Generator) -> None:
    """Axes 4 and 6 fall into one line there, and only their sum is given."""
    robot, limits = robots.get(name), limits_of(name)
    q = drawn(limits, rng)
    q[4] = 0.0
    target = pose_target(forward_kinematics(robot.chain, q))
    present = np.clip(q + rng.uniform(-0.4, 0.4, 6), *limits.T)
    best = solve(robot, target, present=present, limits=limits).solutions[0]
    assert best.within_limits
    # Beside every member of the family of q itself.
    members = np.repeat(q[None], 721, axis=0)
    turn = np.linspace(-np.pi, np.pi, 721)
    members[:, 3] += turn
    members[:, 5] -= turn
    members = members[within_limits(members, limits)]
    travel = weighted_travel(np.array(best.q_rad), present, limits)
    assert travel <= weighted_travel(members, present, limits).min() + 1e-6


@pytest.mark.no_cover
@given(st.sampled_from(["lanzhou-4dof", "ax12-line"]), rngs)
@settings(max_examples=80, deadline=None)
def test_a_point_that_is_reached_at_limits_is_found_within_them(name: str, rng: np.random.Generator) -> None:
    robot, limits = robots.get(name), limits_of(name)
    q = drawn(limits, rng)
    for joint in rng.choice(robot.chain.n, int(rng.integers(0, 3)), replace=False):
        q[joint] = limits[joint, rng.integers(2)]
    best = solve(robot, point_target(tool_position(robot.chain, q)), limits=limits).solutions[0]
    assert best.within_limits
    assert best.position_error_m < 1e-6


@pytest.mark.parametrize("name", ARMS)
def test_without_a_closed_form_a_solution_is_found_and_none_near_it_is_nearer(name: str) -> None:
    robot, rng, found, nearest = ARMS[name], np.random.default_rng(3), 0, 0
    assert robot.closed_form is None
    low, high = robot.limits_rad.T
    for q in rng.uniform(low, high, (40, robot.chain.n)):
        T = forward_kinematics(robot.chain, q)
        target = pose_target(T) if robot.chain.n == 6 else point_target(T[:3, 3])
        present = np.clip(q + rng.uniform(-0.3, 0.3, q.shape), low, high)
        best = solve(robot, target, present=present).solutions[0]
        found += best.within_limits and best.position_error_m < 1e-6
        travel = weighted_travel(np.array([best.q_rad, q]), present, robot.limits_rad)
        nearest += bool(travel[0] <= travel[1] + 1e-6)
    assert (found, nearest) == (40, 40)


@pytest.mark.parametrize(
    ("method", "xyz"), [("ga", np.array([0.18, 0.05, 0.1])), ("ga-improved", np.array([0.2, 0.0, 0.15]))]
)
def test_a_genetic_algorithm_says_reachable_only_of_what_it_reaches(method: Any, xyz: FloatArray) -> None:
    robot = robots.get("ax12-line")
    rough = genetic.solve(robot, point_target(xyz), method=method, polish=False, seed=1)
    assert rough.reachable == (rough.solutions[0].position_error_m <= 1e-6)
    assert rough.least_position_error_m == 0.0
    assert genetic.solve(robot, point_target(xyz), method=method, seed=1).reachable


@pytest.mark.no_cover
@given(rngs)
@settings(max_examples=30, deadline=None)
def test_of_the_family_that_a_fourth_link_leaves_the_nearest_is_found(rng: np.random.Generator) -> None:
    """Beside every member that the closed form has by steps of a degree."""
    robot, limits = robots.get("ax12-line"), limits_of("ax12-line")
    form = robot.closed_form
    assert isinstance(form, PlanarArm)
    q, present = drawn(limits, rng), drawn(limits, rng)
    T = forward_kinematics(robot.chain, q)
    best = solve(robot, pose_target(T), present=present, limits=limits).solutions[0]
    members = np.vstack([q, *(finite(form.poses(T[None], bend)) for bend in np.radians(np.arange(-150.0, 151.0)))])
    members = within_a_turn(members, limits)
    members = members[within_limits(members, limits)]
    assert best.within_limits
    travel = weighted_travel(np.array(best.q_rad), present, limits)
    assert travel <= weighted_travel(members, present, limits).min() + 1e-6


SEVEN = Robot(
    "seven",
    "",
    {},
    lambda _: SerialChain(
        (*OFFSET_WRIST.rows[:2], DHRow(a=0.1, alpha=np.pi / 2), *OFFSET_WRIST.rows[2:5], DHRow(d=0.06))
    ),
    ranges_deg=((-130.0, 130.0),) * 7,
)


@pytest.mark.no_cover
def test_of_seven_joints_none_of_thirty_restarts_comes_nearer() -> None:
    rng, (low, high) = np.random.default_rng(8), SEVEN.limits_rad.T
    for _ in range(15):
        q, present = drawn(SEVEN.limits_rad, rng), drawn(SEVEN.limits_rad, rng)
        T = forward_kinematics(SEVEN.chain, q)
        best = solve(SEVEN, pose_target(T), present=present).solutions[0]
        assert best.within_limits
        assert max(best.position_error_m, best.orientation_error_rad) < 1e-6
        restarts = refine_poses(
            SEVEN.chain,
            np.repeat(T[None], 31, axis=0),
            np.vstack([q, rng.uniform(low, high, (30, 7))]),
            SEVEN.limits_rad,
        )
        reached = np.max(pose_errors(SEVEN.chain, restarts, np.repeat(T[None], 31, axis=0)), axis=0) < 1e-6
        others = weighted_travel(restarts[reached], present, SEVEN.limits_rad)
        assert weighted_travel(np.array(best.q_rad), present, SEVEN.limits_rad) <= others.min() + 1e-3
