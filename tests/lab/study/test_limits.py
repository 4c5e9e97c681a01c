from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armctl.lab.study.limits import WITHOUT, Case, Evidence, with_shares, work
from armctl.report import experiment as page
from armctl.report.line import ExperimentReport
from armctl.trajectory.straightness import mean_error
from tests.genetic import hand

A, B = (0.18, -0.1, 0.10), (0.18, 0.1, 0.10)
CASE = Case(hand.arm(), 1, A, B, (1, "stream"), 5.0, rounds=0, repeats=2, period_s=0.1)


@pytest.fixture(scope="module")
def evidence() -> Evidence:
    return work(CASE)


def test_without_weight_the_uncorrected_arm_misses_by_far_less(evidence: Evidence) -> None:
    light = work(replace(CASE, without="sag"))
    rows = with_shares([*evidence.rows, *light.rows])
    assert [row["before_share_mm"] for row in rows[:2]] == [0.0, 0.0]
    for row in rows[2:]:
        assert row["without"] == "sag"
        assert row["before_share_mm"] > 5.0


def test_every_effect_of_the_simulator_can_be_switched_off() -> None:
    assert set(WITHOUT) == {None, "sag", "friction", "backlash", "noise", "offset", "timing"}
    (row,) = work(replace(CASE, without="timing", via=(1,), repeats=1)).rows
    assert row["before_mm"] > 0.0


def test_outcomes_hold_the_true_paths_of_every_round_and_repeat(evidence: Evidence) -> None:
    for row, outcome in zip(evidence.rows, evidence.outcomes, strict=True):
        assert outcome.via == row["via"]
        assert len(outcome.runs) == 2
        assert len(outcome.rounds) == 1
        assert outcome.before.truth_tool_m is not None
        error = float(mean_error(outcome.before.truth_tool_m, np.array(A), np.array(B))) * 1e3
        assert error == pytest.approx(row["before_mm"])
        assert row["spread_mm"] >= 0.0


def test_the_page_shows_every_part_and_its_numbers(evidence: Evidence, tmp_path: Path) -> None:
    fronts = [
        {
            "duration_s": 5.0, "via": 1, "recorded_mean_error_mm": 3.0, "predicted_mean_error_mm": 0.7,
            "feasible": True, "front_duration": True, "front_via": False,
        }
    ]  # fmt: skip
    report = ExperimentReport(
        from_m=np.array(A),
        to_m=np.array(B),
        outcomes=evidence.outcomes,
        best_cost_mm=(3.0, 2.0),
        exact_mean_mm=1.9,
        limits=evidence.rows,
        fronts=fronts,
        notes=("a note & more",),
    )
    page.write(report, tmp_path / "page.html")
    html = (tmp_path / "page.html").read_text()
    for heading in (
        "Distance from the line", "Path against line", "Deviation along the path", "Convergence",
        "Prediction against measurement", "What limits the rest", "Error against time and against via points",
    ):  # fmt: skip
        assert f"<h2>{heading}" in html
    assert html.count('<figure role="img"') == 3 + 1 + 2 + 1 + 2 + 2
    assert f"{evidence.rows[0]['before_mm']:.2f}" in html
    assert "a note &amp; more" in html
    assert "7.4 / 16.5 in 7.7 s" in html  # the paper's row for one point

    page.write(replace(report, limits=(), fronts=(), best_cost_mm=()), tmp_path / "short.html")
    short = (tmp_path / "short.html").read_text()
    assert "What limits the rest" not in short
    assert short.count('<figure role="img"') == 3 + 1 + 1 + 1
