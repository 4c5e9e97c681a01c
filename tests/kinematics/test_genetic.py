"""The published and the improved algorithm: laws, and the figures in short form; what the bits of a chromosome mean."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.errors import ConfigError
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.genetic import chromosomes, improved, plain
from armctl.kinematics.genetic import problem as problems
from armctl.kinematics.genetic.chromosomes import Coding, Streams, Words
from armctl.kinematics.genetic.problem import Evolution, Problem, points_problem
from armctl.kinematics.genetic.solve import POSITION_WEIGHT, solve
from armctl.kinematics.inverse import pose_errors
from armctl.kinematics.robots.papers import WANTED_XYZ_RPY
from armctl.kinematics.target import point_target, pose_target
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy

XIANG, PUMA = robots.get("xiang-6dof"), robots.get("puma560")
POINTS = np.array([[0.20, 0.25, 0.30], [0.30, 0.25, 0.20], [0.25, -0.22, 0.10], [-0.2, 0.1, 0.2]])
CODING = Coding(PUMA.limits_rad, 20, gray=True)
WANTED = pose_from_xyz_rpy(*WANTED_XYZ_RPY)
SHORT = replace(plain.PAPER, generations=40)
SHORT_IMPROVED = replace(
    improved.DEFAULT, generations=40, individuals=20, catastrophe_generations=4, migration_generations=5
)
ALGORITHMS: list[Any] = [(plain.evolve, SHORT), (improved.evolve, SHORT_IMPROVED)]


def points(targets: FloatArray = POINTS) -> Problem:
    return points_problem(XIANG.chain, targets, XIANG.limits_rad)


def poses(count: int) -> Problem:
    T = np.repeat(WANTED[None], count, axis=0)
    return problems.poses_problem(PUMA.chain, T, PUMA.limits_rad, POSITION_WEIGHT)


def test_the_published_settings_are_the_printed_ones() -> None:
    assert plain.Settings(95, 0.6, 0.01, 300, 16) == plain.PAPER


def test_error_of_a_pose_is_eq_4_and_of_a_point_the_squared_distance() -> None:
    q = np.random.default_rng(0).uniform(-3.0, 3.0, (2, 3, 6))
    gap = forward_kinematics(PUMA.chain, q) - WANTED
    expected = (gap[..., :3, :3] ** 2).sum(axis=(-2, -1)) + POSITION_WEIGHT * (gap[..., :3, 3] ** 2).sum(axis=-1)
    np.testing.assert_allclose(poses(2).cost(q), expected, rtol=1e-12)
    q = np.random.default_rng(1).uniform(-3.0, 3.0, (4, 3, 5))
    away = np.linalg.norm(tool_position(XIANG.chain, q) - POINTS[:, None], axis=-1)
    np.testing.assert_allclose(points().cost(q), away**2, rtol=1e-12)


def test_only_joints_that_move_the_tool_are_searched() -> None:
    assert problems.moving(XIANG.chain) == (0, 1, 2, 3)
    assert points().free == (0, 1, 2, 3)
    assert problems.behind_the_waist(points()).free == (1, 2, 3)
    held = points_problem(XIANG.chain, POINTS, XIANG.limits_rad, np.array([0.1, 0.2, 0.3, 0.4, 0.5]))
    assert (plain.evolve(held, SHORT, [0, 1, 2, 3]).q_rad[:, 4] == 0.5).all()


def test_the_waist_by_eq_12_faces_the_target() -> None:
    problem = problems.behind_the_waist(points())
    np.testing.assert_allclose(problem.base_rad[:, 0], np.arctan2(POINTS[:, 1], POINTS[:, 0]), atol=1e-12)
    found = tool_position(XIANG.chain, plain.evolve(problem, plain.PAPER, [0, 1, 2, 3]).q_rad)
    cross = found[:, 0] * POINTS[:, 1] - found[:, 1] * POINTS[:, 0]
    np.testing.assert_allclose(cross, 0.0, atol=1e-12)


@pytest.mark.parametrize(("evolve", "short"), ALGORITHMS)
def test_a_run_is_the_same_alone_and_among_others(evolve: Callable[..., Evolution], short: Any) -> None:
    many = evolve(points(), short, [[7, run] for run in range(4)])
    for run in range(4):
        alone = evolve(points(POINTS[run : run + 1]), short, [[7, run]])
        np.testing.assert_array_equal(many.q_rad[run], alone.q_rad[0])
        np.testing.assert_array_equal(many.mean_cost[:, run], alone.mean_cost[:, 0])


@pytest.mark.parametrize(("evolve", "short"), ALGORITHMS)
def test_the_best_is_what_it_is_said_to_be_and_never_gets_worse(evolve: Callable[..., Evolution], short: Any) -> None:
    problem = points()
    found = evolve(problem, short, [1, 2, 3, 4])
    np.testing.assert_array_equal(problem.cost(found.q_rad[:, None])[:, 0], found.cost)
    np.testing.assert_array_equal(found.best_cost[-1], found.cost)
    assert (np.diff(found.best_cost, axis=0) <= 0.0).all()
    assert (found.best_cost <= found.mean_cost).all()
    assert not np.array_equal(found.q_rad, evolve(problem, short, [5, 6, 7, 8]).q_rad)


@pytest.mark.parametrize(("evolve", "short"), ALGORITHMS)
def test_one_seed_a_target_is_asked_for(evolve: Callable[..., Evolution], short: Any) -> None:
    with pytest.raises(ValueError, match="1 seeds for 4 targets"):
        evolve(points(), short, [0])


def test_niches_hold_who_is_near_their_head_and_heads_are_the_best_left() -> None:
    words = chromosomes.random_words(CODING, Streams([0, 1]).uniform(30, 6))
    words[:, 10:20] = words[:, :1] ^ np.uint32(1)  # a crowd beside the first individual
    cost = np.random.default_rng(3).uniform(1.0, 2.0, (2, 30))
    cost[:, 0] = 0.5
    parted = improved.part(CODING, words, cost, improved.DEFAULT)
    radius = improved.DEFAULT.niche_radius * CODING.length
    for run in range(2):
        assert parted.heads[run, 0] == 0
        assert (parted.niche[run, 10:20] == 0).all()
        assert len(set(parted.heads[run].tolist())) == improved.DEFAULT.niches
        for one, head in enumerate(parted.heads[run]):
            members = np.flatnonzero(parted.niche[run] == one)
            assert cost[run, head] == cost[run, members].min()
            assert (chromosomes.hamming(words[run, members], words[run, head]) <= radius).all()
    shared = improved.shared_fitness(CODING, cost, parted, improved.DEFAULT)
    plain_fitness = plain.fitness(cost)
    assert (shared <= plain_fitness).all()
    for run in range(2):
        np.testing.assert_array_equal(shared[run, parted.heads[run]], plain_fitness[run, parted.heads[run]])


def test_a_copy_of_a_head_gives_up_more_fitness_than_a_distant_member() -> None:
    words = np.zeros((1, 4, 6), dtype=np.uint32)
    words[0, 2] = 1  # six bits away
    cost = np.array([[1.0, 1.0, 1.0, 4.0]])
    parted = improved.part(CODING, words, cost, replace(improved.DEFAULT, niches=1))
    settings = replace(improved.DEFAULT, niches=1, sharing=2.0)
    head, copy, distant, _ = improved.shared_fitness(CODING, cost, parted, settings)[0].tolist()
    assert head == distant == 1.0
    assert copy == pytest.approx(1.0 - 2.0 * 6.0 / 120.0)


def test_everybody_in_one_niche_leaves_the_best_as_every_head() -> None:
    words = np.zeros((1, 5, 6), dtype=np.uint32)
    cost = np.array([[3.0, 2.0, 1.0, 2.0, 3.0]])
    parted = improved.part(CODING, words, cost, improved.DEFAULT)
    assert parted.heads.tolist() == [[2, 2, 2, 2]]
    assert (parted.niche == 0).all()


def test_migration_takes_the_first_of_each_population_to_the_next_of_its_run() -> None:
    words = np.arange(4 * 3 * 1, dtype=np.uint32).reshape(4, 3, 1)  # two runs of two populations
    moved = improved.migrated(words, 2)
    np.testing.assert_array_equal(moved[:, :2], words[:, :2])
    assert moved[:, 2, 0].tolist() == [3, 0, 9, 6]


def test_a_catastrophe_brings_newcomers_and_keeps_the_best() -> None:
    calm = replace(SHORT_IMPROVED, catastrophe_generations=1000)
    struck = improved.evolve(poses(3), SHORT_IMPROVED, [0, 1, 2])
    assert struck.mean_cost[-1].mean() > improved.evolve(poses(3), calm, [0, 1, 2]).mean_cost[-1].mean()
    assert (np.diff(struck.best_cost, axis=0) <= 0.0).all()


def test_the_improved_algorithm_beats_the_standard_one_and_comes_below_a_millimetre() -> None:
    """Short form of `armctl reproduce 001`: 8 seeds of 50."""
    T = np.repeat(WANTED[None], 8, axis=0)
    standard = replace(plain.PAPER, population=improved.DEFAULT.populations * improved.DEFAULT.individuals)
    ours = pose_errors(PUMA.chain, improved.evolve(poses(8), improved.DEFAULT, range(8)).q_rad, T)
    theirs = pose_errors(PUMA.chain, plain.evolve(poses(8), standard, range(8)).q_rad, T)
    assert np.median(ours[0]) < 1e-3
    for better, worse in zip(ours, theirs, strict=True):
        for statistic in (np.median, np.mean, np.max, np.min, np.std):
            assert statistic(better) < statistic(worse)


@pytest.mark.parametrize("method", ["ga", "ga-improved"])
def test_solve_answers_as_the_other_methods_do(method: Any) -> None:
    found = solve(XIANG, point_target((0.2, 0.25, 0.3)), method=method, seed=3)
    assert (found.reachable, found.least_position_error_m) == (True, 0.0)
    assert found.solutions[0].position_error_m < 1e-9
    assert solve(XIANG, point_target((0.2, 0.25, 0.3)), method=method, seed=3) == found


def test_solve_without_polish_says_what_the_algorithm_missed() -> None:
    found = solve(PUMA, pose_target(WANTED), method="ga-improved", polish=False)
    assert (found.reachable, found.least_position_error_m) == (False, 0.0)
    assert 1e-6 < found.solutions[0].position_error_m < 1e-3
    assert solve(PUMA, pose_target(WANTED), method="ga-improved").solutions[0].position_error_m < 1e-9


def test_solve_tells_a_target_out_of_reach_with_the_exact_distance() -> None:
    found = solve(XIANG, point_target((0.3, 0.3, 0.1)), method="ga-improved")
    assert not found.reachable
    exact = float(np.hypot(np.hypot(0.3, 0.3), 0.001)) - 0.416
    assert found.least_position_error_m == pytest.approx(exact, abs=1e-12)
    assert found.solutions[0].position_error_m == pytest.approx(exact, abs=1e-4)


def test_an_elite_never_gets_worse_and_ranks_know_no_scale() -> None:
    problem = points_problem(XIANG.chain, POINTS, XIANG.limits_rad)
    seen: list[FloatArray] = []

    def judged(q: FloatArray) -> FloatArray:
        cost = Problem.cost(problem, q)
        seen.append(cost.min(axis=1))
        return cost

    watched = replace(problem)
    object.__setattr__(watched, "cost", judged)
    for selection in ("roulette", "rank"):
        seen.clear()
        plain.evolve(watched, replace(SHORT, elite=1, selection=selection), [1, 2, 3, 4])
        assert (np.diff(seen[: SHORT.generations], axis=0) <= 0.0).all()
    cost = np.array([[3.0, 1.0, 2.0, 1.0]])
    np.testing.assert_array_equal(plain.ranks(cost), [[1.0, 4.0, 2.0, 3.0]])
    np.testing.assert_array_equal(plain.ranks(cost * 1e6), plain.ranks(cost))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: plain.Settings(population=1), "population: 1 is outside 2 to"),
        (lambda: plain.Settings(elite=96), "elite: 96 is outside 0 to 95"),
        (lambda: plain.Settings(mutation_probability=1.5), "mutation_probability"),
        (lambda: improved.Settings(populations=0), "populations"),
        (lambda: improved.Settings(niches=61), "niches: 61 is outside 1 to 60"),
        (lambda: Coding(PUMA.limits_rad, 0), "bits: 0 is outside 1 to 32"),
        (lambda: Coding(PUMA.limits_rad, 33), "bits: 33 is outside 1 to 32"),
    ],
)
def test_settings_out_of_bounds_are_refused(change: Callable[[], object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        change()


# ---------------------------------------------------------------------------------------------------------- chromosomes


RANGES = np.array([[-np.pi, np.pi], [0.0, 1.0], [-2.0, -1.0]])
codings = st.builds(Coding, st.just(RANGES), st.integers(1, 32), st.booleans())


def population(coding: Coding, runs: int, individuals: int, seed: int) -> Words:
    streams = Streams([[seed, run] for run in range(runs)])
    return chromosomes.random_words(coding, streams.uniform(individuals, coding.joints))


def words_of(coding: Coding, angles: FloatArray) -> np.ndarray:
    """The chromosomes nearest to joint angles [rad] within the ranges, shape (..., joints)."""
    low, high = coding.ranges_rad.T
    value = np.rint((angles - low) / (high - low) * (2.0**coding.bits - 1.0)).astype(np.uint32)
    return np.asarray(value ^ (value >> np.uint32(1)) if coding.gray else value)


def bits_of(coding: Coding, words: Words) -> np.ndarray:
    """Every bit, the first joint's highest first, shape (..., length)."""
    shifts = np.arange(coding.bits - 1, -1, -1).astype(np.uint32)
    return ((words[..., None] >> shifts) & 1).reshape(*words.shape[:-1], coding.length)


