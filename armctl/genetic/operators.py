"""Genetic operators: pure functions of populations (rows are chromosomes, columns genes) and a random generator.

A gene is a whole number below `choices`. Crossover and mutation return a new population of the same shape.
"""

import numpy as np

from armctl.genetic.triple_cost import triples
from armctl.kinematics.transform import FloatArray, IntArray


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
    swap = np.arange(population.shape[1]) >= rng.integers(1, population.shape[1], (len(first), 1))
    children = population.copy()
    children[first] = np.where(swap, population[second], population[first])
    children[second] = np.where(swap, population[first], population[second])
    return children


def optimal_crossover(
    population: IntArray, donors: IntArray, table: FloatArray, probability: float, rng: np.random.Generator
) -> IntArray:
    """With `probability` a chromosome becomes the cheapest of all mixtures of its own and its donor's genes.

    Where neighbours must fit each other a blind cut nearly never leaves a chromosome that is any good, and a single
    changed gene never does. Of the 2^m mixtures the table of triple costs tells the best by dynamic programming, two
    choices a place, all pairs of parents at once.

    Args:
        donors: The donor of each chromosome, shape as `population`.
        table: Costs of triples of neighbouring genes (see `triple_cost.py`).
    """
    crossed = np.flatnonzero(rng.random(len(population)) < probability)
    parents = np.stack([population[crossed], donors[crossed]])
    pairs, genes = parents.shape[1:]
    from_first, from_second, from_third = np.unravel_index(np.arange(8), (2, 2, 2))
    cost = triples(table, parents[from_first], parents[from_second], parents[from_third])
    cost = np.ascontiguousarray(np.moveaxis(cost, 2, 0)).reshape(genes - 2, 2, 2, 2, pairs)
    best = np.zeros((2, 2, pairs))  # of all mixtures so far that end in these two parents
    donated = np.empty((genes - 2, 2, 2, pairs), dtype=np.intp)
    for place, triple in enumerate(cost):
        arrival = best[:, :, None] + triple
        donated[place] = arrival[1] < arrival[0]
        best = arrival.min(axis=0)
    taken = np.empty((genes, pairs), dtype=np.intp)
    taken[-2], taken[-1] = np.divmod(best.reshape(4, pairs).argmin(axis=0), 2)
    pair = np.arange(pairs)
    for place in range(genes - 3, -1, -1):
        taken[place] = donated[place, taken[place + 1], taken[place + 2], pair]
    children = population.copy()
    children[crossed] = np.where(taken.T == 1, parents[1], parents[0])
    return children


def mutate(population: IntArray, choices: int, probability: float, rng: np.random.Generator) -> IntArray:
    """Gives `probability` of all genes of the population, drawn with replacement, a random value."""
    mutated = population.copy()
    genes = rng.integers(0, population.size, round(probability * population.size))
    mutated.flat[genes] = rng.integers(0, choices, len(genes))
    return mutated
