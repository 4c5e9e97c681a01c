from dataclasses import replace
from itertools import product

import pytest

from armctl.errors import ConfigError
from armctl.genetic.algorithm import PAPER
from armctl.lab.study.case import all_rows
from armctl.lab.study.ga import every_setting, over_seeds, run
from tests.genetic import hand
from tests.lab.study.cases import case

BASE = case(
    from_m=(0.18, -0.125, 0.10), to_m=(0.18, 0.125, 0.10), takes=tuple(hand.recordings(3, 1)),
    settings=replace(PAPER, generations=20), seed=7,
)  # fmt: skip


def test_every_setting_gets_the_same_seeds_and_one_row() -> None:
    asked = every_setting(BASE, population=[10, 30], pc=[0.5, 0.9], pm=[0.01], repeats=2)
    assert [each.seed for each in asked] == [7, 8] * 4
    found = all_rows([run(each) for each in asked])
    table = over_seeds(found, asked)
    assert [(row["population"], row["crossover_probability"]) for row in table] == list(product((10, 30), (0.5, 0.9)))
    for row, first, second in zip(table, found[::2], found[1::2], strict=True):
        both = (first["mean_error_mm"], second["mean_error_mm"])
        assert row["mean_error_mm"] == pytest.approx(sum(both) / 2)
        assert row["spread_mm"] == pytest.approx(abs(both[0] - both[1]) / 2)
        assert (row["best_mm"], row["repeats"]) == (min(both), 2)
        assert row["gap_ratio"] >= -1e-12
        assert 1 <= row["settled_generation"] <= 20


def test_a_setting_out_of_range_is_refused_before_any_work() -> None:
    with pytest.raises(ConfigError, match=r"crossover_probability: 1\.5 is outside 0 to 1"):
        every_setting(BASE, population=[10], pc=[0.5, 1.5], pm=[0.01], repeats=1)
