"""The improved genetic algorithm for the PUMA 560: niches, sharing, catastrophe and migration over several populations.

1. Every population is parted into niches by the Hamming distance of the chromosomes (eq. 8): the best individual is
   the head of the first, whoever is near it belongs there; the best of the others heads the next.
2. Individuals near the head of their niche give up fitness (eqs. 9, 10), so that a niche does not fill with copies.
3. Roulette, one-cut crossover and flipped bits as in the standard algorithm; the heads survive as they are.
4. Migration: now and then the best of every population visits the next one.
5. Catastrophe: a population whose best no longer improves dies out but for that one; newcomers are random.

The paper's text is half unreadable and prints no settings. Chosen here, by trials on its pose and on random ones: all
of `Settings`; Gray code, without which the bit strings of neighbouring angles may differ everywhere and no niche is
one; the objective of eq. (9) as least error / own error, since fitness must fall with the error of eq. (4); eq. (10)
read as fitness_i - (h_max - h_i) / a with h_i the distance to the head, h_max the largest in the niche, and
a = bits of a chromosome / `sharing`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.genetic import chromosomes
from armctl.kinematics.genetic.chromosomes import Coding, Streams, Words
from armctl.kinematics.genetic.plain import fitness
from armctl.kinematics.genetic.problem import Evolution, Problem
from armctl.kinematics.transform import FloatArray, IntArray


@dataclass(frozen=True)
class Settings:
    """What shapes a run."""

    populations: int = 4
    individuals: int = 60
    """Of one population."""
    generations: int = 300
    crossover_probability: float = 0.6
    mutation_probability: float = 0.015
    """Share of all bits that flip in a generation."""
    bits: int = 20
    niches: int = 4
    niche_radius: float = 0.15
    """Hamming distance that still belongs to a niche, as a share of all bits."""
    sharing: float = 1.0
    """Fitness, of 1 for the best, that a copy of a head would give up beside the most distant member."""
    migration_generations: int = 20
    catastrophe_generations: int = 40
    """Generations without progress after which a population dies out."""
    progress: float = 1e-3
    """Share by which the least error must fall to count as progress."""

    def __post_init__(self) -> None:
        for name, low, high in (
            ("populations", 1, 1000),
            ("individuals", 2, 100_000),
            ("generations", 1, 1_000_000),
            ("niches", 1, self.individuals),
            ("migration_generations", 1, 1_000_000),
            ("catastrophe_generations", 1, 1_000_000),
            ("crossover_probability", 0, 1),
            ("mutation_probability", 0, 1),
            ("niche_radius", 0, 1),
            ("sharing", 0, 1000),
            ("progress", 0, 1),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError("genetic algorithm", name, f"{getattr(self, name)} is outside {low} to {high}")


DEFAULT = Settings()


@dataclass(frozen=True, eq=False)
class Niches:
    """How populations are parted; k niches each."""

    heads: IntArray
    """Index of each niche's best individual, shape (populations, k)."""
    niche: IntArray
    """Niche of each individual, -1 for none, shape (populations, individuals)."""
    distance: IntArray
    """Bits in which it differs from its head, shape as `niche`."""


