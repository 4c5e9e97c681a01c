"""An arm whose geometry is not what its file says: what the encoders show is as before, where the tool is is not."""

import math
from dataclasses import fields, replace
from itertools import pairwise

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.sim.arm import SimulatedArm
from armctl.sim.geometry import PERFECT, Deviation, Geometry
from armctl.sim.spec import DEFAULT_SPEC, GEOMETRIES, RANDOM_SPEC, ArmSpec
from tests.sim.conftest import WORKING_RAD, Bench, turned

SEEDS = range(5)
EXACT = ArmSpec(noise_tick=0.0, zero_offset_tick=0.0)
angles = st.floats(-5.0, 10.0)


def with_geometry(spec: ArmSpec, geometry: Geometry) -> ArmSpec:
    return replace(spec, geometry=geometry)


def test_perfect_is_the_default_and_no_error_at_all() -> None:
    assert DEFAULT_SPEC.geometry == RANDOM_SPEC.geometry == GEOMETRIES["perfect"] == PERFECT
    assert not any(getattr(PERFECT, one.name) for one in fields(Geometry))


def test_levels_are_ordered_in_every_kind_of_error() -> None:
    for milder, worse in pairwise(GEOMETRIES.values()):
        assert all(getattr(milder, one.name) < getattr(worse, one.name) for one in fields(Geometry))


@pytest.mark.parametrize("spec", [DEFAULT_SPEC, RANDOM_SPEC])
@pytest.mark.parametrize("level", ["careful", "poor"])
def test_a_seed_draws_the_same_servos_and_masses_at_every_level(arm: ArmConfig, spec: ArmSpec, level: str) -> None:
    for seed in SEEDS:
        perfect = SimulatedArm(arm, seed=seed, spec=spec)
        other = SimulatedArm(arm, seed=seed, spec=with_geometry(spec, GEOMETRIES[level]))
        assert other.points_kg == perfect.points_kg
        for one, same in zip(other._joints, perfect._joints, strict=True):
            assert (one.stall_Nm, one.coulomb_Nm, one.half_play_rad) == (
                same.stall_Nm,
                same.coulomb_Nm,
                same.half_play_rad,
            )
            assert one.servo.table == same.servo.table
            assert one.servo.shaft_rad == same.servo.shaft_rad


def test_one_kind_of_error_leaves_what_is_drawn_of_the_others(arm: ArmConfig) -> None:
    both = Geometry(zero_deg=1.0, twist_deg=1.0, length_m=0.001)
    whole = SimulatedArm(arm, seed=3, spec=with_geometry(EXACT, both))
    for kind in ("twist_deg", "length_m"):
        less = SimulatedArm(arm, seed=3, spec=with_geometry(EXACT, replace(both, **{kind: 0.0})))
        zeros = [[joint.zero_rad for joint in one._joints] for one in (whole, less)]
        assert zeros[0] == zeros[1]
        kept = "a" if kind == "twist_deg" else "alpha"
        assert [getattr(row, kept) for row in whole.chain.rows] == [getattr(row, kept) for row in less.chain.rows]


def test_errors_have_the_sizes_of_their_level(arm: ArmConfig) -> None:
    size, nominal = GEOMETRIES["typical"], robots.get(arm.robot, arm.lengths_m).chain
    drawn = [SimulatedArm(arm, seed=seed, spec=with_geometry(EXACT, size)) for seed in range(100)]
    exact = [joint.zero_tick * ax12a.TICK_RAD for joint in arm.joints]
    zeros = np.degrees([[j.zero_rad - zero for j, zero in zip(one._joints, exact, strict=True)] for one in drawn])
    assert np.abs(zeros).max() <= size.zero_deg
    assert zeros.std() == pytest.approx(size.zero_deg / math.sqrt(3.0), rel=0.1)
    rows = [list(zip(one.chain.rows, nominal.rows, strict=True)) for one in drawn]
    twists = np.degrees([[true.alpha - row.alpha for true, row in pairs] for pairs in rows])
    assert twists.std() == pytest.approx(size.twist_deg, rel=0.1)
    lengths = np.array([[true.a - row.a for true, row in pairs if row.a] for pairs in rows])
    assert lengths.std() == pytest.approx(size.length_m, rel=0.15)


