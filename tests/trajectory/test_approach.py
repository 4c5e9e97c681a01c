"""Slow motions keep every limit on their way, and are no slower than they must be."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics.chain import tool_position
from armctl.trajectory.approach import SHORTEST_APPROACH_S, approach_duration_s, approach_trajectory, lowest_link_m
from tests.trajectory.conftest import ARM, ROBOT

PERIOD_S = 0.05
POSES = st.tuples(*(st.floats(*joint.limits_rad) for joint in ARM.joints))


@given(POSES, POSES)
@settings(max_examples=50)
def test_no_approach_is_faster_than_20_degrees_a_second_or_the_tool_limit(
    q0: tuple[float, ...], q1: tuple[float, ...]
) -> None:
    q = np.array(approach_trajectory(q0, q1, ARM, ROBOT, PERIOD_S, "x").positions_rad)
    np.testing.assert_allclose(q[[0, -1]], [q0, q1], atol=1e-12)
    assert np.abs(np.diff(q, axis=0)).max() / PERIOD_S <= math.radians(20.0) * 1.001
    tool = tool_position(ROBOT.chain, q[:, : ROBOT.chain.n])
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / PERIOD_S <= ARM.tool_speed_limit_m_s * 1.001


def test_a_tiny_way_still_takes_its_time_and_no_way_takes_none() -> None:
    q0 = np.zeros(6)
    assert approach_duration_s(q0, q0 + 1e-4, ARM, ROBOT) == pytest.approx(SHORTEST_APPROACH_S)
    assert approach_duration_s(q0, q0, ARM, ROBOT) == 0.0
    assert len(approach_trajectory(tuple(q0), tuple(q0), ARM, ROBOT, PERIOD_S, "x").positions_rad) == 2


def test_the_lowest_point_is_the_lowest_over_the_whole_way() -> None:
    stretched, down = [0.0] * 6, [0.0, -0.15, 0.0, 0.0, 0.0, 0.0]
    way = approach_trajectory(stretched, down, ARM, ROBOT, PERIOD_S, "x")
    assert lowest_link_m(way, ROBOT) == pytest.approx(0.10 - 0.38 * math.sin(0.15), abs=1e-9)
