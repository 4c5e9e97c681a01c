"""The way to a point: straight, within limits, by every inverse kinematics; and what the gripper is told."""

import math
from typing import Any, get_args

import numpy as np
import pytest
from hypothesis import example, given, reject, settings
from hypothesis import strategies as st

from armctl.config import validate
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, RequestRefused, UnreachableTarget
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, forward_kinematics, tool_position
from armctl.kinematics.inverse import refine_poses
from armctl.kinematics.transform import FloatArray
from armctl.trajectory import grasp
from armctl.trajectory.grasp import Method, ReachRequest
from armctl.trajectory.preflight import DrivenArm, peak_rates, peak_tool_speed
from tests.host.doubles import refused

POINT = (0.20, 0.05, 0.06)
PERIOD_S = 0.1


def where_of(name: str) -> tuple[list[float], DrivenArm]:
    """Where a motion of this arm begins, at rest, and what else every function here asks for."""
    arm = load_arm(name)
    return [joint.rest_rad for joint in arm.joints], DrivenArm(arm, robots.get(arm.robot, arm.lengths_m), PERIOD_S)


# An arm with a gripper, the last joint.
XIANG = where_of("xiang-6dof")
REST, ON = XIANG
ARM, ROBOT = ON.arm, ON.robot


def path_to(point: tuple[float, float, float] = POINT, **how: Any) -> FloatArray:
    return grasp.plan_grasp(ReachRequest(point_m=point, **how), *XIANG)


def keeps_its_turn(chain: SerialChain, q: FloatArray, places_m: FloatArray, limits: FloatArray) -> bool:
    """Whether the tool can go from place to place as it is turned at q, within the limits."""
    T, anywhere = forward_kinematics(chain, q), np.tile([-np.pi, np.pi], (chain.n, 1))
    for place in places_m:
        T[:3, 3] = place
        q = refine_poses(chain, T[None], q[None], anywhere, turned=True)[0]
        if not ((limits[: chain.n, 0] <= q) & (q <= limits[: chain.n, 1])).all():
            return False
    return True


@pytest.mark.no_cover
@settings(max_examples=20)
@example("xiang-6dof", (0.220703125, 0.078125, 0.0625))  # the elbow would go beyond its limit, and does not come to it
@example("xiang-6dof", (0.23046875, 0.0, 0.0625))  # the elbow comes to its limit
@given(
    st.sampled_from(["xiang-6dof", "ax12-line"]),
    st.tuples(st.floats(0.12, 0.26), st.floats(-0.15, 0.15), st.floats(0.05, 0.2)),
)
def test_the_tool_comes_down_a_straight_line_and_turns_only_where_a_joint_is_at_its_limit(
    name: str, point: tuple[float, float, float]
) -> None:
    q_now, on = where_of(name)
    arm, robot = on.arm, on.robot
    try:
        planned = grasp.plan_grasp(ReachRequest(point_m=point, off_m=0.04), q_now, on)
    except RequestRefused:
        reject()
    there = grasp.approach(planned, q_now, on).positions_rad[-1]
    down = np.array(grasp.straight(planned, there, on).positions_rad)
    T = forward_kinematics(robot.chain, down[:, : robot.chain.n])
    assert T[-1, :3, 3] == pytest.approx(point, abs=1e-6)
    assert T[0, :3, 3] == pytest.approx(np.add(point, (0.0, 0.0, 0.04)), abs=1e-5)
    assert np.abs(T[:, :2, 3] - np.array(point[:2])).max() < 2e-4
    assert (np.diff(T[:, 2, 3]) < 1e-9).all()
    assert peak_tool_speed(T[:, :3, 3], PERIOD_S) <= grasp.STRAIGHT_M_S * 1.001
    low, high = np.array([joint.limits_rad for joint in arm.joints]).T
    turned = np.abs(T[:, :3, :3] - T[-1, :3, :3]).max() > 2e-3
    assert not (turned and keeps_its_turn(robot.chain, planned[-1], T[::-1, :3, 3], np.stack([low, high], 1)))
    assert ((down >= low - 1e-9) & (down <= high + 1e-9)).all()


def test_along_the_tool_s_axis_it_comes_from_where_the_tool_points_away_from() -> None:
    T = forward_kinematics(ROBOT.chain, path_to(off_m=0.03, along="tool"))
    assert T[0, :3, 3] == pytest.approx(T[-1, :3, 3] - 0.03 * T[-1, :3, 2], abs=1e-6)  # the hand is link 5, along z