@given(shaft_rad=angles, phases=st.tuples(angles, angles), amplitude_rad=st.floats(0.0, 0.02))
def test_a_nonlinear_track_is_never_off_by_more_than_its_size(
    shaft_rad: float, phases: tuple[float, float], amplitude_rad: float
) -> None:
    assert abs(Deviation(amplitude_rad, phases, 0.0, 0.0, 0.01).at(shaft_rad)) <= amplitude_rad


@given(
    half_rad=st.floats(0.0, 0.01),
    story=st.lists(st.tuples(angles, st.sampled_from([-1.0, -0.02, -0.005, 0.0, 0.005, 0.02, 1.0])), max_size=30),
)
def test_a_link_stays_within_the_play_of_its_horn_and_a_load_has_it_on_its_flank(
    half_rad: float, story: list[tuple[float, float]]
) -> None:
    horn = Deviation(0.0, (0.0, 0.0), 0.0, half_rad, 0.01)
    link_rad = None
    for shaft_rad, load_Nm in story:
        horn.settle(shaft_rad, load_Nm)
        off_rad = horn.at(shaft_rad)
        assert abs(off_rad) <= half_rad
        if abs(load_Nm) > 0.01:
            assert off_rad == math.copysign(half_rad, load_Nm)
        elif link_rad is not None and abs(link_rad - shaft_rad) < half_rad:
            assert shaft_rad + off_rad == pytest.approx(link_rad, abs=1e-12)  # it stays where it was
        link_rad = shaft_rad + off_rad


def test_a_link_bends_behind_its_sensor_in_proportion_to_its_load() -> None:
    bent = Deviation(0.0, (0.0, 0.0), math.radians(0.3), 0.0, 0.01)
    for load_Nm in (0.0, 0.5, -1.0):
        bent.settle(2.0, load_Nm)
        assert bent.at(2.0) == pytest.approx(math.radians(0.3) * load_Nm)


@pytest.mark.parametrize(
    ("geometry", "least_mm", "most_mm"),
    [
        (PERFECT, 0.0, 1e-9),
        (Geometry(zero_deg=1.0), 0.5, 12.0),
        (Geometry(length_m=0.001), 0.2, 6.0),
        (Geometry(twist_deg=1.0), 0.5, 12.0),
        (Geometry(nonlinearity_deg=1.0), 0.5, 12.0),
        (Geometry(flex_deg_Nm=1.0), 0.5, 8.0),
        (Geometry(horn_play_deg=0.5), 0.5, 6.0),
    ],
)
def test_each_kind_moves_the_true_tool_and_the_sensors_do_not_see_it(
    arm: ArmConfig, geometry: Geometry, least_mm: float, most_mm: float
) -> None:
    chain = robots.get(arm.robot, arm.lengths_m).chain
    for seed in (0, 3):
        bench = Bench(arm, seed=seed, spec=with_geometry(EXACT, geometry))
        bench.hold()
        seen = [
            joint.direction * (servo.shaft_rad - joint.zero_tick * ax12a.TICK_RAD)
            for joint, servo in zip(arm.joints, bench.arm.servos, strict=True)
        ]
        off_m = bench.arm.true_tool_position() - tool_position(chain, np.array(seen[: chain.n]))
        assert least_mm <= float(np.linalg.norm(off_m)) * 1e3 <= most_mm


@settings(max_examples=10)
@given(shares=st.lists(st.floats(1e-6, 1.0), max_size=6), guided=st.booleans())
def test_a_poor_arm_does_not_depend_on_how_time_is_cut(arm: ArmConfig, shares: list[float], guided: bool) -> None:
    spec = with_geometry(DEFAULT_SPEC, GEOMETRIES["poor"])
    in_pieces, at_once = (Bench(arm, seed=3, spec=spec) for _ in range(2))
    for bench in (in_pieces, at_once):
        bench.goto(WORKING_RAD, 100, 1.0)
        bench.goto(turned(0.5), 100)
        if guided:
            bench.arm.hand.guide(np.array([0.2, 0.0, 0.1]), np.array([0.2, 0.1, 0.1]), seed=1)
    for share in shares:
        in_pieces.wait(share * 0.5)
        in_pieces.arm.true_positions()  # looking changes nothing
    at_once.wait((in_pieces.now_ns - at_once.now_ns) / 1e9)
    assert in_pieces.arm.true_positions().tolist() == at_once.arm.true_positions().tolist()
