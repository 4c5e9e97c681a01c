"""Tables of triple costs, and the cheapest chromosome that they allow."""

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from armctl.genetic.shortest_path import shortest_path, window_search
from armctl.genetic.triple_cost import evaluate


@given(st.integers(0, 2**32 - 1), st.integers(3, 6), st.integers(1, 4))
@example(0, 6, 1)
def test_no_chromosome_at_all_is_cheaper(seed: int, genes: int, choices: int) -> None:
    table = np.random.default_rng(seed).random((genes - 2, choices, choices, choices))
    every = np.array(list(product(range(choices), repeat=genes)))
    found = shortest_path(table)
    assert found.shape == (genes,)
    assert float(evaluate(table, found)) == pytest.approx(float(evaluate(table, every).min()), abs=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(3, 7), st.integers(1, 3), st.integers(0, 6), st.integers(1, 4))
def test_a_window_is_the_best_of_all_while_every_other_gene_stays(
    seed: int, genes: int, choices: int, begin: int, length: int
) -> None:
    rng = np.random.default_rng(seed)
    table = rng.random((genes - 2, choices, choices, choices))
    chromosome = rng.integers(0, choices, genes)
    before, begin = chromosome.copy(), min(begin, genes - 1)
    found = window_search(table, chromosome, begin, length)
    window = slice(begin, min(begin + length, genes))
    every = np.repeat(chromosome[None], choices ** (window.stop - begin), axis=0)
    every[:, window] = list(product(range(choices), repeat=window.stop - begin))
    assert (chromosome == before).all()
    assert (np.delete(found, np.r_[window]) == np.delete(chromosome, np.r_[window])).all()
    assert float(evaluate(table, found)) == pytest.approx(float(evaluate(table, every).min()), abs=1e-12)


@given(st.integers(0, 2**32 - 1), st.integers(3, 8), st.integers(1, 4))
def test_cost_is_the_sum_over_triples(seed: int, genes: int, choices: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.random((genes - 2, choices, choices, choices))
    chromosomes = rng.integers(0, choices, (5, genes))
    for chromosome, cost in zip(chromosomes, evaluate(table, chromosomes), strict=True):
        by_hand = sum(table[k, *chromosome[k : k + 3]] for k in range(genes - 2))
        assert cost == pytest.approx(by_hand)
        assert evaluate(table, chromosome) == cost
