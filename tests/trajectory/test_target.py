"""Where the joints have to be: on the target, inside the limits, near the present pose; or how far it is."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import UnreachableTarget
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy
from armctl.trajectory.target import joints_at
from tests.trajectory.conftest import ARM, CHAIN, LIMITS, ROBOT

N = CHAIN.n
NOW = tuple(math.radians(degrees) for degrees in (0.0, 87.0, -65.0, -64.0, -33.0, 20.0))

configurations = st.tuples(*(st.floats(low, high) for low, high in LIMITS.tolist()))


def at_point(point: FloatArray) -> list[float]:
    return joints_at(pose_from_xyz_rpy(*point), NOW, ARM, ROBOT, turned=False)


@given(configurations)
@settings(max_examples=25)
def test_every_point_some_pose_reaches_is_reached_within_the_limits(q: tuple[float, ...]) -> None:
    point = tool_position(CHAIN, np.array(q))
    found = at_point(point)
    assert tool_position(CHAIN, np.array(found[:N])) == pytest.approx(point, abs=2e-6)
    assert found[N:] == list(NOW[N:])
    for position, joint in zip(found, ARM.joints, strict=True):
        assert joint.limits_rad[0] <= position <= joint.limits_rad[1]


def test_the_solution_near_the_present_pose_is_taken() -> None:
    here = tool_position(CHAIN, np.array(NOW[:N]))
    assert np.abs(np.subtract(at_point(np.add(here, (0.0, 0.0, 0.005))), NOW)).max() < math.radians(5.0)


def test_a_point_out_of_reach_says_how_near_the_tool_comes() -> None:
    reach = sum(row.a for row in CHAIN.rows)
    shoulder = np.array([0.0, 0.0, CHAIN.rows[0].d])
    target = np.add(shoulder, (reach + 0.1, 0.0, 0.0))
    with pytest.raises(UnreachableTarget, match=r"no nearer than 100\.0 mm") as caught:
        at_point(target)
    assert caught.value.least_error_m == pytest.approx(0.1, abs=1e-4)


@given(configurations)
@settings(max_examples=20)
def test_a_pose_near_the_present_one_is_reached(q: tuple[float, ...]) -> None:
    wanted = np.array(NOW[:N]) + 0.1 * np.clip(np.array(q), -1.0, 1.0)
    T = forward_kinematics(CHAIN, wanted)
    assert forward_kinematics(CHAIN, np.array(joints_at(T, NOW, ARM, ROBOT)[:N])) == pytest.approx(T, abs=1e-3)


def test_a_pose_the_arm_cannot_take_says_how_far_off_it_stays() -> None:
    with pytest.raises(UnreachableTarget, match=r"no nearer than .* mm and .* deg"):
        joints_at(pose_from_xyz_rpy(0.18, 0.0, 0.15, yaw=math.pi / 2.0), NOW, ARM, ROBOT)
