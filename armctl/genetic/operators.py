"""Genetic operators: pure functions of populations (rows are chromosomes, columns genes) and a random generator.

A gene is a whole number below `choices`. Crossover and mutation return a new population of the same shape.
"""

from __future__ import annotations

import numpy as np

from armctl.genetic.triple_cost import IntArray, cut_costs
from armctl.kinematics.transform import FloatArray

_BLOCK = 250
"""Chromosomes fitted at once: what they need stays in the processor's cache."""


def fitness_from_cost(cost: FloatArray) -> FloatArray:
    """Fitness of each individual: least cost of the pool / own cost, in (0, 1].

    The paper minimises an error (eq. 20) but selects in proportion to a fitness and gives no mapping. This one makes
    the best 1, halves for twice the error, and knows no scale.

    Args:
        cost: Costs >= 0, shape (P,).
    """
    best = cost.min()
    return np.asarray(np.where(cost <= best, 1.0, best / np.where(cost <= best, 1.0, cost)))


def roulette(fitness: FloatArray, count: int, rng: np.random.Generator) -> IntArray:
    """Indices of `count` draws, each individual with probability in proportion to its fitness.

    Args:
        fitness: Values >= 0, not all zero, shape (P,).
    """
    probability = fitness / fitness.sum()  # (eq. 21)
    cumulative = np.cumsum(probability)  # (eq. 22)
    # Rounding may leave the last sum a hair below 1.
    return np.minimum(np.searchsorted(cumulative, rng.random(count), side="right"), len(fitness) - 1)


def elite(fitness: FloatArray, threshold: float, most: int) -> IntArray:
    """Indices of individuals whose fitness reaches the threshold, best first, at most `most`."""
    order = np.argsort(-fitness, kind="stable")[:most]
    return order[fitness[order] >= threshold]


def one_cut_crossover(population: IntArray, probability: float, rng: np.random.Generator) -> IntArray:
    """Each chromosome becomes a parent with `probability`; random pairs of parents swap all genes after one cut."""
    parents = rng.permutation(np.flatnonzero(rng.random(len(population)) < probability))
    first, second = parents[: len(parents) // 2], parents[len(parents) // 2 : len(parents) // 2 * 2]
    cut = rng.integers(1, population.shape[1], (len(first), 1))
    swap = np.arange(population.shape[1]) >= cut
    children = population.copy()
    children[first] = np.where(swap, population[second], population[first])
    children[second] = np.where(swap, population[first], population[second])
    return children


def fitted_crossover(
    population: IntArray, donors: IntArray, table: FloatArray, probability: float, rng: np.random.Generator
) -> IntArray:
    """With `probability` a chromosome takes a run of its donor's genes, cut where donor and receiver fit best.

    The run holds one random place; to each side it reaches as far as makes the sum of triple costs least. Where
    neighbours must fit each other a blind cut nearly never leaves a chromosome that is any good, and a single changed
    gene never does.

    Args:
        donors: The donor of each chromosome, shape as `population`.
        table: Costs of triples of neighbouring genes (see `triple_cost.py`).
    """
    rows, genes = population.shape
    place = rng.integers(0, genes, (rows, 1))
    cuts = np.arange(genes + 1)
    column = np.arange(genes)
    children = population.copy()
    taking = rng.random(rows) < probability
    for block in np.array_split(np.flatnonzero(taking), rows // _BLOCK + 1):
        receiver, donor, held = population[block], donors[block], place[block]
        begin = np.where(cuts <= held, cut_costs(table, receiver, donor), np.inf).argmin(axis=1)
        end = np.where(cuts > held, cut_costs(table, donor, receiver), np.inf).argmin(axis=1)
        children[block] = np.where((column >= begin[:, None]) & (column < end[:, None]), donor, receiver)
    return children


def mutate(population: IntArray, choices: int, probability: float, rng: np.random.Generator) -> IntArray:
    """Gives `probability` of all genes of the population, drawn with replacement, a random value."""
    mutated = population.copy()
    genes = rng.integers(0, population.size, round(probability * population.size))
    mutated.flat[genes] = rng.integers(0, choices, len(genes))
    return mutated
