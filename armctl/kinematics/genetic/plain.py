"""The genetic algorithm of Xiang Yao et al.: binary chromosomes, roulette, one cut, flipped bits, 300 generations.

The whole population is replaced in every generation; the best individual ever seen is the answer. Printed are the
population 95, the crossover probability 0.6, the mutation probability 0.01 and the 300 generations. Not printed, and
chosen here: 16 bits a joint in plain binary, and fitness = least distance of the generation / own distance, which
makes a roulette of an error to be minimised and knows no unit. Of four mappings tried on the paper's grid (its square,
the greatest error - own error, ranks) it came nearest to the targets.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np

from armctl.kinematics.genetic import chromosomes
from armctl.kinematics.genetic.chromosomes import Coding, Streams, check_settings
from armctl.kinematics.genetic.problem import Course, Evolution, Problem
from armctl.kinematics.transform import FloatArray

Selection = Literal["roulette", "rank"]


@dataclass(frozen=True)
class Settings:
    """What shapes a run."""

    population: int = 95
    crossover_probability: float = 0.6
    # Share of all bits of the population that flip in a generation.
    mutation_probability: float = 0.01
    generations: int = 300
    bits: int = 16
    # Chances in proportion to the least error / own error, or to the rank from the worst up.
    selection: Selection = "roulette"
    # The best individuals go on as they are.
    elite: int = 0

    def __post_init__(self) -> None:
        check_settings(self, elite=(0, self.population))


PAPER = Settings()


def evolve(problem: Problem, settings: Settings, seeds: Sequence[int | Sequence[int]]) -> Evolution:
    """One run a target, each with its own seed.

    Raises:
        ValueError: other than one seed a target.
    """
    coding = Coding(problem.limits_rad[list(problem.free)], settings.bits)
    size, streams, course = settings.population, Streams(seeds), Course(problem, coding, len(seeds))
    words = chromosomes.random_words(coding, streams.uniform(size, coding.joints))
    draws = chromosomes.draws(coding, size, settings.mutation_probability)
    every = np.arange(len(seeds))[:, None]
    for _ in range(settings.generations):
        cost = course.judged(words)
        best = words[every, cost.argsort(axis=1)[:, : settings.elite]]
        worth = fitness(cost) if settings.selection == "roulette" else ranks(cost)
        words = chromosomes.offspring(coding, words, worth, streams.uniform(draws), settings.crossover_probability)
        words[:, : settings.elite] = best
    return course.evolution()


def ranks(cost: FloatArray) -> FloatArray:
    """How many individuals of its run each one is not worse than, itself included, shape (runs, individuals)."""
    return np.asarray(cost.shape[1] - cost.argsort(axis=1, kind="stable").argsort(axis=1), dtype=np.float64)


def fitness(cost: FloatArray) -> FloatArray:
    """Least distance / own distance in every run, within (0, 1]; of squared errors, shape (runs, individuals)."""
    least = cost.min(axis=1, keepdims=True)
    return np.asarray(np.sqrt(np.where(cost <= least, 1.0, least / np.where(cost <= least, 1.0, cost))))
