from __future__ import annotations

from dataclasses import replace

import pytest

from armctl.errors import ConfigError
from armctl.genetic.algorithm import PAPER
from armctl.lab.study.settings import Case, cases, rows, work
from tests.genetic import hand

POINT_A, POINT_B = (0.18, -0.125, 0.10), (0.18, 0.125, 0.10)


def base(generations: int = 20) -> Case:
    settings = replace(PAPER, generations=generations)
    return Case(hand.arm(), tuple(hand.recordings(3, 1)), POINT_A, POINT_B, 3.0, settings, seed=7)


def test_every_setting_gets_the_same_seeds_and_one_row() -> None:
    asked = cases(base(), [10, 30], [0.5, 0.9], [0.01], repeats=2)
    assert [case.seed for case in asked] == [7, 8] * 4
    found = [work(case) for case in asked]
    table = rows(found, repeats=2)
    assert [(row["population"], row["crossover_probability"]) for row in table] == [
        (10, 0.5),
        (10, 0.9),
        (30, 0.5),
        (30, 0.9),
    ]
    for row, first, second in zip(table, found[::2], found[1::2], strict=True):
        both = (first["mean_error_mm"], second["mean_error_mm"])
        assert row["mean_error_mm"] == pytest.approx(sum(both) / 2)
        assert row["spread_mm"] == pytest.approx(abs(both[0] - both[1]) / 2)
        assert row["best_mm"] == min(both)
        assert row["gap_ratio"] >= -1e-12
        assert 1 <= row["settled_generation"] <= 20
        assert row["repeats"] == 2


def test_the_same_case_gives_the_same_bits() -> None:
    (case,) = cases(base(), [20], [0.6], [0.02], repeats=1)
    assert work(case) == work(case)


def test_a_setting_out_of_range_is_refused_before_any_work() -> None:
    with pytest.raises(ConfigError, match=r"crossover_probability: 1\.5 is outside 0 to 1"):
        cases(base(), [10], [0.5, 1.5], [0.01], repeats=1)
