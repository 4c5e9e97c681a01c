from pathlib import Path

import pytest

from armctl.lab.study.case import Found
from armctl.lab.study.limits import every_effect, run, with_shares
from armctl.report import experiment as page
from armctl.report.line import ExperimentReport
from armctl.trajectory.straightness import mean_error
from tests.lab.study.cases import case
from tests.words import missing

CASE = case(via=(1, "stream"), repeats=2)


@pytest.fixture(scope="module")
def found() -> Found:
    return run(CASE)


def test_without_weight_the_uncorrected_arm_misses_by_far_less(found: Found) -> None:
    (sag,) = (each for each in every_effect(CASE) if each.without == "sag")
    light = run(sag)
    rows = with_shares([*found.rows, *light.rows])
    assert [row["before_share_mm"] for row in rows[:2]] == [0.0, 0.0]
    assert all(row["without"] == "sag" and row["before_share_mm"] > 5.0 for row in rows[2:])


def test_every_effect_of_the_simulator_can_be_switched_off() -> None:
    effects = every_effect(case(via=(1,)))
    known = [None, "sag", "friction", "backlash", "noise", "offset", "timing"]
    assert [each.without for each in effects] == known
    (row,) = run(effects[-1]).rows
    assert row["before_mm"] > 0.0


def test_outcomes_hold_the_true_paths_of_every_round_and_repeat(found: Found) -> None:
    for row, outcome in zip(found.rows, found.evidence, strict=True):
        assert (outcome.via, len(outcome.runs), len(outcome.rounds)) == (row["via"], 2, 1)
        assert outcome.before.truth_tool_m is not None
        error = float(mean_error(outcome.before.truth_tool_m, CASE.line.A, CASE.line.B)) * 1e3
        assert error == pytest.approx(row["before_mm"])
        assert row["spread_mm"] >= 0.0


def drawn(report: ExperimentReport, file: Path) -> str:
    page.write(report, file)
    return file.read_text()


def test_the_page_shows_every_part_and_its_numbers(found: Found, tmp_path: Path) -> None:
    front = {
        "duration_s": 5.0, "via": 1, "recorded_mean_error_mm": 3.0, "predicted_mean_error_mm": 0.7,
        "feasible": True, "front_duration": True, "front_via": False,
    }  # fmt: skip
    report = ExperimentReport(
        (CASE.line.A, CASE.line.B), found.evidence, best_cost_mm=(3.0, 2.0), exact_mean_mm=1.9,
        limits=found.rows, fronts=[front], notes=("a note & more",),
    )  # fmt: skip
    html = drawn(report, tmp_path / "page.html")
    headings = (
        "Distance from the line", "Path against line", "Deviation along the path", "Convergence",
        "Prediction against measurement", "What limits the rest", "Error against time and against via points",
    )  # fmt: skip
    papers_one_point = "7.4 / 16.5 in 7.7 s"
    shown = [f"<h2>{heading}" for heading in headings] + [f"{found.rows[0]['before_mm']:.2f}"]
    assert not missing(html, *shown, "a note &amp; more", papers_one_point)
    assert html.count('<figure role="img"') == 3 + 1 + 2 + 1 + 2 + 2
    short = drawn(report._replace(limits=(), fronts=(), best_cost_mm=()), tmp_path / "short.html")
    assert "What limits the rest" not in short
    assert short.count('<figure role="img"') == 3 + 1 + 1 + 1
