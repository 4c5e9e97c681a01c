"""The picture of a line before and after: an SVG that any reader opens, with what was measured in it."""

import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

from armctl.kinematics.transform import FloatArray
from armctl.report import experiment, picture
from armctl.report.line import DrawnOutcome, ExperimentReport, LineRun
from tests.report import runs
from tests.report.runs import A, B, beside
from tests.words import missing

SVG = "{http://www.w3.org/2000/svg}"
ROOT = Path(__file__).resolve().parents[2]


def run(off_m: FloatArray, *, true: bool = True) -> LineRun:
    """Beside the line by so much; where that is known, the encoders are far off."""
    path = beside(off_m)
    return runs.run(2, path, path + 0.5 if true else path, path if true else None)


def report(before: LineRun, after: LineRun) -> ExperimentReport:
    return ExperimentReport((A, B), [DrawnOutcome(via, before, [after], [before, after]) for via in (2, "stream")])


SAGGED, STRAIGHT = run(np.array([0.01, 0.0, -0.02])), run(np.array([0.001, 0.0, 0.0]))


def texts(svg: str) -> list[str]:
    return [str(one.text) for one in ET.fromstring(svg).iter(f"{SVG}text")]


def curves(root: ET.Element) -> list[tuple[str, list[list[float]]]]:
    """Class and points of every curve but the ruler, in the order in which they are drawn."""

    def points(d: str) -> list[list[float]]:
        return [[float(value) for value in pair.split()] for pair in re.split("[ML]", d) if pair]

    drawn = [one.attrib for one in root.iter(f"{SVG}path") if one.attrib["class"] != "ruler"]
    return [(one["class"], points(one["d"])) for one in drawn]


def test_it_tells_how_far_off_the_true_tool_was_before_and_after() -> None:
    told = texts(picture.svg(report(SAGGED, STRAIGHT)))
    off = [
        f"{when}: {mm} mm off the line on average, {mm} mm at most" for when, mm in (("before", 22.4), ("after", 1.0))
    ]
    assert not missing(told, *off, "The same line with a goal every tick")


def test_without_an_outside_measurement_it_says_who_measured() -> None:
    told = texts(picture.svg(report(run(np.array([0.0, 0.0, -0.02]), true=False), STRAIGHT)))
    assert "before: 20.0 mm off the line on average, 20.0 mm at most by the encoders" in told


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.01, 0.05, -0.02), (-0.06, -0.3, 0.09)])
def test_everything_drawn_is_inside_the_picture(off: tuple[float, float, float]) -> None:
    root = ET.fromstring(picture.svg(report(run(np.array(off)), STRAIGHT)))
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    assert len(curves(root)) == 2 * 2 * 3
    assert all(0.0 <= x <= width and 0.0 <= y <= height for _, points in curves(root) for x, y in points)


def test_it_is_true_to_scale() -> None:
    first_of = dict(reversed(curves(ET.fromstring(picture.svg(report(SAGGED, STRAIGHT))))))
    (first, *_), (a, b, *_) = first_of["before"], first_of["wanted"]
    scale = (b[0] - a[0]) / 200.0
    assert abs(first[1] - a[1]) == pytest.approx(10.0 * scale, abs=0.2)


def test_a_report_named_svg_is_the_picture(tmp_path: Path) -> None:
    experiment.write(report(SAGGED, STRAIGHT), tmp_path / "line.svg")
    assert (tmp_path / "line.svg").read_text(encoding="utf-8") == picture.svg(report(SAGGED, STRAIGHT))


def test_the_picture_of_the_readme_is_one_of_these() -> None:
    [path] = re.findall(r"!\[.*?\]\((.*?\.svg)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    told = texts((ROOT / path).read_text(encoding="utf-8"))
    assert [words.partition(":")[0] for words in told[1:3]] == ["before", "after"]
