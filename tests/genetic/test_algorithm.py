from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.errors import ConfigError
from armctl.genetic.algorithm import DEFAULT, PAPER, GeneticAlgorithm, Settings
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.transform import FloatArray, IntArray
from tests.genetic import hand

PLAIN = replace(
    DEFAULT, population=40, crossover="one cut", mutation_probability=0.05, charge_shares=(1.0,), searches=0
)
# Children are their parents.
UNCHANGED = replace(PLAIN, crossover_probability=0.0, mutation_probability=0.0)
WEIGHTS = np.random.default_rng(5).uniform(1.0, 2.0, 15)


def weighed(population: IntArray) -> FloatArray:
    """Cost: the weight of all genes that are not 0."""
    return np.asarray(((population != 0) * WEIGHTS).sum(axis=1))


def evolved(settings: Settings, seed: int, generations: int) -> tuple[GeneticAlgorithm, list[float]]:
    initial = np.random.default_rng(99).integers(0, 3, (20, 15))
    algorithm = GeneticAlgorithm(initial, 3, settings, np.random.default_rng(seed))
    best = []
    for _ in range(generations):
        algorithm.tell(weighed(algorithm.ask()))
        best.append(algorithm.best_cost)
    return algorithm, best


def started(initial: IntArray, choices: int, settings: Settings, table: FloatArray | None = None) -> GeneticAlgorithm:
    return GeneticAlgorithm(initial, choices, settings, np.random.default_rng(0), triple_cost=table)


def uniform(rows: int, genes: int) -> IntArray:
    """Chromosomes of one gene each."""
    return np.repeat(np.arange(rows)[:, None], genes, axis=1)


def crossed(initial: IntArray, generations: int) -> tuple[GeneticAlgorithm, FloatArray]:
    """A run by optimal crossover, and its table of triple costs."""
    table = np.random.default_rng(3).random((6, 3, 3, 3))
    algorithm = started(initial, 3, replace(DEFAULT, population=60), table)
    for _ in range(generations):
        algorithm.tell(evaluate(table, algorithm.ask()))
    return algorithm, table


def test_the_first_population_is_the_initial_one_repeated() -> None:
    algorithm = started(np.arange(6).reshape(2, 3), 6, replace(PLAIN, population=5))
    assert algorithm.ask().tolist() == [[0, 1, 2], [3, 4, 5], [0, 1, 2], [3, 4, 5], [0, 1, 2]]


@pytest.mark.parametrize("settings", [PLAIN, PAPER])
def test_the_best_never_gets_worse_and_is_the_cheapest_asked(settings: Settings) -> None:
    algorithm, best = evolved(settings, 1, 60)
    assert best == sorted(best, reverse=True)
    assert best[-1] < best[0]
    assert weighed(algorithm.best[None])[0] == algorithm.best_cost


def test_truncation_solves_a_plain_problem() -> None:
    assert evolved(PLAIN, 1, 200)[0].best_cost == 0.0


@pytest.mark.parametrize("settings", [PLAIN, PAPER])
def test_same_seed_gives_the_same_individuals_and_another_does_not(settings: Settings) -> None:
    first, second, other = (evolved(settings, seed, 20)[0].ask() for seed in (7, 7, 8))
    assert np.array_equal(first, second)
    assert not np.array_equal(first, other)


def test_truncation_keeps_the_best_of_parents_and_offspring_one_for_each_cost() -> None:
    algorithm = started(uniform(4, 3), 9, replace(UNCHANGED, population=4))
    algorithm.tell(np.array([3.0, 1.0, 1.0, 2.0]))
    assert algorithm.ask()[:, 0].tolist() == [1, 3, 0, 1]
    algorithm.tell(np.array([9.0, 0.5, 9.0, 9.0]))
    assert algorithm.ask()[:, 0].tolist() == [3, 1, 3, 0]
    assert algorithm.mean_cost == pytest.approx((0.5 + 1.0 + 2.0 + 3.0) / 4)


def test_roulette_keeps_the_elite_of_the_parents() -> None:
    settings = replace(PAPER, population=10, crossover_probability=0.0, mutation_probability=0.0, elite_fraction=0.2)
    algorithm = started(uniform(10, 3), 10, settings)
    algorithm.tell(np.where(algorithm.ask()[:, 0] == 4, 1.0, 1e9))
    algorithm.tell(np.full(10, 2.0))
    assert algorithm.ask()[0].tolist() == [4, 4, 4]
    assert algorithm.best.tolist() == [4, 4, 4]


def test_optimal_crossover_needs_and_uses_the_table() -> None:
    initial = uniform(3, 8)
    for settings in (replace(DEFAULT, searches=0), replace(PLAIN, searches=1)):
        with pytest.raises(ValueError, match="triple costs"):
            started(initial, 3, settings)
    algorithm, table = crossed(initial, 30)
    assert algorithm.best_cost < evaluate(table, initial).min()


def test_searches_improve_survivors_and_a_window_is_never_more_than_a_quarter_of_a_chromosome() -> None:
    rng = np.random.default_rng(4)
    table = rng.random((22, 4, 4, 4))
    initial = rng.integers(0, 4, (30, 24))
    algorithm = started(initial, 4, replace(UNCHANGED, population=30, searches=30), table)
    cost = evaluate(table, algorithm.ask())
    algorithm.tell(cost)
    survivors = initial[np.argsort(cost)]
    children = algorithm.ask()
    changed = (children[:, None] != survivors[None]).sum(axis=2)
    assert changed.min(axis=1).max() <= 6
    parents = changed.argmin(axis=1)
    assert (evaluate(table, children) <= np.sort(cost)[parents] + 1e-12).all()
    assert (parents[1::2] == 0).all()  # every second one is the best survivor's


def test_restart_asks_the_first_population_and_the_survivors_under_the_new_cost() -> None:
    initial = uniform(3, 8)
    algorithm, table = crossed(initial, 5)
    before = algorithm.best.copy()
    algorithm.restart(table + 1.0)
    asked = algorithm.ask()
    assert asked.shape == (60, 8)
    assert (asked[:3] == initial).all()
    assert (asked == before).all(axis=1).any()
    algorithm.tell(evaluate(table + 1.0, asked))
    assert algorithm.best_cost == pytest.approx(float(evaluate(table + 1.0, before)))


@pytest.mark.parametrize(("changes", "match"), hand.refusals("settings"))
def test_settings_out_of_range_are_refused(changes: dict[str, Any], match: str) -> None:
    with pytest.raises(ConfigError, match=match):
        replace(PAPER, **changes)
