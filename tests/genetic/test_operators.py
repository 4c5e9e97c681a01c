from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.genetic.operators import elite, fitness_from_cost, mutate, one_cut_crossover, optimal_crossover, roulette
from armctl.genetic.triple_cost import evaluate

seeds = st.integers(0, 2**32 - 1)


def test_fitness_is_1_for_the_best_and_halves_for_twice_the_cost() -> None:
    assert fitness_from_cost(np.array([4.0, 2.0, 8.0])).tolist() == [0.5, 1.0, 0.25]


def test_a_perfect_individual_leaves_no_fitness_to_the_others() -> None:
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


@given(seeds, st.integers(3, 7), st.integers(2, 4))
def test_optimal_crossover_makes_the_cheapest_mixture_of_both_parents(seed: int, genes: int, choices: int) -> None:
    rng = np.random.default_rng(seed)
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
