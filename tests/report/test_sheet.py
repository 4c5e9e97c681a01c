"""The sheet of points to touch: true to scale, every point where it says that it is."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

from armctl.report import sheet
from tests.host.doubles import refused

SVG = "{http://www.w3.org/2000/svg}"
POINTS = [(0.12, -0.05, 0.0), (0.2, 0.06, 0.0), (0.2, 0.06, 0.075)]


def drawn(path: Path, points: list[tuple[float, float, float]], floor_m: float = 0.0) -> tuple[str, ET.Element]:
    paper = sheet.write(points, "my-arm", floor_m, path)
    return paper, ET.parse(path).getroot()


def crosses(page: ET.Element) -> list[tuple[float, float]]:
    """Where crosses of points are [mm]: to the right on the page, and down."""
    ways = [way.get("d", "") for way in page.iter(f"{SVG}path")]
    return [(float(x), float(y)) for way in ways for x, y in re.findall(r"^M([\d.]+) ([\d.]+)m-5 0h10m-5 -5v10$", way)]


def test_a_page_is_as_large_as_its_paper_in_millimetres_and_its_ruler_100_mm(tmp_path: Path) -> None:
    paper, page = drawn(tmp_path / "s.svg", POINTS)
    assert paper == "A4"
    assert (page.get("width"), page.get("height"), page.get("viewBox")) == ("210mm", "297mm", "0 0 210 297")
    assert any(way.get("d") == "M0 13H100" for way in page.iter(f"{SVG}path"))


def test_points_lie_ahead_of_the_base_and_to_its_left_as_they_are_said_to(tmp_path: Path) -> None:
    _, page = drawn(tmp_path / "s.svg", POINTS)
    [base] = [one for one in page.iter(f"{SVG}circle") if one.get("r") == "3"]
    left, top = float(base.get("cx", "")), float(base.get("cy", ""))
    assert [(round(top - y, 3), round(left - x, 3)) for x, y in crosses(page)] == [(120, -50), (200, 60), (200, 60)]
    told = ["".join(text.itertext()) for text in page.iter(f"{SVG}text")]
    assert {"1: 120, -50", "2: 200, 60", "3: 200, 6075 mm up"} <= set(told)
    assert sum(one.get("r") == "3.5" for one in page.iter(f"{SVG}circle")) == 1


def test_heights_count_from_the_table(tmp_path: Path) -> None:
    _, page = drawn(tmp_path / "s.svg", [(x, y, z - 0.25) for x, y, z in POINTS], -0.25)
    assert sum("75 mm up" in "".join(text.itertext()) for text in page.iter(f"{SVG}text")) == 1


@pytest.mark.parametrize(
    ("far", "paper"),
    [((0.1, 0.2, 0.0), "A4 landscape"), ((0.3, 0.05, 0.0), "A3"), ((0.15, 0.33, 0.0), "A3 landscape")],
)
def test_the_smallest_paper_that_holds_base_and_points_is_taken(
    tmp_path: Path, far: tuple[float, float, float], paper: str
) -> None:
    found, page = drawn(tmp_path / "s.svg", [*POINTS[:1], far])
    assert found == paper
    width, height = (float((page.get(side) or "").removesuffix("mm")) for side in ("width", "height"))
    for x, y in crosses(page):
        assert 10.0 < x < width - 10.0
        assert 10.0 < y < height - 25.0


def test_what_no_page_holds_is_refused_and_nothing_is_written(tmp_path: Path) -> None:
    with refused("SHEET", "make two files of them"):
        sheet.write([(0.5, 0.3, 0.0)], "my-arm", 0.0, tmp_path / "s.svg")
    assert not list(tmp_path.iterdir())
