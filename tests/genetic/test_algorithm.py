"""The genetic algorithm, and its operators."""

from dataclasses import replace
from itertools import product
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.genetic.algorithm import DEFAULT, PAPER, GeneticAlgorithm, Settings
from armctl.genetic.operators import elite, fitness_from_cost, mutate, one_cut_crossover, optimal_crossover, roulette
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.transform import FloatArray, IntArray
from tests.genetic import hand
from tests.kinematics.conftest import rngs, seeds

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


# ------------------------------------------------------------------------------------------------------------ operators


def test_fitness_is_1_for_the_best_halves_for_twice_the_cost_and_a_perfect_individual_leaves_none_to_others() -> None:
    assert fitness_from_cost(np.array([4.0, 2.0, 8.0])).tolist() == [0.5, 1.0, 0.25]
    assert fitness_from_cost(np.array([0.0, 2.0, 0.0])).tolist() == [1.0, 0.0, 1.0]


def test_roulette_draws_in_proportion_to_fitness() -> None:
    fitness = np.array([1.0, 0.0, 3.0, 4.0])
    drawn = np.bincount(roulette(fitness, 80_000, np.random.default_rng(1)), minlength=4)
    np.testing.assert_allclose(drawn / 80_000, fitness / 8.0, atol=0.01)
    assert drawn[1] == 0


def test_elite_keeps_the_best_above_the_threshold_first() -> None:
    fitness = np.array([0.5, 1.0, 0.94, 0.96, 0.99])
    assert [elite(fitness, 0.95, most).tolist() for most in (10, 2, 0)] == [[1, 4, 3], [1, 4], []]


@given(seeds, st.integers(2, 30), st.integers(2, 12))
def test_one_cut_crossover_swaps_tails_within_pairs(seed: int, rows: int, genes: int) -> None:
    population = np.arange(rows)[:, None] * np.ones(genes, dtype=np.intp)
    before = population.copy()
    children = one_cut_crossover(population, 1.0, np.random.default_rng(seed))
    assert (population == before).all()
    assert (np.sort(children, axis=0) == before).all()  # every gene of every place is still there
    assert (np.count_nonzero(np.diff(children, axis=1), axis=1) <= 1).all()
    assert (children != before).any(axis=1).sum() == rows // 2 * 2
    assert (children[:, 0] == before[:, 0]).all()


@given(rngs, st.integers(3, 7), st.integers(2, 4))
def test_optimal_crossover_makes_the_cheapest_mixture_of_both_parents(
    rng: np.random.Generator, genes: int, choices: int
) -> None:
    table = rng.random((genes - 2, choices, choices, choices))
    population, donors = rng.integers(0, choices, (2, 6, genes))
    before = population.copy()
    children = optimal_crossover(population, donors, table, 1.0, rng)
    assert (population == before).all()
    masks = np.array(list(product((False, True), repeat=genes)))
    for child, receiver, donor in zip(children, population, donors, strict=True):
        mixtures = np.where(masks, donor, receiver)
        assert (mixtures == child).all(axis=1).any()
        assert float(evaluate(table, child)) == pytest.approx(float(evaluate(table, mixtures).min()), abs=1e-12)


def test_crossover_without_probability_changes_nothing() -> None:
    population, rng = np.arange(20).reshape(4, 5) % 2, np.random.default_rng(0)
    assert (one_cut_crossover(population, 0.0, rng) == population).all()
    assert (optimal_crossover(population, 1 - population, np.zeros((3, 2, 2, 2)), 0.0, rng) == population).all()


@given(seeds, st.floats(0.0, 1.0))
def test_mutation_changes_at_most_its_share_of_genes_to_valid_values(seed: int, probability: float) -> None:
    population = np.full((10, 8), 3, dtype=np.intp)
    mutated = mutate(population, 5, probability, np.random.default_rng(seed))
    assert np.count_nonzero(mutated != 3) <= round(80 * probability)
    assert 0 <= mutated.min() <= mutated.max() < 5
    assert (population == 3).all()


def test_mutation_reaches_every_value() -> None:
    mutated = mutate(np.zeros((50, 50), dtype=np.intp), 4, 1.0, np.random.default_rng(2))
    share = np.bincount(mutated.ravel(), minlength=4) / mutated.size
    assert share[1:] == pytest.approx([0.158] * 3, abs=0.02)  # (1 - 1/e) / 4: places are drawn with replacement