@given(codings, st.integers(0, 1000))
@settings(max_examples=50)
def test_words_of_angles_of_words_are_the_words(coding: Coding, seed: int) -> None:
    words = population(coding, 2, 5, seed)
    angles = coding.angles(words)
    assert (angles >= RANGES[:, 0] - 1e-12).all()
    assert (angles <= RANGES[:, 1] + 1e-12).all()
    np.testing.assert_array_equal(words_of(coding, angles), words)


@given(st.integers(1, 10))
def test_neighbouring_angles_differ_in_one_bit_of_gray_code(bits: int) -> None:
    coding = Coding(RANGES[:1], bits, gray=True)
    step = 2.0 * np.pi / (2.0**bits - 1.0)
    words = words_of(coding, -np.pi + step * np.arange(2**bits)[:, None])
    np.testing.assert_array_equal(chromosomes.hamming(words[1:], words[:-1]), 1)


def test_the_ends_of_the_range_are_the_first_and_the_last_code() -> None:
    coding = Coding(RANGES, 16)
    np.testing.assert_array_equal(coding.angles(np.zeros(3, dtype=np.uint32)), RANGES[:, 0])
    np.testing.assert_allclose(coding.angles(np.full(3, 65535, dtype=np.uint32)), RANGES[:, 1], atol=1e-12)


