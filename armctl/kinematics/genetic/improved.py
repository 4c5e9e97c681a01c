"""The improved genetic algorithm for the PUMA 560: niches, sharing, catastrophe and migration over several populations.

1. Every population is parted into niches by the Hamming distance of the chromosomes (eq. 8): the best individual is
   the head of the first, whoever is near it belongs there; the best of the others heads the next.
2. Individuals near the head of their niche give up fitness (eqs. 9, 10), so that a niche does not fill with copies.
3. Roulette, one-cut crossover and flipped bits as in the standard algorithm; the heads survive as they are.
4. Migration: now and then the best of every population visits the next one.
5. Catastrophe: a population whose best no longer improves is replaced by random individuals; its best stays.

The paper's text is half unreadable and prints no settings. Chosen here, by trials on its pose and on random ones: all
of `Settings`; Gray code, without which the bit strings of neighbouring angles may differ in every bit, and no niche
holds together; the objective of eq. (9) as least error / own error, since fitness must fall with the error of eq.
(4); eq. (10) read as fitness_i - (h_max - h_i) / a with h_i the distance to the head, h_max the largest in the niche,
and a = bits of a chromosome / `sharing`.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from armctl.kinematics.genetic import chromosomes
from armctl.kinematics.genetic.chromosomes import Coding, Streams, Words, check_settings
from armctl.kinematics.genetic.plain import fitness
from armctl.kinematics.genetic.problem import Course, Evolution, Problem
from armctl.kinematics.transform import FloatArray, IntArray


@dataclass(frozen=True)
class Settings:
    """What shapes a run."""

    populations: int = 4
    # In each population.
    individuals: int = 60
    generations: int = 300
    crossover_probability: float = 0.6
    # Share of all bits that flip in a generation.
    mutation_probability: float = 0.015
    bits: int = 20
    niches: int = 4
    # Hamming distance that still belongs to a niche, as a share of all bits.
    niche_radius: float = 0.15
    # The best has fitness 1. A copy of a head gives up this much beside the most distant member of the niche.
    sharing: float = 1.0
    migration_generations: int = 20
    # Generations without progress after which a population dies out.
    catastrophe_generations: int = 40
    # Share by which the least error must fall to count as progress.
    progress: float = 1e-3

    def __post_init__(self) -> None:
        check_settings(self, niches=(1, self.individuals))


DEFAULT = Settings()


class Niches(NamedTuple):
    """How populations are parted; k niches each."""

    # Index of each niche's best individual, shape (populations, k).
    heads: IntArray
    # Niche of each individual, -1 for none, shape (populations, individuals).
    niche: IntArray
    # Bits in which it differs from its head, shape as `niche`.
    distance: IntArray


def evolve(problem: Problem, settings: Settings, seeds: Sequence[int | Sequence[int]]) -> Evolution:
    """One run a target, each with its own seed.

    Raises:
        ValueError: other than one seed a target.
    """
    coding = Coding(problem.limits_rad[list(problem.free)], settings.bits, gray=True)
    streams, runs, course = Streams(seeds), len(seeds), Course(problem, coding, len(seeds))
    own, size, joints = settings.populations, settings.individuals, coding.joints
    words = chromosomes.random_words(coding, streams.uniform(own, size, joints)).reshape(-1, size, joints)
    record, stalled = np.full(runs * own, np.inf), np.zeros(runs * own, dtype=np.int64)
    for generation in range(1, settings.generations + 1):
        cost = course.judged(words.reshape(runs, -1, joints)).reshape(-1, size)
        least = cost.min(axis=1)
        stalled = np.where(least < record * (1.0 - settings.progress), 0, stalled + 1)
        record = np.minimum(least, record)
        words = _next(coding, words, cost, settings, streams)
        if generation % settings.migration_generations == 0:
            words = migrated(words, own)
        dead = stalled >= settings.catastrophe_generations
        if dead.any():
            # Only runs with a dead population draw, so that a run gives the same bits alone and among others.
            hit = np.flatnonzero(dead.reshape(runs, own).any(axis=1))
            fresh = np.zeros((runs, own, size, joints), dtype=words.dtype)
            fresh[hit] = chromosomes.random_words(coding, streams.uniform(own, size, joints, runs=hit))
            words[dead, 1:] = fresh.reshape(words.shape)[dead, 1:]
            record[dead], stalled[dead] = np.inf, 0
    return course.evolution()


def _next(coding: Coding, words: Words, cost: FloatArray, settings: Settings, streams: Streams) -> Words:
    """The next generation of every population; the niches' heads come first, the best of all before them."""
    parted = part(coding, words, cost, settings)
    heads = words[np.arange(len(words))[:, None], parted.heads]
    draws = chromosomes.draws(coding, words.shape[1], settings.mutation_probability)
    chance = streams.uniform(settings.populations, draws).reshape(len(words), -1)
    shared = shared_fitness(coding, cost, parted, settings)
    words = chromosomes.offspring(coding, words, shared, chance, settings.crossover_probability)
    words[:, : settings.niches] = heads
    return words


def part(coding: Coding, words: Words, cost: FloatArray, settings: Settings) -> Niches:
    """Niches of populations of chromosomes, shape (populations, individuals, joints), with their errors."""
    every = np.arange(len(words))
    heads = np.zeros((len(words), settings.niches), dtype=np.int64)
    niche, distance = np.full(cost.shape, -1), np.zeros(cost.shape, dtype=np.int64)
    left = cost.copy()
    for index in range(settings.niches):
        # Where no individual is left, the best of all heads this niche too, and it has no members.
        head = np.where(np.isfinite(left).any(axis=1), left.argmin(axis=1), heads[:, 0])
        heads[:, index] = head
        away = chromosomes.hamming(words, words[every, head][:, None])  # (eq. 8)
        mine = (away <= settings.niche_radius * coding.length) & (niche < 0)
        niche[mine], distance[mine], left[mine] = index, away[mine], np.inf
    return Niches(heads, niche, distance)


def shared_fitness(coding: Coding, cost: FloatArray, parted: Niches, settings: Settings) -> FloatArray:
    """Fitness after sharing, shape (populations, individuals); that of the heads stays as it was."""
    plain = fitness(cost)  # (eq. 9), up to the sum that the roulette divides by
    shared = plain.copy()
    for index in range(settings.niches):
        mine = parted.niche == index
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
