"""The judge's own geometry, against what is known of lines and arms."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import ArmSpec
from proving.arms import arm_text
from proving.reading import TICK_DEG, read
from proving.truth import (
    AROUND_RAD,
    CLASSES,
    LENGTHS_M,
    STATIONS,
    FloatArray,
    Reach,
    covered,
    off_chord_mm,
    off_line_mm,
    within,
)

place = st.tuples(*[st.floats(-0.3, 0.3)] * 3).map(np.array)
# With every link of another length than its file says.
CRUDE = ArmSpec(length_error_m=0.003)


def reach() -> tuple[Reach, SimulatedArm]:
    arm = SimulatedArm(load_arm("ax12-line"), seed=5, spec=CRUDE)
    return Reach(read(arm_text("ax12-line")), arm.chain), arm


@given(A=place, way=place.filter(lambda way: np.linalg.norm(way) > 0.05), t=st.floats(-2.0, 2.0), off=place)
def test_the_distance_from_a_line_is_that_from_its_nearest_point(
    A: FloatArray, way: FloatArray, t: float, off: FloatArray
) -> None:
    across = off - (off @ way) / (way @ way) * way
    [found] = off_line_mm((A + t * way + across)[None], A, A + way)
    assert found == pytest.approx(1e3 * float(np.linalg.norm(across)), abs=1e-6)


@given(A=place, way=place.filter(lambda way: np.linalg.norm(way) > 0.05), off=place, bow=st.floats(0.0, 0.02))
def test_a_path_that_is_straight_but_elsewhere_lies_on_its_own_chord(
    A: FloatArray, way: FloatArray, off: FloatArray, bow: float
) -> None:
    t = np.linspace(0.0, 1.0, 50)[:, None]
    straight = A + off + t * way
    assert off_chord_mm(straight).max() < 1e-6
    side = np.cross(way, np.roll(way, 1) + np.array([0.0, 0.0, 1.0]))
    bent = straight + bow * np.sin(math.pi * t) * side / max(float(np.linalg.norm(side)), 1e-9)
    assert np.square(off_chord_mm(bent)).sum() <= np.square(off_line_mm(bent, A + off, A + off + way)).sum() + 1e-6


def test_a_path_that_stops_halfway_covers_half() -> None:
    A, B = np.zeros(3), np.array([0.0, 0.2, 0.0])
    assert covered(np.array([A, 0.1 * B, 0.5 * B]), A, B) == pytest.approx(0.5)


@given(values=st.lists(st.floats(0.0, 9.0), min_size=1, max_size=50), share=st.floats(0.0, 1.0))
def test_at_least_a_share_is_within_and_less_within_anything_smaller(values: list[float], share: float) -> None:
    bound = within(values, share)
    assert bound in values
    assert sum(value <= bound for value in values) >= share * len(values) - 1e-6
    assert sum(value < bound for value in values) < max(1.0, share * len(values))


@given(q=st.tuples(*[st.floats(-1.5, 1.5)] * 6).map(np.array))
@settings(max_examples=25)
def test_tools_are_where_the_simulator_has_them_whatever_the_lengths_of_its_links(q: FloatArray) -> None:
    ours, arm = reach()
    np.testing.assert_allclose(ours.tool_m(q[None])[0], arm.tool_positions(q), atol=1e-12)


@pytest.mark.parametrize("kind", CLASSES)
def test_lines_are_of_their_class_and_some_way_of_the_joints_is_on_them(kind: str) -> None:
    ours, _ = reach()
    rng = np.random.default_rng(3)
    for _ in range(3):
        drawn = ours.line(kind, rng)
        A, B = drawn.A, drawn.B
        assert LENGTHS_M[0] <= np.linalg.norm(B - A) <= LENGTHS_M[1]
        middle, way = (A + B) / 2.0, (B - A) / np.linalg.norm(B - A)
        out = np.array([middle[0], middle[1], 0.0]) / math.hypot(middle[0], middle[1])
        parts = np.abs([way @ out, way @ np.array([-out[1], out[0], 0.0]), way[2]])
        np.testing.assert_array_equal(
            parts > 1e-9,
            {
                "turning": (False, True, False),
                "radial": (True, False, False),
                "vertical": (False, False, True),
                "slanted": (True, False, True),
                "diagonal": (True, True, True),
            }[kind],
        )
        assert len(drawn.way_rad) == STATIONS
        on_line = A + np.linspace(0.0, 1.0, STATIONS)[:, None] * (B - A)
        np.testing.assert_allclose(ours.tool_m(drawn.way_rad), on_line, atol=1e-4)
        assert np.abs(np.arctan2(on_line[:, 1], on_line[:, 0])).max() < AROUND_RAD


def test_a_line_that_is_longer_than_the_arm_reaches_is_drawn_again() -> None:
    ours, _ = reach()
    rng = np.random.default_rng(4)
    assert sum(ours.line("radial", rng).beyond for _ in range(4)) > 4


def test_what_no_encoder_shows_is_the_lever_times_the_offset() -> None:
    ours, _ = reach()
    way = np.tile(np.radians([0.0, 90.0, -90.0, 0.0, 0.0]), (3, 1))
    tool = ours.tool_m(way)[0]
    # Along the vertical through the tool: across it, base and pitch joints move it by its radius and their heights.
    found = ours.unseen_mm(way, tool, tool + np.array([0.0, 0.0, 0.1]))
    ends = ours._motions.points(way)[0]
    levers = [tool[0], *(tool[2] - end[2] for end in ends[1:-1])]
    half_tick = math.radians(TICK_DEG) / math.sqrt(12.0)
    assert found == pytest.approx(1e3 * half_tick * math.hypot(*levers), rel=1e-6)
