"""The genetic algorithm of Xiang Yao et al.: binary chromosomes, roulette, one cut, flipped bits, 300 generations.

The whole population is replaced in every generation; the best individual ever seen is the answer. Printed are the
population 95, the crossover probability 0.6, the mutation probability 0.01 and the 300 generations. Not printed, and
chosen here: 16 bits a joint in plain binary, and fitness = least distance of the generation / own distance, which
makes a roulette of an error to be minimised and knows no unit. Of four mappings tried on the paper's grid (its square,
the greatest error - own error, ranks) it came nearest to the targets.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.genetic import chromosomes
from armctl.kinematics.genetic.chromosomes import Coding, Streams
from armctl.kinematics.genetic.problem import Evolution, Problem
from armctl.kinematics.transform import FloatArray


@dataclass(frozen=True)
class Settings:
    """What shapes a run."""

    population: int = 95
    crossover_probability: float = 0.6
    mutation_probability: float = 0.01
    """Share of all bits of the population that flip in a generation."""
    generations: int = 300
    bits: int = 16

    def __post_init__(self) -> None:
        for name, low, high in (
            ("population", 2, 100_000),
            ("generations", 1, 1_000_000),
            ("crossover_probability", 0, 1),
            ("mutation_probability", 0, 1),
        ):
            if not low <= getattr(self, name) <= high:
                raise ConfigError("genetic algorithm", name, f"{getattr(self, name)} is outside {low} to {high}")


PAPER = Settings()


def evolve(problem: Problem, settings: Settings, seeds: Sequence[int | Sequence[int]]) -> Evolution:
    """One run a target, each with its own seed.

    Raises:
        ValueError: other than one seed a target.
    """
    if len(seeds) != len(problem.T):
        raise ValueError(f"{len(seeds)} seeds for {len(problem.T)} targets")
    coding = Coding(problem.limits_rad[list(problem.free)], settings.bits)
    streams, runs, size = Streams(seeds), np.arange(len(seeds)), settings.population
    pairs, flips = size // 2, chromosomes.flips(coding, size, settings.mutation_probability)
    words = chromosomes.random_words(coding, streams.uniform(size, coding.joints))
    best, best_cost = words[:, 0], np.full(len(runs), np.inf)
    best_curve, mean_curve = np.empty((2, settings.generations, len(runs)))
    for generation in range(settings.generations):
        cost = problem.cost(problem.configurations(coding.angles(words)))
        first = cost.argmin(axis=1)
        least = cost[runs, first]
        best = np.where((least < best_cost)[:, None], words[runs, first], best)
        best_cost = np.minimum(least, best_cost)
        best_curve[generation], mean_curve[generation] = best_cost, cost.mean(axis=1)
        chance = streams.uniform(size + 2 * pairs + flips)
        drawn, crossing, cut, place = np.split(chance, np.cumsum([size, pairs, pairs]), axis=1)
        words = words[runs[:, None], chromosomes.roulette(fitness(cost), drawn)]
        words = chromosomes.cross(coding, words, crossing, cut, settings.crossover_probability)
        words = chromosomes.mutate(coding, words, place)
    q = problem.configurations(coding.angles(best[:, None]))[:, 0]
    return Evolution(q, best_cost, best_curve, mean_curve, size * settings.generations)


def fitness(cost: FloatArray) -> FloatArray:
    """Least distance / own distance in every run, within (0, 1]; of squared errors, shape (runs, individuals)."""
    least = cost.min(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.where(cost <= least, 1.0, least / np.where(cost <= least, 1.0, cost))))
