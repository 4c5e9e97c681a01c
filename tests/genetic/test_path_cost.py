"""Tables of triple costs, what of a path they sum up, and the cheapest chromosome that they allow."""

from itertools import product

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from numpy.random import Generator

from armctl.genetic.alignment import Candidates
from armctl.genetic.path_cost import PathCost, path_cost
from armctl.genetic.shortest_path import shortest_path, window_search
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.transform import FloatArray, IntArray
from tests.kinematics.conftest import rngs, seeds

SPEED, ACCELERATION = np.array([1.0, 2.0]), np.array([8.0, 10.0])


def made(rng: Generator, R: int, m: int, spread: float) -> tuple[PathCost, FloatArray, FloatArray, FloatArray]:
    q = spread * rng.standard_normal((R, m, 3)) + np.linspace(0.0, 1.0, m)[None, :, None]
    distance = rng.uniform(0.0, 0.01, (R, m))
    progress = np.linspace(0.0, 1.0, m) + 0.3 / m * rng.standard_normal((R, m))
    time_s = np.cumsum(rng.uniform(0.3, 0.6, m))
    candidates = Candidates(np.linspace(0.0, 1.0, m), q, np.zeros((R, m, 3)), np.zeros((R, 2), dtype=np.intp))
    return path_cost(candidates, distance, time_s, SPEED, ACCELERATION, progress), q, progress, time_s


def breaks_by_hand(genes: IntArray, q: FloatArray, progress: FloatArray, time_s: FloatArray) -> float:
    path = q[genes, np.arange(len(genes)), :2]
    dt = np.diff(time_s)
    speed = np.diff(path, axis=0) / dt[:, None]
    acceleration = np.diff(speed, axis=0) / ((dt[1:] + dt[:-1]) / 2.0)[:, None]
    back = -np.diff(progress[genes, np.arange(len(genes))]) * (len(genes) - 1)
    excess = [*(np.abs(speed) / SPEED).max(axis=1) - 1, *(np.abs(acceleration) / ACCELERATION).max(axis=1) - 1, *back]
    return float(sum(1.0 + value for value in excess if value > 1e-9))


@given(rngs, st.integers(1, 4), st.integers(3, 7), st.sampled_from([0.01, 0.1, 1.0]))
def test_tables_sum_to_mean_distance_and_charges(rng: Generator, R: int, m: int, spread: float) -> None:
    costs, q, progress, time_s = made(rng, R, m, spread)
    for genes in rng.integers(0, R, (5, m)):
        mean = float(costs.distance_m[np.arange(m), genes].mean())
        breaks = breaks_by_hand(genes, q, progress, time_s)
        assert float(evaluate(costs.straight_m, genes)) == pytest.approx(mean, abs=1e-12)
        assert float(evaluate(costs.breaks, genes)) == pytest.approx(breaks, rel=1e-9, abs=1e-12)
        for share in (0.1, 1.0):
            expected = mean + share * costs.charge_m * breaks
            assert float(evaluate(costs.table(share), genes)) == pytest.approx(expected, rel=1e-9)


@given(rngs)
def test_a_path_that_keeps_the_limits_beats_every_path_that_does_not(rng: Generator) -> None:
    costs, *_ = made(rng, 3, 5, 0.1)
    every = np.stack(np.meshgrid(*[np.arange(3)] * 5), axis=-1).reshape(-1, 5)
    kept = evaluate(costs.breaks, every) == 0.0
    cost = evaluate(costs.table(), every)
    if kept.any() and not kept.all():
        assert cost[kept].max() < cost[~kept].min()


def test_joints_beyond_the_limits_given_do_not_count() -> None:
    q = np.zeros((1, 5, 3))
    q[0, :, 2] = [0.0, 9.0, 0.0, 9.0, 0.0]
    candidates = Candidates(np.linspace(0, 1, 5), q, np.zeros((1, 5, 3)), np.zeros((1, 2), dtype=np.intp))
    costs = path_cost(candidates, np.zeros((1, 5)), np.arange(5.0), SPEED, ACCELERATION, np.linspace(0, 1, 5)[None])
    assert not costs.breaks.any()


# ---------------------------------------------------------------------------------------------- the cheapest chromosome


@given(seeds, st.integers(3, 6), st.integers(1, 4))
@example(0, 6, 1)
def test_no_chromosome_at_all_is_cheaper(seed: int, genes: int, choices: int) -> None:
    table = np.random.default_rng(seed).random((genes - 2, choices, choices, choices))
    every = np.array(list(product(range(choices), repeat=genes)))
    found = shortest_path(table)
    assert found.shape == (genes,)
    assert float(evaluate(table, found)) == pytest.approx(float(evaluate(table, every).min()), abs=1e-12)


@given(rngs, st.integers(3, 7), st.integers(1, 3), st.integers(0, 6), st.integers(1, 4))
def test_a_window_is_the_best_of_all_while_every_other_gene_stays(
    rng: Generator, genes: int, choices: int, begin: int, length: int
) -> None:
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


@given(rngs, st.integers(3, 8), st.integers(1, 4))
def test_cost_is_the_sum_over_triples(rng: Generator, genes: int, choices: int) -> None:
    table = rng.random((genes - 2, choices, choices, choices))
    chromosomes = rng.integers(0, choices, (5, genes))
    for chromosome, cost in zip(chromosomes, evaluate(table, chromosomes), strict=True):
        by_hand = sum(table[k, *chromosome[k : k + 3]] for k in range(genes - 2))
        assert cost == pytest.approx(by_hand)
        assert evaluate(table, chromosome) == cost
