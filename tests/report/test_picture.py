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


def test_it_tells_how_far_off_the_true_tool_was_before_and_after() -> None:
    told = texts(picture.svg(report(SAGGED, STRAIGHT)))
    assert "before: 22.4 mm off the line on average, 22.4 mm at most" in told
    assert "after: 1.0 mm off the line on average, 1.0 mm at most" in told
    assert "The same line with a goal every tick" in told


def test_without_an_outside_measurement_it_says_who_measured() -> None:
    assert "before: 20.0 mm off the line on average, 20.0 mm at most by the encoders" in texts(
        picture.svg(report(run(np.array([0.0, 0.0, -0.02]), true=False), STRAIGHT))
    )


@pytest.mark.parametrize("off", [(0.0, 0.0, 0.0), (0.01, 0.05, -0.02), (-0.06, -0.3, 0.09)])
def test_everything_drawn_is_inside_the_picture(off: tuple[float, float, float]) -> None:
    root = ET.fromstring(picture.svg(report(run(np.array(off)), STRAIGHT)))
    _, _, width, height = map(float, root.attrib["viewBox"].split())
    curves = [one.attrib["d"] for one in root.iter(f"{SVG}path") if one.attrib["class"] != "ruler"]
    assert len(curves) == 2 * 2 * 3
    points = [[float(value) for value in pair.split()] for d in curves for pair in re.split("[ML]", d) if pair]
    assert all(0.0 <= x <= width and 0.0 <= y <= height for x, y in points)


def test_it_is_true_to_scale() -> None:
    root = ET.fromstring(picture.svg(report(SAGGED, STRAIGHT)))
    curve = next(one.attrib["d"] for one in root.iter(f"{SVG}path") if one.attrib["class"] == "before")
    wanted = next(one.attrib["d"] for one in root.iter(f"{SVG}path") if one.attrib["class"] == "wanted")
    ends = [[float(value) for value in pair.split()] for pair in re.split("[ML]", wanted) if pair]
    first = [float(value) for value in re.split("[ML]", curve)[1].split()]
    scale = (ends[1][0] - ends[0][0]) / 200.0
    assert abs(first[1] - ends[0][1]) == pytest.approx(10.0 * scale, abs=0.2)


def test_a_report_named_svg_is_the_picture(tmp_path: Path) -> None:
    experiment.write(report(SAGGED, STRAIGHT), tmp_path / "line.svg")
    assert (tmp_path / "line.svg").read_text(encoding="utf-8") == picture.svg(report(SAGGED, STRAIGHT))


def test_the_picture_of_the_readme_is_one_of_these() -> None:
    [path] = re.findall(r"!\[.*?\]\((.*?\.svg)\)", (ROOT / "README.md").read_text(encoding="utf-8"))
    told = texts((ROOT / path).read_text(encoding="utf-8"))
    assert [words.partition(":")[0] for words in told[1:3]] == ["before", "after"]
