from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.genetic.triple_cost import cut_costs, evaluate

seeds = st.integers(0, 2**32 - 1)


@given(seeds, st.integers(3, 8), st.integers(1, 4))
@settings(deadline=None)
def test_cost_is_the_sum_over_triples(seed: int, genes: int, choices: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.random((genes - 2, choices, choices, choices))
    chromosomes = rng.integers(0, choices, (5, genes))
    for chromosome, cost in zip(chromosomes, evaluate(table, chromosomes), strict=True):
        by_hand = sum(table[k, *chromosome[k : k + 3]] for k in range(genes - 2))
        assert cost == pytest.approx(by_hand)
        assert evaluate(table, chromosome) == cost


@given(seeds, st.integers(3, 8), st.integers(1, 4))
@settings(deadline=None)
def test_cut_costs_are_the_costs_of_the_joined_chromosomes(seed: int, genes: int, choices: int) -> None:
    rng = np.random.default_rng(seed)
    table = rng.random((genes - 2, choices, choices, choices))
    first, second = rng.integers(0, choices, (2, 6, genes))
    costs = cut_costs(table, first, second)
    assert costs.shape == (6, genes + 1)
    for cut in range(genes + 1):
        joined = np.concatenate([first[:, :cut], second[:, cut:]], axis=1)
        np.testing.assert_allclose(costs[:, cut], evaluate(table, joined), atol=1e-12)
