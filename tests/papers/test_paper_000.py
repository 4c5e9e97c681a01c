"""000: the printed tables, the grid, and the short form of the published algorithm."""

import math

import numpy as np
import pytest

from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.papers import paper_000
from armctl.papers.comparison import SMALLER
from tests.papers.quick import reproduced

ROBOT = robots.get("xiang-6dof")


def test_printed_errors_are_the_papers_anchors() -> None:
    np.testing.assert_allclose(paper_000.printed_statistics(), [0.254239, 1.42111, 0.044635, 0.474872], atol=5e-7)


def test_three_targets_are_out_of_reach_by_exactly_so_much() -> None:
    found = {where: distance for where, (distance, _) in paper_000.out_of_reach(ROBOT).items()}
    expected = {(x, y): math.hypot(x / 100, y / 100, 0.001) - 0.416 for x, y in ((29, 30), (30, 29), (30, 30))}
    assert found == pytest.approx(expected, abs=1e-15)


def test_with_polish_97_targets_are_reached_and_the_others_come_as_near_as_they_can() -> None:
    run = paper_000.evolve(ROBOT, 5, paper_000.grid_m())
    q, missed = paper_000.polished(ROBOT, paper_000.grid_m(), run.q_rad)
    assert (missed <= 1e-9).sum() == 97
    least = dict.fromkeys(range(100), 0.0)
    for (x, y), (distance, _) in paper_000.out_of_reach(ROBOT).items():
        least[int((x - 21.0) * 10 + y - 21.0)] = distance
    np.testing.assert_allclose(missed, list(least.values()), atol=1e-7)
    assert paper_000.statistics(paper_000.grid_errors_cm(tool_position(ROBOT.chain, q)))[0] <= 0.0108


def test_the_report_tells_every_quantity_with_its_verdict() -> None:
    report = reproduced("000")
    verdicts = {row.quantity: row.verdict for row in report.rows}
    assert verdicts["mean |dxy|, GA with polish"] == SMALLER
    assert sum("out of reach by exactly" in name for name in verdicts) == 3
    readings, *runs, angles = report.tables
    assert [row[0] for row in readings.rows] == ["print", *paper_000.READINGS]
    assert [table.title for table in runs] == ["delta xy0 of one run", "delta z0 of one run"]
    assert all(len(table.rows) == 10 and len(table.rows[0]) == 11 for table in runs)
    assert len([picture for picture in report.pictures if "Fig. 11" in picture.title]) == 4
    # Fig. 10: the angles found, by forward kinematics; with polish on both targets.
    x_y_z = [tuple(map(float, row[-3:])) for row in angles.rows]
    assert (x_y_z[2], x_y_z[3]) == paper_000.TARGETS_CM


def test_mean_and_best_of_figure_8_meet_where_an_individual_is_mutated_and_not_where_a_bit_is() -> None:
    found = {row.quantity: row.armctl for row in reproduced("000").rows}
    name = "least / mean distance after 200 generations (Fig. 8)"
    assert float(found[name]) < 0.2 < 0.8 < float(found[f"{name}, mutation of 0.01 an individual"])
