"""Slow motions keep every limit, no slower than they must; long ones reach the servos in few numbers, or not at all."""

import math
import re
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.control.motion import sample_trajectory
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S, JointTrajectory, most_points
from armctl.trajectory.approach import (
    SHORTEST_APPROACH_S,
    approach_duration_s,
    approach_trajectory,
    lowest_link_m,
)
from armctl.trajectory.interpolate import rest_to_rest
from armctl.trajectory.plan import approached
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.thinning import thinned
from tests.trajectory.conftest import ARM, REST, ROBOT

PERIOD_S = 0.05
ON = DrivenArm(ARM, ROBOT, PERIOD_S)
POSES = st.tuples(*(st.floats(*joint.limits_rad) for joint in ARM.joints))


@given(POSES, POSES)
@settings(max_examples=50)
def test_no_approach_is_faster_than_20_degrees_a_second_or_the_tool_limit(
    q0: tuple[float, ...], q1: tuple[float, ...]
) -> None:
    q = np.array(approach_trajectory(q0, q1, ON, "x").positions_rad)
    np.testing.assert_allclose(q[[0, -1]], [q0, q1], atol=1e-12)
    assert np.abs(np.diff(q, axis=0)).max() / PERIOD_S <= math.radians(20.0) * 1.001
    tool = tool_position(ROBOT.chain, q[:, : ROBOT.chain.n])
    assert np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / PERIOD_S <= ARM.tool_speed_limit_m_s * 1.001


def test_a_tiny_way_still_takes_its_time_and_no_way_takes_none() -> None:
    q0 = np.zeros(6)
    assert approach_duration_s(q0, q0 + 1e-4, ON) == pytest.approx(SHORTEST_APPROACH_S)
    assert approach_duration_s(q0, q0, ON) == 0.0
    assert len(approach_trajectory(tuple(q0), tuple(q0), ON, "x").positions_rad) == 2


def test_the_lowest_point_is_the_lowest_over_the_whole_way() -> None:
    stretched, down = [0.0] * 6, [0.0, -0.15, 0.0, 0.0, 0.0, 0.0]
    way = approach_trajectory(stretched, down, ON, "x")
    assert lowest_link_m(way, ROBOT) == pytest.approx(0.10 - 0.38 * math.sin(0.15), abs=1e-9)


# ------------------------------------------------------------------------- long motions reach the servos in few numbers


def swaying(seed: int, seconds: float, period_s: float, slowest_s: float) -> JointTrajectory:
    """A quick approach, a dwell, and joints that sway at several rhythms, the quickest with the least amplitude."""
    rng = np.random.default_rng(seed)
    rhythms_s = slowest_s / np.arange(1, 4)
    sizes, phases = rng.uniform(0.0, 0.5, (3, 6)) / np.arange(1, 4)[:, None] ** 2, rng.uniform(0.0, 6.0, (3, 6))

    def motion(time_s: FloatArray) -> FloatArray:
        waves = np.sin(np.clip(time_s, 0.0, seconds)[:, None, None] * 2 * math.pi / rhythms_s[:, None] + phases)
        return np.asarray((sizes * waves).sum(axis=1))

    start = motion(np.zeros(1))[0]
    return approached([(start + 0.6, start, 2.0)], motion, seconds, period_s, "sway")


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 99), st.floats(250.0, LONGEST_S - 4.0), st.sampled_from([0.05, 0.1]), st.floats(20.0, 120.0))
def test_a_thinned_motion_keeps_to_its_path_its_times_and_its_speeds(
    seed: int, seconds: float, period_s: float, slowest_s: float
) -> None:
    whole = swaying(seed, seconds, period_s, slowest_s)
    thin = thinned(whole)
    assert len(thin.positions_rad) <= most_points(6) < len(whole.positions_rad)
    assert thin.duration_s == pytest.approx(whole.duration_s, abs=1e-9)
    assert (thin.begin_s, thin.end_s, thin.label) == (whole.begin_s, whole.end_s, whole.label)
    assert (thin.positions_rad[0], thin.positions_rad[-1]) == (whole.positions_rad[0], whole.positions_rad[-1])
    assert all(a < b for a, b in pairwise(thin.times_s))
    at_s = np.random.default_rng(seed).uniform(-1.0, seconds + 6.0, 2000).tolist()
    a, b = (np.array([sample_trajectory(way, time_s) for time_s in at_s]) for way in (thin, whole))
    assert np.abs(a - b).max() < TICK_RAD / 2.0
    steps = np.abs(np.diff(thin.positions_rad, axis=0)) / np.diff(thin.times_s)[:, None]
    assert (steps.max(axis=0) <= np.abs(np.diff(whole.positions_rad, axis=0)).max(axis=0) / period_s * 1.000001).all()


@pytest.mark.parametrize("period_s", [0.01, 0.1, 1.0])
def test_the_longest_slow_way_passes_at_every_period(period_s: float) -> None:
    there = [REST[0] + 1.0, *REST[1:]]
    way = thinned(approach_trajectory(REST, there, DrivenArm(ARM, ROBOT, period_s), "move", LONGEST_S))
    assert len(way.positions_rad) <= most_points(6)
    assert way.duration_s == pytest.approx(LONGEST_S)


def test_a_short_motion_stays_as_it_is() -> None:
    way = approach_trajectory(REST, [0.0] * 6, DrivenArm(ARM, ROBOT, 0.1), "move", 100.0)
    assert thinned(way) is way


def test_a_motion_too_winding_for_its_length_is_refused_with_figures_and_a_remedy() -> None:
    rows = rest_to_rest(np.zeros(6), np.full(6, 0.5), np.random.default_rng(0).uniform(0.0, 1.0, 6000))
    way = JointTrajectory(0.1, tuple(map(tuple, rows.tolist())))
    found = rf"599.9 s winds so much that it needs \d{{4}} points, at most {most_points(6)} reach.*; make it shorter"
    with pytest.raises(RequestRefused, match=found) as refusal:
        thinned(way)
    assert refusal.value.code == "LIMIT"
    assert re.search(r"or split it", str(refusal.value))
