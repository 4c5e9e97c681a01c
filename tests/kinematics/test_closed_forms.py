"""What every closed form holds: waist and parallel pitch joints, or a spherical wrist, of any lengths."""

import math

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, jacobian, tool_position
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.spherical_wrist import SphericalWrist
from armctl.kinematics.transform import finite, pose_from_xyz_rpy
from tests.kinematics.conftest import assert_at, seeds, some_q, turned

QUARTER = math.pi / 2.0
link, offset, length = st.floats(0.05, 0.4), st.floats(-0.1, 0.1), st.floats(-0.2, 0.2)
links = st.lists(link, min_size=3, max_size=4).map(tuple)
ends_in_x = st.builds(PlanarArm, links, height=offset, a1=offset, shoulder=offset)
rolling = st.builds(PlanarArm, st.tuples(link, link, link), height=offset, a1=st.just(0.0), roll=st.just(True))
planar = st.one_of(ends_in_x, rolling)
wrists = st.builds(  # a1, a2, a3, shoulder, d4, d6
    SphericalWrist, length, st.floats(0.2, 0.6), length, length, st.floats(0.2, 0.5), length
)
forms = st.one_of(ends_in_x, rolling, wrists)


def chain_of(form: PlanarArm | SphericalWrist) -> SerialChain:
    if isinstance(form, PlanarArm):
        first, *others = form.links_m
        rows = [DHRow(a=form.a1, alpha=QUARTER, d=form.height), DHRow(a=first, d=form.shoulder)]
        rows += [DHRow(a=length) for length in others]
        if form.roll:
            rows[-1:] = [DHRow(alpha=-QUARTER), DHRow(d=others[-1])]
        return SerialChain(tuple(rows))
    a, d = (form.a1, form.a2, form.a3, 0.0, 0.0, 0.0), (0.0, form.shoulder, 0.0, form.d4, 0.0, form.d6)
    alpha = (QUARTER, 0.0, -QUARTER, QUARTER, -QUARTER, 0.0)
    return SerialChain(tuple(map(DHRow, a, alpha, d)))


@given(forms, seeds)
@settings(max_examples=200)
def test_every_branch_reaches_the_pose_and_one_is_where_it_came_from(
    form: PlanarArm | SphericalWrist, seed: int
) -> None:
    chain = chain_of(form)
    q = some_q(chain, seed, 10)
    for q_i, T in zip(q, forward_kinematics(chain, q), strict=True):
        if isinstance(form, SphericalWrist):
            found, expected = form.poses(T[None]), (4, 8)  # the waist turned round may not reach
        else:
            # Four links leave the last joint's bend free: ask for the one it had.
            found = form.poses(T[None], float(q_i[4]) if len(form.links_m) == 4 else 0.0)
            expected = (4, 4) if form.roll else (2, 2)
        found = finite(found)
        assert len(found) in expected
        assert_at(chain, found, T)
        assert turned(found, q_i).min() < 1e-4


