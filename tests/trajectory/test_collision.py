"""Distances of segments and capsules against dense sampling, symmetry and MuJoCo."""

import math

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.spherical_wrist import poses_along
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.collision import floor_clearance, judged_pairs, link_clearance, link_points, segment_distance
from tests.trajectory.conftest import ARM, CHAIN, LIMITS, REST

RADIUS_M = ARM.link_radius_m
Ends = tuple[FloatArray, FloatArray, FloatArray, FloatArray]
NUMBERS = st.floats(-1.0, 1.0).map(lambda x: round(x, 3))
SEGMENTS = st.tuples(*[st.tuples(NUMBERS, NUMBERS, NUMBERS).map(np.array)] * 4)


@given(SEGMENTS)
@settings(max_examples=200)
def test_no_sampled_distance_is_less_and_the_least_of_them_is_near(ends: Ends) -> None:
    a0, a1, b0, b1 = ends
    distance = float(segment_distance(a0, a1, b0, b1))
    share = np.linspace(0.0, 1.0, 201)[:, None]
    a, b = a0 + share * (a1 - a0), b0 + share * (b1 - b0)
    sampled = float(np.linalg.norm(a[:, None] - b[None], axis=2).min())
    spacing = (np.linalg.norm(a1 - a0) + np.linalg.norm(b1 - b0)) / 200.0
    assert distance <= sampled + 1e-12
    assert sampled <= distance + spacing


@given(SEGMENTS)
def test_neither_order_nor_direction_matters(ends: Ends) -> None:
    a0, a1, b0, b1 = ends
    distance = segment_distance(a0, a1, b0, b1)
    for other in ((a1, a0, b0, b1), (a0, a1, b1, b0), (b0, b1, a0, a1)):
        assert segment_distance(*other) == pytest.approx(distance, abs=1e-9)


@pytest.mark.parametrize(
    ("ends", "distance"),
    [
        (((0, 0, 0), (1, 0, 0), (0.5, -1, 0.2), (0.5, 1, 0.2)), 0.2),
        (((0, 0, 0), (1, 0, 0), (0, 0.3, 0), (1, 0.3, 0)), 0.3),
        (((0, 0, 0), (1, 0, 0), (1.3, 0.4, 0), (2, 0.4, 0)), 0.5),
        (((0, 0, 0), (1, 0, 0), (1, 0, 0), (1, 1, 0)), 0.0),
        (((0, 0, 0), (1, 0, 0), (0.2, 0, 0), (0.7, 0, 0)), 0.0),
        (((0, 0, 0), (0, 0, 0), (0, 3, 4), (0, 3, 4)), 5.0),
        (((0, 0, 0), (0, 0, 0), (-1, 2, 0), (1, 2, 0)), 2.0),
    ],
)
def test_crossed_parallel_touching_and_pointlike_segments(ends: tuple[tuple[float, ...], ...], distance: float) -> None:
    assert segment_distance(*np.array(ends, dtype=np.float64)) == pytest.approx(distance, abs=1e-12)


def test_mujoco_finds_the_same_gaps_between_the_links_of_random_poses() -> None:
    points = link_points(CHAIN, np.random.default_rng(4).uniform(LIMITS[:, 0], LIMITS[:, 1], (200, CHAIN.n)))
    pairs = judged_pairs(points[0], RADIUS_M)
    ours = link_clearance(points, pairs, RADIUS_M)
    lengths = np.linalg.norm(np.diff(points[0], axis=0), axis=1)
    geoms = "".join(f'<geom type="capsule" size="{RADIUS_M} {length / 2.0}"/>' for length in lengths)
    model = mujoco.MjModel.from_xml_string(f"<mujoco><worldbody>{geoms}</worldbody></mujoco>")
    data = mujoco.MjData(model)
    seen = 0
    for pose, gaps in zip(points, ours, strict=True):
        data.geom_xpos[:] = (pose[1:] + pose[:-1]) / 2.0
        along = poses_along(np.zeros(3), np.diff(pose, axis=0) / lengths[:, None])
        data.geom_xmat[:] = along[:, :3, :3].reshape(-1, 9)
        for (first, second), gap in zip(pairs, gaps, strict=True):
            theirs = mujoco.mj_geomDistance(model, data, int(first), int(second), 10.0, None)
            if gap > 0.0:  # of overlapping bodies MuJoCo tells the depth, which is another question
                assert theirs == pytest.approx(gap, abs=1e-5)
                seen += 1
            else:
                assert theirs < 1e-5
    assert 500 < seen < ours.size


def test_every_pair_but_neighbours_is_judged_on_the_shipped_arm() -> None:
    pairs = judged_pairs(link_points(CHAIN, np.zeros(CHAIN.n)), RADIUS_M)
    assert [tuple(pair) for pair in pairs] == [(0, 2), (0, 3), (0, 4), (1, 3), (1, 4), (2, 4)]


def test_links_that_nothing_can_hold_apart_are_not_judged() -> None:
    wrist = SerialChain((DHRow(a=0.2), DHRow(alpha=math.pi / 2.0), DHRow(a=0.04), DHRow(a=0.2)))
    points = link_points(wrist, np.zeros(4))
    assert judged_pairs(points, 0.025).tolist() == []
    assert judged_pairs(points, 0.015).tolist() == [[0, 3], [1, 3]]
    assert link_clearance(points, judged_pairs(points, 0.025), 0.025).shape == (0,)


def test_the_rest_pose_is_free_and_a_fold_onto_the_base_column_is_not() -> None:
    rest, folded = link_points(CHAIN, np.stack([REST[: CHAIN.n], np.radians([0.0, 100.0, -145.0, -110.0, 0.0])]))
    pairs = judged_pairs(rest, RADIUS_M)
    assert link_clearance(rest, pairs, RADIUS_M).min() > 0.01
    assert link_clearance(folded, pairs, RADIUS_M).min() < 0.0


@given(st.tuples(*(st.floats(low, high) for low, high in LIMITS.tolist())), st.floats(-3.0, 3.0))
def test_turning_the_base_changes_no_gap_and_no_height(pose: tuple[float, ...], base_rad: float) -> None:
    here = link_points(CHAIN, np.array(pose))
    turned = link_points(CHAIN, np.array([base_rad, *pose[1:]]))
    pairs = judged_pairs(here, RADIUS_M)
    gaps, same = (link_clearance(points, pairs, RADIUS_M) for points in (here, turned))
    np.testing.assert_allclose(same, gaps, atol=1e-9)
    np.testing.assert_allclose(floor_clearance(turned, 0.0, RADIUS_M), floor_clearance(here, 0.0, RADIUS_M), atol=1e-9)


def test_links_are_thick_above_the_floor_and_the_tool_is_a_point() -> None:
    stretched = link_points(CHAIN, np.zeros((1, CHAIN.n)))
    np.testing.assert_allclose(floor_clearance(stretched, 0.02, RADIUS_M), [[0.055, 0.055, 0.055, 0.08]], atol=1e-12)
