"""The swept annulus: in it or how far from it."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.kinematics.annulus import PlaneReach, annulus
from armctl.kinematics.transform import FloatArray

offset = st.floats(-0.3, 0.3)
reaches = st.builds(
    PlaneReach, st.lists(st.floats(0.05, 0.6), min_size=2, max_size=4).map(tuple), offset, offset, offset
)
coordinate = st.floats(-2.0, 2.0)
points = st.tuples(coordinate, coordinate, coordinate).map(np.array)


def sweep(reach: PlaneReach, u: FloatArray, v: FloatArray, turn: FloatArray) -> FloatArray:
    c, s = np.cos(turn), np.sin(turn)
    out = u + reach.a1
    return np.stack((out * c + reach.offset * s, out * s - reach.offset * c, v + reach.height), axis=-1)


@given(reaches, points, st.integers(0, 2**32 - 1))
def test_no_point_of_the_workspace_is_nearer_than_the_nearest(reach: PlaneReach, point: FloatArray, seed: int) -> None:
    near, distance = reach.nearest(point)
    assert np.linalg.norm(near - point) == pytest.approx(distance, abs=1e-12)
    rng = np.random.default_rng(seed)
    low, high = annulus(reach.links_m)
    radius, angle = rng.uniform(low, high, 3000), rng.uniform(-np.pi, np.pi, 3000)
    places = sweep(reach, radius * np.cos(angle), radius * np.sin(angle), rng.uniform(-np.pi, np.pi, 3000))
    assert np.linalg.norm(places - point, axis=1).min() >= distance - 1e-9
    # The nearest point itself is in it: at distance 0 from it.
    again, rest = reach.nearest(near)
    assert rest < 1e-9
    np.testing.assert_allclose(again, near, atol=1e-9)


@given(reaches, st.integers(0, 2**32 - 1))
def test_every_place_of_the_links_is_in_reach(reach: PlaneReach, seed: int) -> None:
    rng = np.random.default_rng(seed)
    angles = np.cumsum(rng.uniform(-np.pi, np.pi, len(reach.links_m)))
    u = float((np.array(reach.links_m) * np.cos(angles)).sum())
    v = float((np.array(reach.links_m) * np.sin(angles)).sum())
    assert reach.nearest(sweep(reach, np.array(u), np.array(v), np.array(rng.uniform(-3.0, 3.0))))[1] == 0.0


def test_known_distances() -> None:
    arm = PlaneReach((0.3, 0.1), 0.0, 0.0, 0.5)
    assert arm.nearest(np.array([1.0, 0.0, 0.5]))[1] == pytest.approx(0.6, abs=1e-15)
    assert arm.nearest(np.array([0.0, 0.0, 0.5]))[1] == pytest.approx(0.2, abs=1e-15)
    beside = PlaneReach((0.3, 0.1), 0.0, 0.05, 0.0)
    near, distance = beside.nearest(np.array([0.02, 0.0, 0.3]))
    assert distance == pytest.approx(0.03, abs=1e-15)
    np.testing.assert_allclose(near, [0.05, 0.0, 0.3], atol=1e-15)
    np.testing.assert_allclose(annulus((0.3, 0.1)), [0.2, 0.4], atol=1e-15)
    np.testing.assert_allclose(annulus((0.2, 0.2, 0.1)), [0.0, 0.5], atol=1e-15)
    assert math.isfinite(beside.nearest(np.zeros(3))[1])
