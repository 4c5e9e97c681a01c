"""Paths of the tool as people give them: lines, arcs, rounded corners, and what is no path."""

import json
import math
import re
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.cli.help import DOCS
from armctl.config import validate
from armctl.errors import ConfigError
from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.tool_path import MAX_POINTS, MOST_SHIFTS, Kind, Learnt, Outline, PathRequest, path_from_text

SEEDS = st.integers(0, 2**32 - 1)
TOLERANCES_MM = st.floats(0.1, 20.0)


def drawn(seed: int, tolerance_mm: float = 2.0, *, arcs: bool = True) -> PathRequest:
    """Points at random, some joined by arcs."""
    rng = np.random.default_rng(seed)
    kinds: list[Kind] = ["line"]
    while len(kinds) < 8:
        kinds += ["through", "arc"] if arcs and rng.random() < 0.4 else ["line"]
    points = rng.uniform(-0.2, 0.2, (len(kinds), 3))
    return PathRequest(points_m=tuple(map(tuple, points.tolist())), kinds=tuple(kinds), tolerance_mm=tolerance_mm)


def ways(outline: Outline, count: int = 801) -> FloatArray:
    return np.linspace(0.0, outline.length_m, count)


@given(SEEDS, TOLERANCES_MM)
def test_rounding_stays_within_the_tolerance_and_is_exact_away_from_corners(seed: int, tolerance_mm: float) -> None:
    outline = Outline(drawn(seed, tolerance_mm))
    way = ways(outline)
    moved = np.linalg.norm(outline.rounded(way) - outline.sharp(way), axis=1)
    assert moved.max() <= tolerance_mm * 1e-3 + 1e-12
    away = np.ones(len(way), dtype=bool)
    for at_m, half_m, _ in outline.corners:
        away &= np.abs(way - at_m) >= half_m
    assert (moved[away] == 0.0).all()


@given(SEEDS, TOLERANCES_MM)
def test_a_corner_is_cut_by_the_whole_tolerance_unless_a_side_is_too_short(seed: int, tolerance_mm: float) -> None:
    outline = Outline(drawn(seed, tolerance_mm))
    sides = np.diff(outline.knots_m)
    for at_m, half_m, _ in outline.corners:
        here = np.array([at_m])
        cut = float(np.linalg.norm(outline.rounded(here) - outline.sharp(here)))
        index = int(np.argmin(np.abs(outline.knots_m - at_m)))
        short = half_m > min(sides[index - 1], sides[index]) / 2.0 - 1e-9
        assert short or cut == pytest.approx(tolerance_mm * 1e-3)


@given(SEEDS, TOLERANCES_MM)
def test_the_rounded_path_jumps_neither_in_place_nor_in_direction(seed: int, tolerance_mm: float) -> None:
    outline = Outline(drawn(seed, tolerance_mm))
    for at_m, half_m, _ in outline.corners:
        for edge_m in (at_m - half_m, at_m, at_m + half_m):
            step = 1e-5 * half_m
            places = outline.rounded(edge_m + step * np.array([-2.0, -1.0, 0.0, 1.0, 2.0]))
            before, after = places[1] - places[0], places[4] - places[3]
            assert np.linalg.norm(after - before) < 1e-3 * step + 1e-15


@given(SEEDS)
def test_lines_lead_from_point_to_point_at_an_even_pace(seed: int) -> None:
    request = drawn(seed, arcs=False)
    outline = Outline(request)
    np.testing.assert_allclose(outline.sharp(outline.knots_m), request.points_m, atol=1e-12)
    assert outline.length_m == pytest.approx(sum(math.dist(a, b) for a, b in pairwise(request.points_m)))
    moved = np.linalg.norm(np.diff(outline.sharp(ways(outline)), axis=0), axis=1)
    assert moved.max() <= outline.length_m / 800 + 1e-12


@given(SEEDS)
def test_an_arc_has_one_radius_passes_its_middle_point_and_ends_at_its_last(seed: int) -> None:
    rng = np.random.default_rng(seed)
    frame = np.linalg.qr(rng.standard_normal((3, 3)))[0]
    centre, radius_m = rng.uniform(-0.1, 0.1, 3), float(rng.uniform(0.01, 0.2))
    angles = np.cumsum(rng.uniform(0.3, 2.0, 3))
    points = centre + radius_m * (np.cos(angles)[:, None] * frame[0] + np.sin(angles)[:, None] * frame[1])
    outline = Outline(PathRequest(points_m=tuple(map(tuple, points.tolist())), kinds=("line", "through", "arc")))
    arc = outline.rounded(ways(outline, 2001))
    np.testing.assert_allclose(np.linalg.norm(arc - centre, axis=1), radius_m, rtol=1e-6)
    np.testing.assert_allclose(arc[[0, -1]], points[[0, 2]], atol=1e-9)
    assert np.linalg.norm(arc - points[1], axis=1).min() < 1e-3 * radius_m
    assert outline.length_m == pytest.approx(radius_m * (angles[2] - angles[0]), rel=1e-6)


