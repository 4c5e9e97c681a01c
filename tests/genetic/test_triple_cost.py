import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.genetic.triple_cost import evaluate

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