@given(ends_in_x, seeds)
def test_any_bend_asked_for_keeps_the_pose(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    T = forward_kinematics(chain, some_q(chain, seed))
    families = arm.pose_families(T)
    assert families.shape[:2] == (2, 61 if len(arm.links_m) == 4 else 1)
    found = finite(families)
    assert len(found) == families.shape[0] * families.shape[1]
    assert_at(chain, found, T)


@given(planar, seeds)
@settings(max_examples=30)
def test_positions_hold_the_point_for_every_pitch_and_bend(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    points = tool_position(chain, some_q(chain, seed, 2))
    for point, found in zip(points, arm.positions(points), strict=True):
        assert found.shape[0] == 4
        found = finite(found)
        assert len(found) > 0
        np.testing.assert_allclose(tool_position(chain, found), np.broadcast_to(point, (len(found), 3)), atol=1e-9)


@given(planar, seeds)
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


@given(forms, seeds)
def test_plain_floats_and_arrays_give_the_same_solutions_in_the_same_order(
    form: PlanarArm | SphericalWrist, seed: int
) -> None:
    chain = chain_of(form)
    T = forward_kinematics(chain, some_q(chain, seed, 10))
    for T_i, found in zip(T, form.poses(T), strict=True):
        alone = np.array(form.pose(T_i.tolist())).reshape(-1, chain.n)
        if chain.n == 5 and not getattr(form, "roll", False):
            assert len(alone) == 0, "four links are a family"
        elif len(alone) or np.linalg.svd(jacobian(chain, finite(found)), compute_uv=False)[:, -1].min() > 1e-3:
            assert alone.shape == finite(found).shape
            assert turned(alone, finite(found)).max() < 1e-6


@given(planar, seeds)
def test_a_pose_that_a_planar_arm_cannot_take_has_no_solution_in_plain_floats(arm: PlanarArm, seed: int) -> None:
    chain = chain_of(arm)
    T = forward_kinematics(chain, some_q(chain, seed))
    tilted = T @ pose_from_xyz_rpy(0.0, 0.0, 0.0, 0.0, 1e-3, 0.0)
    beside = T.copy()
    across = np.cross(T[:3, 2], [0.0, 0.0, 1.0]) if arm.roll else T[:3, 2]
    assume(np.linalg.norm(across) > 0.01)  # a hand straight up or down leaves the waist free
    beside[:3, 3] += 1e-6 * across / np.linalg.norm(across)
    assert arm.pose(beside.tolist()) == []
    if not arm.roll:
        assert arm.pose(tilted.tolist()) == []


@given(wrists, st.integers(0, 2), seeds)
def test_at_singular_poses_the_tool_is_exact_all_the_same(arm: SphericalWrist, kind: int, seed: int) -> None:
    chain = chain_of(arm)
    q = some_q(chain, seed)
    stretched = -math.atan2(arm.d4, arm.a3)
    joint, q_rad = ((4, 0.0), (2, stretched), (4, 1e-11))[kind]  # the wrist straight, the elbow, the wrist nearly
    q[joint] = q_rad
    T = forward_kinematics(chain, q)
    assert arm.pose(T.tolist()) == [], "branches meet there, or are families"
    found = finite(arm.poses(T[None]))
    errors = np.abs(forward_kinematics(chain, found) - T).max(axis=(-1, -2))
    assert len(found) >= 4
    assert errors.max() < 1e-7
    assert errors.min() < 1e-11


def test_out_of_reach_there_is_no_solution_but_a_nearest_pose() -> None:
    arm = SphericalWrist(0.1, 0.4, 0.0, 0.05, 0.3, 0.1)
    T = np.eye(4)
    T[:3, 3] = [2.0, 0.3, 0.4]
    assert arm.pose(T.tolist()) == []
    for form in (arm, PlanarArm((0.1, 0.1, 0.1))):
        assert np.isnan(form.poses(T[None])).all()
    (q_pose, distance), (q_point, nearer) = arm.nearest_pose(T), arm.nearest_position(T[:3, 3])
    assert nearer < distance
    np.testing.assert_allclose(forward_kinematics(chain_of(arm), q_pose[0])[:3, :3], np.eye(3), atol=1e-12)
    for q, away in ((q_pose, distance), (q_point, nearer)):
        assert np.linalg.norm(tool_position(chain_of(arm), q[0]) - T[:3, 3]) == pytest.approx(away, abs=1e-12)


@pytest.mark.parametrize("d6", [0.1, -0.1])
def test_positions_hold_the_point_in_many_directions(d6: float) -> None:
    arm = SphericalWrist(0.1, 0.4, 0.02, 0.05, 0.3, d6)
    points = np.array([[0.3, 0.2, 0.25], [0.4, -0.1, 0.1]])
    q = arm.positions(points)
    assert q.shape[:2] == (2, 8)
    for point, found in zip(points, q, strict=True):
        T = forward_kinematics(chain_of(arm), finite(found))
        assert len(T) > 100
        np.testing.assert_allclose(T[:, :3, 3], np.broadcast_to(point, (len(T), 3)), atol=1e-12)


def test_an_arm_without_links_is_refused() -> None:
    with pytest.raises(ConfigError, match="must be above 0 m"):
        SphericalWrist(0.1, 0.0, 0.1, 0.0, 0.3, 0.0)
    with pytest.raises(ConfigError, match="longer than 0 m"):
        PlanarArm((0.1, 0.0, 0.2))
