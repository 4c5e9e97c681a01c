from __future__ import annotations

import math
from pathlib import Path

import openpyxl
import pytest

from armctl.errors import LogError
from armctl.lab.study.table_ii import RUNS, Case, Experiment, work, write_angles
from armctl.report.line import PAPER_ROWS
from tests.genetic import hand


@pytest.fixture(scope="module")
def experiments() -> list[Experiment]:
    A, B = (0.18, -0.125, 0.10), (0.18, 0.125, 0.10)
    return [work(Case(hand.arm(), A, B, via, 5.0, seed=0)) for via in (0, 2)]


def test_more_points_are_straighter_and_the_paper_stands_beside(experiments: list[Experiment]) -> None:
    first, third = (one.row for one in experiments)
    assert (first["experiment"], third["experiment"]) == (1, 3)
    assert third["mean_error_mm"] < first["mean_error_mm"]
    for row in (first, third):
        assert row["exact_mean_error_mm"] <= row["mean_error_mm"] <= row["max_error_mm"]
        assert row["duration_s"] == pytest.approx(5.0, rel=0.05)
        assert tuple(row["paper"].values()) == PAPER_ROWS[row["via"]]
        # Uncorrected, the arm sags by more than interpolation costs.
        assert row["recorded_mean_error_mm"] > 10.0


def test_the_recorded_angles_of_every_run_are_in_the_workbook(experiments: list[Experiment], tmp_path: Path) -> None:
    file = tmp_path / "angles.xlsx"
    write_angles(file, hand.arm().joint_names, experiments)
    book = openpyxl.load_workbook(file, read_only=True)
    assert book.sheetnames == [f"experiment {number} run {run}" for number in (1, 3) for run in range(1, RUNS + 1)]
    rows = list(book["experiment 3 run 2"].iter_rows(values_only=True))
    run = experiments[1].runs[1]
    assert rows[0] == ("time_s", *(f"{name}_deg" for name in hand.arm().joint_names))
    assert len(rows) == 1 + len(run.time_s)
    for row, time_s, q in zip(rows[1:], run.time_s, run.positions_rad, strict=True):
        assert row == pytest.approx((time_s, *(math.degrees(angle) for angle in q)))
    book.close()
    with pytest.raises(LogError, match="exists"):
        write_angles(file, hand.arm().joint_names, experiments)