def evolve(problem: Problem, settings: Settings, seeds: Sequence[int | Sequence[int]]) -> Evolution:
    """One run a target, each with its own seed.

    Raises:
        ValueError: other than one seed a target.
    """
    if len(seeds) != len(problem.T):
        raise ValueError(f"{len(seeds)} seeds for {len(problem.T)} targets")
    coding = Coding(problem.limits_rad[list(problem.free)], settings.bits, gray=True)
    streams, runs = Streams(seeds), len(seeds)
    own, size, joints = settings.populations, settings.individuals, coding.joints
    rows, every = np.arange(runs), np.arange(runs * own)
    words = chromosomes.random_words(coding, streams.uniform(own, size, joints)).reshape(-1, size, joints)
    best, best_cost = words[::own, 0], np.full(runs, np.inf)
    record, stalled = np.full(len(every), np.inf), np.zeros(len(every), dtype=np.int64)
    best_curve, mean_curve = np.empty((2, settings.generations, runs))
    for generation in range(settings.generations):
        q = problem.configurations(coding.angles(words.reshape(runs, -1, joints)))
        cost = problem.cost(q).reshape(-1, size)
        first = cost.argmin(axis=1)
        least = cost[every, first]
        leader = rows * own + least.reshape(runs, own).argmin(axis=1)
        best = np.where((least[leader] < best_cost)[:, None], words[leader, first[leader]], best)
        best_cost = np.minimum(least[leader], best_cost)
        best_curve[generation], mean_curve[generation] = best_cost, cost.reshape(runs, -1).mean(axis=1)
        stalled = np.where(least < record * (1.0 - settings.progress), 0, stalled + 1)
        record = np.minimum(least, record)
        words = _next(coding, words, cost, settings, streams)
        if (generation + 1) % settings.migration_generations == 0:
            words = migrated(words, own)
        dead = stalled >= settings.catastrophe_generations
        if dead.any():
            struck = np.flatnonzero(dead.reshape(runs, own).any(axis=1))
            fresh = np.zeros((runs, own, size, joints), dtype=words.dtype)
            fresh[struck] = chromosomes.random_words(coding, streams.uniform(own, size, joints, runs=struck))
            words[dead, 1:] = fresh.reshape(words.shape)[dead, 1:]
            record[dead], stalled[dead] = np.inf, 0
    q = problem.configurations(coding.angles(best[:, None]))[:, 0]
    return Evolution(q, best_cost, best_curve, mean_curve, own * size * settings.generations)


def _next(coding: Coding, words: Words, cost: FloatArray, settings: Settings, streams: Streams) -> Words:
    """The next generation of every population; the niches' heads come first, the best of all before them."""
    size, every = words.shape[1], np.arange(len(words))[:, None]
    pairs, flips = size // 2, chromosomes.flips(coding, size, settings.mutation_probability)
    parted = part(coding, words, cost, settings)
    chance = streams.uniform(settings.populations, size + 2 * pairs + flips).reshape(len(words), -1)
    drawn, crossing, cut, place = np.split(chance, np.cumsum([size, pairs, pairs]), axis=1)
    heads = words[every, parted.heads]
    words = words[every, chromosomes.roulette(shared_fitness(coding, cost, parted, settings), drawn)]
    words = chromosomes.cross(coding, words, crossing, cut, settings.crossover_probability)
    words = chromosomes.mutate(coding, words, place)
    words[:, : settings.niches] = heads
    return words


def part(coding: Coding, words: Words, cost: FloatArray, settings: Settings) -> Niches:
    """Niches of populations of chromosomes, shape (populations, individuals, joints), with their errors."""
    every = np.arange(len(words))
    heads = np.zeros((len(words), settings.niches), dtype=np.int64)
    niche, distance = np.full(cost.shape, -1), np.zeros(cost.shape, dtype=np.int64)
    left = cost.copy()
    for one in range(settings.niches):
        # Where nobody is left the best of all heads this niche too, and nobody follows.
        head = np.where(np.isfinite(left).any(axis=1), left.argmin(axis=1), heads[:, 0])
        heads[:, one] = head
        away = chromosomes.hamming(words, words[every, head][:, None])  # (eq. 8)
        mine = (away <= settings.niche_radius * coding.length) & (niche < 0)
        niche[mine], distance[mine], left[mine] = one, away[mine], np.inf
    return Niches(heads, niche, distance)


def shared_fitness(coding: Coding, cost: FloatArray, parted: Niches, settings: Settings) -> FloatArray:
    """Fitness after sharing, shape (populations, individuals); that of the heads stays as it was."""
    plain = fitness(cost)  # (eq. 9), up to the sum that the roulette divides by
    shared = plain.copy()
    for one in range(settings.niches):
        mine = parted.niche == one
        furthest = np.where(mine, parted.distance, 0).max(axis=1, keepdims=True)
        given_up = settings.sharing * (furthest - parted.distance) / coding.length
        shared = np.where(mine, np.maximum(plain - given_up, 0.0), shared)  # (eq. 10)
    every = np.arange(len(cost))[:, None]
    shared[every, parted.heads] = plain[every, parted.heads]
    return shared


def migrated(words: Words, populations: int) -> Words:
    """The first individual of each population takes the last place in the next of its run, round in a ring."""
    moved = words.copy()
    ring = moved.reshape(-1, populations, *words.shape[1:])
    ring[:, :, -1] = np.roll(ring[:, :, 0], 1, axis=1)
    return moved
