import math
from pathlib import Path

import openpyxl
import pytest

from armctl.errors import LogError
from armctl.lab.study.case import Case, Found
from armctl.lab.table_ii import FROM_M, RUNS, TO_M, every_experiment, run, write
from armctl.report.line import PRINTED
from tests.genetic import hand

CASES = every_experiment(Case(arm=hand.arm(), from_m=FROM_M, to_m=TO_M))


@pytest.fixture(scope="module")
def experiments() -> list[Found]:
    first, _, third = CASES
    return [run(first), run(third)]


def test_more_points_are_straighter_and_the_paper_stands_beside(experiments: list[Found]) -> None:
    first, third = (one.rows[0] for one in experiments)
    assert (first["experiment"], third["experiment"]) == (1, 3)
    assert third["mean_error_mm"] < first["mean_error_mm"]
    for row in (first, third):
        assert row["exact_mean_error_mm"] <= row["mean_error_mm"] <= row["max_error_mm"]
        assert row["duration_s"] == pytest.approx(5.0, rel=0.05)
        assert tuple(row["paper"].values()) == PRINTED[row["via"]]
        # Uncorrected, the arm sags by more than interpolation costs.
        assert row["recorded_mean_error_mm"] > 10.0


def test_the_recorded_angles_of_every_run_are_in_the_workbook(experiments: list[Found], tmp_path: Path) -> None:
    file = tmp_path / "angles.xlsx"
    write(file, CASES, experiments)
    book = openpyxl.load_workbook(file, read_only=True)
    assert book.sheetnames == [f"experiment {number} run {run}" for number in (1, 3) for run in range(1, RUNS + 1)]
    rows = list(book["experiment 3 run 2"].iter_rows(values_only=True))
    second = experiments[1].evidence[1]
    assert rows[0] == ("time_s", *(f"{name}_deg" for name in hand.arm().joint_names))
    for row, time_s, q in zip(rows[1:], second.time_s, second.positions_rad, strict=True):
        assert row == pytest.approx((time_s, *(math.degrees(angle) for angle in q)))
    book.close()
    with pytest.raises(LogError, match="exists"):
        write(file, CASES, experiments)
