from __future__ import annotations

from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.genetic.shortest_path import shortest_path
from armctl.genetic.triple_cost import evaluate


@given(st.integers(0, 2**32 - 1), st.integers(3, 6), st.integers(1, 4))
@settings(deadline=None)
def test_no_chromosome_at_all_is_cheaper(seed: int, genes: int, choices: int) -> None:
    table = np.random.default_rng(seed).random((genes - 2, choices, choices, choices))
    every = np.array(list(product(range(choices), repeat=genes)))
    found = shortest_path(table)
    assert found.shape == (genes,)
    assert float(evaluate(table, found)) == pytest.approx(float(evaluate(table, every).min()), abs=1e-12)


def test_a_single_choice_leaves_a_single_path() -> None:
    assert shortest_path(np.ones((4, 1, 1, 1))).tolist() == [0] * 6