@pytest.mark.parametrize("along", ["above", "tool"])
def test_the_tool_points_where_it_is_wanted_all_the_way_down(along: grasp.Along) -> None:
    wanted = np.array((0.3, 0.0, -1.0)) / np.linalg.norm((0.3, 0.0, -1.0))
    point = (0.2, 0.0, 0.1)
    for posture in (1, 2):
        path = path_to(point, direction=(0.3, 0.0, -1.0), along=along, off_m=0.02, posture=posture)
        T = forward_kinematics(ROBOT.chain, path)
        np.testing.assert_allclose(T[-1, :3, 3], point, atol=1e-6)
        np.testing.assert_allclose(T[:, :3, 2], np.broadcast_to(wanted, (len(T), 3)), atol=1e-4)


def test_a_genetic_algorithm_takes_no_direction() -> None:
    with pytest.raises(ConfigError, match="the method ga takes none; give closed or numeric"):
        validate(ReachRequest, {"point_m": POINT, "direction": (0, 0, -1), "ik": "ga"}, "reach")


def test_another_posture_at_the_point_can_be_asked_for_and_one_too_many_lists_them() -> None:
    first, second = (path_to(posture=k) for k in (1, 2))
    np.testing.assert_array_equal(first, path_to())
    assert np.abs(first[-1] - second[-1]).max() > math.radians(1.0)
    np.testing.assert_allclose(tool_position(ROBOT.chain, second[-1]), POINT, atol=1e-6)
    with refused("POSTURE", "of posture 13 there is none; these can be gone to; posture 1: ") as caught:
        path_to(posture=13)
    assert len(caught.value.reasons) > 2


@pytest.mark.parametrize("method", get_args(Method))
def test_every_method_reaches_the_same_point(method: Method) -> None:
    assert tool_position(ROBOT.chain, path_to(ik=method, seed=3)[-1]) == pytest.approx(POINT, abs=1e-6)


@pytest.mark.parametrize(("x", "away_m"), [(0.60, 0.184), (1.0, 0.584)])
def test_a_point_out_of_reach_is_told_with_its_exact_distance(x: float, away_m: float) -> None:
    with pytest.raises(UnreachableTarget) as caught:  # 0.123 + 0.138 + 0.155 m from a shoulder 0.101 m high
        path_to((x, 0.0, 0.101))
    assert caught.value.least_error_m == pytest.approx(away_m, abs=1e-9)


@pytest.mark.no_cover
@pytest.mark.parametrize(
    ("point", "match"),
    [
        ((0.2, 0.0, -0.02), "below the floor"),
        # The straight way leaves the reach: the message tells what is left of it.
        ((0.0, 0.1, 0.46), "can back off from the point by"),
    ],
)
def test_a_point_that_cannot_be_come_to_is_refused_before_anything_moves(
    point: tuple[float, float, float], match: str
) -> None:
    with refused("PREFLIGHT", match):
        path_to(point, off_m=0.3)


def test_a_gripper_closes_evenly_while_the_arm_stays() -> None:
    closing = grasp.gripping(*XIANG, closing=True)
    rows = np.array(closing.positions_rad)
    assert closing.grip is not None
    assert (closing.grip.joint, closing.grip.load_ratio) == (5, 0.3)
    assert rows[-1, 5] == pytest.approx(math.radians(90.0))
    assert (rows[:, :5] == np.array(REST)[:5]).all()
    assert peak_rates(rows, PERIOD_S)[0][5] <= grasp.CLOSING_RAD_S * 1.001
    opened = grasp.gripping(rows[-1].tolist(), ON, closing=False)
    assert opened.grip is None
    assert opened.positions_rad[-1] == pytest.approx(REST)


def test_an_arm_without_a_gripper_says_which_joints_it_has_instead() -> None:
    with refused("NO_GRIPPER", r"no gripper.*roll"):
        grasp.gripping(*where_of("ax12-line"), closing=True)


def test_a_joint_that_moves_the_tool_is_no_gripper() -> None:
    assert ARM.gripper is not None
    wrong = ARM.model_copy(update={"gripper": ARM.gripper.model_copy(update={"joint": "elbow"})})
    with pytest.raises(RequestRefused, match="elbow moves the tool point"):
        grasp.gripping(REST, DrivenArm(wrong, ROBOT, PERIOD_S), closing=True)


def test_a_gripper_never_pushes_so_far_that_it_counts_as_blocked() -> None:
    assert ARM.gripper is not None
    slope_tick = ARM.joints[5].compliance.slope
    behind_rad = (1 + ARM.gripper.load_ratio * slope_tick) * ax12a.TICK_RAD
    step_rad = grasp.CLOSING_RAD_S * PERIOD_S  # of the one goal that was under way when the load came
    assert behind_rad + step_rad < math.radians(8.0)
