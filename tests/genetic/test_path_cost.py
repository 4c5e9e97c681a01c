import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.genetic.alignment import Candidates
from armctl.genetic.path_cost import PathCost, path_cost
from armctl.genetic.triple_cost import evaluate
from armctl.kinematics.transform import FloatArray, IntArray

SPEED, ACCELERATION = np.array([1.0, 2.0]), np.array([8.0, 10.0])


def made(
    rng: np.random.Generator, R: int, m: int, spread: float
) -> tuple[PathCost, FloatArray, FloatArray, FloatArray]:
    q = spread * rng.standard_normal((R, m, 3)) + np.linspace(0.0, 1.0, m)[None, :, None]
    distance = rng.uniform(0.0, 0.01, (R, m))
    progress = np.linspace(0.0, 1.0, m) + 0.3 / m * rng.standard_normal((R, m))
    time_s = np.cumsum(rng.uniform(0.3, 0.6, m))
    candidates = Candidates(np.linspace(0.0, 1.0, m), q, np.zeros((R, m, 3)))
    return path_cost(candidates, distance, time_s, SPEED, ACCELERATION, progress), q, progress, time_s


def breaks_by_hand(genes: IntArray, q: FloatArray, progress: FloatArray, time_s: FloatArray) -> float:
    path = q[genes, np.arange(len(genes)), :2]
    dt = np.diff(time_s)
    speed = np.diff(path, axis=0) / dt[:, None]
    acceleration = np.diff(speed, axis=0) / ((dt[1:] + dt[:-1]) / 2.0)[:, None]
    back = -np.diff(progress[genes, np.arange(len(genes))]) * (len(genes) - 1)
    excess = [*(np.abs(speed) / SPEED).max(axis=1) - 1, *(np.abs(acceleration) / ACCELERATION).max(axis=1) - 1, *back]
    return float(sum(1.0 + value for value in excess if value > 1e-9))


@given(st.integers(0, 2**32 - 1), st.integers(1, 4), st.integers(3, 7), st.sampled_from([0.01, 0.1, 1.0]))
def test_tables_sum_to_mean_distance_and_charges(seed: int, R: int, m: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    costs, q, progress, time_s = made(rng, R, m, spread)
    for genes in rng.integers(0, R, (5, m)):
        mean = float(costs.distance_m[np.arange(m), genes].mean())
        breaks = breaks_by_hand(genes, q, progress, time_s)
        assert float(evaluate(costs.straight_m, genes)) == pytest.approx(mean, abs=1e-12)
        assert float(evaluate(costs.breaks, genes)) == pytest.approx(breaks, rel=1e-9, abs=1e-12)
        for share in (0.1, 1.0):
            expected = mean + share * costs.charge_m * breaks
            assert float(evaluate(costs.table(share), genes)) == pytest.approx(expected, rel=1e-9)


@given(st.integers(0, 2**32 - 1))
def test_a_path_that_keeps_the_limits_beats_every_path_that_does_not(seed: int) -> None:
    costs, *_ = made(np.random.default_rng(seed), 3, 5, 0.1)
    every = np.stack(np.meshgrid(*[np.arange(3)] * 5), axis=-1).reshape(-1, 5)
    kept = evaluate(costs.breaks, every) == 0.0
    cost = evaluate(costs.table(), every)
    if kept.any() and not kept.all():
        assert cost[kept].max() < cost[~kept].min()


def test_joints_beyond_the_limits_given_do_not_count() -> None:
    q = np.zeros((1, 5, 3))
    q[0, :, 2] = [0.0, 9.0, 0.0, 9.0, 0.0]
    candidates = Candidates(np.linspace(0, 1, 5), q, np.zeros((1, 5, 3)))
    costs = path_cost(candidates, np.zeros((1, 5)), np.arange(5.0), SPEED, ACCELERATION, np.linspace(0, 1, 5)[None])
    assert not costs.breaks.any()
