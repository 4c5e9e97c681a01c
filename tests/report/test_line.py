"""The straight-line page: complete in itself, its numbers those of the paths it is given."""

import json
import re
from pathlib import Path

import numpy as np
import pytest

from armctl.kinematics.transform import FloatArray
from armctl.report.line import COLOURS, LineReport, along_and_off, write
from tests.report.runs import A, B, beside, run
from tests.words import missing


def path(up_m: float) -> FloatArray:
    return beside(np.array([0.0, 0.0, up_m]))


REPORT = LineReport(
    ends=(A, B),
    joint_names=("base", "shoulder"),
    candidates_m=[path(0.01)],
    candidate_errors_mm=[("take <1>", 10.0, 10.0, 50)],
    ga_mean_mm=5.0,
    exact_mean_mm=4.9,
    gap_ratio=0.02,
    best_mm=np.array([6.0, 5.0]),
    mean_mm=np.array([8.0, 7.0]),
    runs=[
        *(run(via, path(0.001), path(-0.0123), path(-0.0456)) for via in (0, 2)),
        *(run(via, path(0.001), path(-0.0011), path(-0.0022))._replace(goals="corrected") for via in (0, 2)),
        run(2, path(0.001), path(-0.0007), path(-0.0008))._replace(goals="refined"),
    ],
)


def page(report: LineReport, folder: Path) -> str:
    write(report, folder / "line.html")
    return (folder / "line.html").read_text()


def test_the_page_tells_what_the_paths_show(tmp_path: Path) -> None:
    html = page(REPORT, tmp_path)
    assert not re.search(r"<(script|link|img|iframe)[^>]+(src|href)=", html)
    assert (html.count("12.30 / 12.30"), html.count("45.60 / 45.60")) == (2, 2)
    assert not missing(html, "take &lt;1&gt;", "2.00 % above")
    assert html.count('<figure role="img"') == 3 + 1 + 1 + 5


def test_plain_corrected_and_refined_paths_stand_in_one_picture_in_the_colour_of_their_number_of_points(
    tmp_path: Path,
) -> None:
    write(REPORT, tmp_path / "line.html")
    html = (tmp_path / "line.html").read_text()
    charts = re.findall(r'<script type="application/json">(.*?)</script>', html)
    drawn = [trace for chart in charts for trace in json.loads(chart)["data"]]
    colours = dict(zip((0, 2), COLOURS, strict=False))
    for how, dash, some in (("plain", "dot", (0, 2)), ("corrected", "dash", (0, 2)), ("refined", "solid", (2,))):
        assert f"<td>{how}</td>" in html
        for via in some:
            strokes = [trace["line"] for trace in drawn if trace["name"] == f"{via} via, {how}, true"]
            assert [(line["color"], line["dash"]) for line in strokes] == [(colours[via], dash)] * 3


def test_the_genetic_algorithm_is_drawn_as_far_as_it_improves_from_the_best_take_down_to_the_exact_optimum(
    tmp_path: Path,
) -> None:
    best_mm = np.array([8.0, 7.0, 7.0, 6.0, *[5.0] * 196])
    html = page(REPORT._replace(best_mm=best_mm, mean_mm=best_mm + 1.0, exact_mean_mm=5.0), tmp_path)
    assert '"range":[0,10]' in html
    assert not missing(html, "best take", "exact optimum")
    best_mm[30:] = 4.0
    html = page(REPORT._replace(best_mm=best_mm, mean_mm=best_mm + 1.0, exact_mean_mm=4.0), tmp_path)
    assert '"range":[0,45]' in html


def test_without_an_outside_measurement_the_truth_is_left_open(tmp_path: Path) -> None:
    blind = [one._replace(truth_tool_m=None) for one in REPORT.runs]
    html = page(REPORT._replace(runs=blind), tmp_path)
    assert (html.count("12.30 / 12.30"), html.count("45.60 / 45.60")) == (2, 0)


@pytest.mark.parametrize("to", [B, np.array([0.3, -0.1, 0.1]), np.array([0.18, -0.1, 0.2]), A - 0.05])
def test_progress_and_both_deviations_hold_the_whole_offset(to: FloatArray) -> None:
    points = np.random.default_rng(0).standard_normal((20, 3)) * 0.1
    parts = np.stack(along_and_off(points, A, to))
    np.testing.assert_allclose(np.linalg.norm(parts, axis=0), np.linalg.norm(points - A, axis=1) * 1e3)
    np.testing.assert_allclose(np.stack(along_and_off(np.stack([A, to]), A, to))[1:], 0.0, atol=1e-9)