@given(codings, st.integers(2, 7), st.integers(0, 1000), st.floats(0.0, 0.999))
@settings(max_examples=60)
def test_a_certain_crossover_swaps_everything_after_one_cut_and_without_a_chance_nobody_crosses(
    coding: Coding, individuals: int, seed: int, chance: float
) -> None:
    words = population(coding, 3, individuals, seed)
    pairs = individuals // 2
    drawn = np.full((3, pairs), chance)
    np.testing.assert_array_equal(chromosomes.cross(coding, words, drawn, drawn, 0.0), words)
    children = chromosomes.cross(coding, words, drawn, drawn, 1.0)
    place = 1 + int(chance * (coding.length - 1))
    expected = bits_of(coding, words)
    expected[:, : 2 * pairs, place:] = expected[:, np.arange(2 * pairs) ^ 1, place:]  # each has its partner's
    np.testing.assert_array_equal(bits_of(coding, children), expected)
    if individuals % 2:
        np.testing.assert_array_equal(children[:, -1], words[:, -1])


@given(codings, st.integers(0, 1000))
@settings(max_examples=40)
def test_mutation_flips_exactly_the_bits_drawn(coding: Coding, seed: int) -> None:
    words = population(coding, 2, 4, seed)
    size = 4 * coding.length
    drawn = np.random.default_rng(seed).integers(0, size, (2, 9))
    mutated = chromosomes.mutate(coding, words, (drawn + 0.5) / size)
    flipped = bits_of(coding, words ^ mutated).reshape(2, size)
    expected = np.array([np.bincount(places, minlength=size) for places in drawn])
    np.testing.assert_array_equal(flipped, expected % 2)
    assert chromosomes.draws(coding, 4, 0.01) == 4 + 2 * 2 + round(0.04 * coding.length)


def test_roulette_draws_in_proportion_and_never_what_has_no_fitness() -> None:
    fitness = np.array([[0.0, 3.0, 1.0, 0.0], [1.0, 0.0, 0.0, 0.0]])
    drawn = chromosomes.roulette(fitness, Streams([0, 1]).uniform(8000))
    assert set(drawn[0]) == {1, 2}
    assert abs((drawn[0] == 1).mean() - 0.75) < 0.02
    assert set(drawn[1]) == {0}
    assert chromosomes.roulette(fitness, np.full((2, 1), np.nextafter(1.0, 0.0))).tolist() == [[2], [0]]


def test_a_stream_is_the_same_alone_and_among_others() -> None:
    many, alone = Streams([[0, run] for run in range(5)]), Streams([[0, 3]])
    np.testing.assert_array_equal(many.uniform(4, 2)[3], alone.uniform(4, 2)[0])
    np.testing.assert_array_equal(many.uniform(7, runs=np.array([1, 3]))[1], alone.uniform(7)[0])
