"""The exact optimum that a genetic algorithm over recorded genes can reach, by dynamic programming.

The cost of a path is a sum over triples of neighbouring genes, so the best way to arrive at a pair of neighbours says
everything about the past: m - 2 steps over R^3 triples find the true minimum of R^m paths.
"""

from __future__ import annotations

import numpy as np

from armctl.genetic.triple_cost import IntArray
from armctl.kinematics.transform import FloatArray


def shortest_path(cost: FloatArray) -> IntArray:
    """The genes with the least sum of triple costs.

    Args:
        cost: Cost of the triple (i, j, l) of genes at stations k, k + 1, k + 2, shape (m - 2, R, R, R).
    Returns:
        Recording index at each station, shape (m,).
    """
    recordings = cost.shape[1]
    best = np.zeros((recordings, recordings))  # of all paths so far that end in (i, j)
    choices = []
    for triple in cost:
        arrival = best[:, :, None] + triple
        choices.append(arrival.argmin(axis=0))
        best = arrival.min(axis=0)
    j, last = divmod(int(best.argmin()), recordings)
    genes = [last, j]
    for choice in reversed(choices):
        genes.append(int(choice[genes[-1], genes[-2]]))
    return np.array(genes[::-1], dtype=np.intp)
