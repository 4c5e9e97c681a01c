"""Closed form of a waist and parallel pitch joints."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, tool_position
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.transform import finite
from tests.kinematics.conftest import assert_at, turned

seeds = st.integers(0, 2**32 - 1)
link = st.floats(0.05, 0.4)
offset = st.floats(-0.1, 0.1)
ends_in_x = st.builds(
    PlanarArm,
    st.lists(link, min_size=3, max_size=4).map(tuple),
    height=offset,
    a1=offset,
    shoulder=offset,
    up=st.sampled_from([1.0, -1.0]),
)
rolling = st.builds(PlanarArm, st.tuples(link, link, link), height=offset, a1=st.just(0.0), roll=st.just(True))


def chain_of(arm: PlanarArm) -> SerialChain:
    base = DHRow(a=arm.a1, alpha=arm.up * math.pi / 2.0, d=arm.height)
    first, *others = arm.links_m
    rows = [base, DHRow(a=first, d=arm.shoulder), *(DHRow(a=length) for length in others)]
    if arm.roll:
        rows[-1] = DHRow(alpha=-math.pi / 2.0)
        rows.append(DHRow(d=others[-1]))
    return SerialChain(tuple(rows))


@given(st.one_of(ends_in_x, rolling), seeds)
def test_every_branch_reaches_the_pose_and_one_is_where_it_came_from(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    for q in np.random.default_rng(seed).uniform(-np.pi, np.pi, (5, chain.n)):
        T = forward_kinematics(chain, q)
        # Four links leave the last joint's bend free: ask for the one it had.
        found = finite(arm.poses(T[None], float(q[4]) if len(arm.links_m) == 4 else 0.0))
        assert len(found) == (4 if arm.roll else 2)
        assert_at(chain, found, T)
        assert turned(found, q).min() < 1e-4


@given(ends_in_x, seeds)
def test_any_bend_asked_for_keeps_the_pose(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, chain.n)
    T = forward_kinematics(chain, q)
    families = arm.pose_families(T)
    assert len(families) == 2
    assert families.shape[1] == (61 if len(arm.links_m) == 4 else 1)
    found = finite(families)
    assert len(found) == families.shape[0] * families.shape[1]
    assert_at(chain, found, T)


@given(st.one_of(ends_in_x, rolling), seeds)
@settings(max_examples=30)
def test_positions_hold_the_point_for_every_pitch_and_bend(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (2, chain.n))
    points = tool_position(chain, q)
    for point, found in zip(points, arm.positions(points), strict=True):
        assert found.shape[0] == 4
        found = finite(found)
        assert len(found) > 0
        np.testing.assert_allclose(tool_position(chain, found), np.broadcast_to(point, (len(found), 3)), atol=1e-9)


@given(st.one_of(ends_in_x, rolling), seeds)
@settings(max_examples=50)
def test_the_nearest_configuration_is_at_the_least_distance_and_no_sample_is_nearer(arm: PlanarArm, seed: int) -> None:
    chain, rng = chain_of(arm), np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, 3] = rng.uniform(-1.0, 1.0, 3) * 3.0
    q, distance = arm.nearest_pose(T)
    gaps = np.linalg.norm(tool_position(chain, q) - T[:3, 3], axis=1)
    np.testing.assert_allclose(gaps, distance, atol=1e-7)
    samples = tool_position(chain, rng.uniform(-np.pi, np.pi, (2000, chain.n)))
    assert np.linalg.norm(samples - T[:3, 3], axis=1).min() >= distance - 1e-12


def test_a_pose_too_far_has_no_branch() -> None:
    T = np.eye(4)
    T[0, 3] = 5.0
    assert np.isnan(PlanarArm((0.1, 0.1, 0.1)).poses(T[None])).all()


def test_a_link_without_length_is_refused() -> None:
    with pytest.raises(ConfigError, match="longer than 0 m"):
        PlanarArm((0.1, 0.0, 0.2))