def test_a_circle_of_two_arcs_has_no_corner() -> None:
    points = ((0.03, 0.0, 0.1), (0.0, 0.03, 0.1), (-0.03, 0.0, 0.1), (0.0, -0.03, 0.1), (0.03, 0.0, 0.1))
    outline = Outline(PathRequest(points_m=points, kinds=("line", "through", "arc", "through", "arc")))
    assert outline.corners == []
    assert outline.length_m == pytest.approx(2.0 * math.pi * 0.03)


A, B, C = (0.1, 0.0, 0.1), (0.2, 0.0, 0.1), (0.3, 0.0, 0.1)


@pytest.mark.parametrize(
    ("fields", "match"),
    [
        ({"points_m": (A,)}, "points_m"),
        ({"points_m": (A, (math.nan, 0.0, 0.1))}, "points_m"),
        ({"points_m": (A, (11.0, 0.0, 0.1))}, "points_m"),
        ({"points_m": (A, B, B)}, "point 3 repeats point 2"),
        ({"points_m": (A, B), "kinds": ("line", "spline")}, "kinds"),
        ({"points_m": (A, B), "kinds": ("line",)}, "1 for 2 points"),
        ({"points_m": (A, B), "kinds": ("arc", "line")}, "begins there"),
        ({"points_m": (A, B), "kinds": ("line", "through")}, "point 3 must be 'arc'"),
        ({"points_m": (A, B), "kinds": ("line", "arc")}, "point 1 must be 'through'"),
        ({"points_m": (A, B, C), "kinds": ("line", "through", "arc")}, "on one line"),
        ({"points_m": (A, B, A), "kinds": ("line", "through", "arc")}, "whole circle of two arcs"),
        ({"points_m": (A, B, (0.3, 0.0, 0.1001)), "kinds": ("line", "through", "arc")}, "radius .* make it a line"),
        ({"points_m": (A, B), "duration_s": 0.0}, "duration_s"),
        ({"points_m": (A, B), "tolerance_mm": 0.0}, "tolerance_mm"),
    ],
)
def test_what_is_no_path_is_refused_with_what_is_wrong(fields: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        validate(PathRequest, fields, "path")


def test_a_table_is_the_request_that_it_says() -> None:
    text = "x_m, y_m, z_m, kind\n0.1,0,0.1,\n0.2, 0.05, 0.1, through\n0.3,0,0.1,arc\n\n0.3,0.1,0.1,line\n"
    assert path_from_text(text, "f.csv", tolerance_mm=3.0) == PathRequest(
        points_m=(A, (0.2, 0.05, 0.1), C, (0.3, 0.1, 0.1)),
        kinds=("line", "through", "arc", "line"),
        tolerance_mm=3.0,
    )


def test_the_examples_are_paths() -> None:
    examples = DOCS / "examples"
    square, circle = (path_from_text((examples / name).read_text(), name) for name in ("square.csv", "circle.csv"))
    assert Outline(square).length_m == pytest.approx(0.4)
    assert Outline(circle).length_m == pytest.approx(0.06 * math.pi)
    assert [len(Outline(one).corners) for one in (square, circle)] == [3, 0]


def test_the_longest_path_and_all_that_was_learnt_of_it_fit_into_one_line_of_the_socket() -> None:
    points = tuple((0.123456, round(-0.1 + 1e-4 * k, 6), -0.1 - 1e-4 * (k % 2)) for k in range(MAX_POINTS))
    rows = ((-0.012345,) * 6,) * (MOST_SHIFTS // 6)
    learnt = Learnt(arm_id="a" * 64, calibration_hash="b" * 64, begin_rad=(-1.234567890123456,) * 6, shift_rad=rows)
    kinds: tuple[Kind, ...] = ("line", *("through", "arc") * ((MAX_POINTS - 1) // 2), "line")
    whole = PathRequest(points_m=points, kinds=kinds[:MAX_POINTS], duration_s=600.0, learnt=learnt)
    assert len(json.dumps({"id": 1, "method": "path", "params": whole.model_dump()})) < MAX_LINE_BYTES


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "no column x_m, y_m, z_m"),
        ("0.1,0,0.1\n0.2,0,0.1\n", "f.csv: header: no column"),
        ("x_m,y_m,z_m,colour\n0.1,0,0.1,red\n", "unknown column colour"),
        ("x_m,y_m,z_m\n0.1,0,0.1\n0.2,zero,0.1\n", "f.csv: row 3: 'zero' is not a finite number"),
        ("x_m,y_m,z_m\n0.1,0,0.1\n0.2,0\n", "row 3: has 2 cells, the header 3"),
        ("x_m,y_m,z_m\n0.1,0,0.1\n0.2,nan,0.1\n", "row 3: 'nan'"),
        ("x_m,y_m,z_m\n0.1,0,0.1\n", "points_m"),
        ("x_m,y_m,z_m,kind\n0.1,0,0.1,\n0.2,0,0.1,curve\n", "kinds"),
    ],
)
def test_a_table_that_is_no_path_is_refused_with_its_row(text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match) as caught:
        path_from_text(text, "f.csv")
    assert re.match(r"f\.csv", str(caught.value))
