"""The exact optimum that a genetic algorithm over recorded genes can reach, by dynamic programming.

The cost of a path is a sum over triples of neighbouring genes, so the best way to arrive at a pair of neighbours says
everything about the past: m - 2 steps over R^3 triples find the true minimum of R^m paths. Places need not have the
same number of choices, so the same search re-chooses a few genes while their neighbours stay (`window_search`).
"""

from collections.abc import Sequence

import numpy as np

from armctl.kinematics.transform import FloatArray, IntArray


def shortest_path(cost: Sequence[FloatArray] | FloatArray) -> IntArray:
    """The genes with the least sum of triple costs.

    Args:
        cost: Cost of the triple (i, j, l) of genes at stations k, k + 1, k + 2: m - 2 arrays, each of as many
            rows, columns and layers as these stations have choices; shape (m - 2, R, R, R) where all have R.
    Returns:
        Index of the choice at each station, shape (m,).
    """
    arrivals = [np.zeros(cost[0].shape[:2])]  # of all paths so far that end in (i, j)
    for triple in cost:
        arrivals.append((arrivals[-1][:, :, None] + triple).min(axis=0))
    j, last = divmod(int(arrivals.pop().argmin()), cost[-1].shape[2])
    genes = [last, j]
    # Which way led there is asked of those few places only that lie on the best path.
    for before, triple in zip(reversed(arrivals), reversed(cost), strict=True):
        after, here = genes[-2:]
        genes.append(int((before[:, here] + triple[:, here, after]).argmin()))
    return np.array(genes[::-1], dtype=np.intp)


def window_search(table: FloatArray, genes: IntArray, begin: int, length: int) -> IntArray:
    """The chromosome with `length` of its genes, from `begin`, re-chosen as well as can be while all others stay.

    Args:
        table: Costs of triples, shape (m - 2, R, R, R).
        genes: One chromosome, shape (m,).
    """
    m = len(genes)
    free = range(begin, min(begin + length, m))
    first, last = max(begin - 2, 0), min(free.stop + 2, m)  # the triples that touch the window reach so far
    choices = [slice(None) if k in free else slice(genes[k], genes[k] + 1) for k in range(first, last)]
    chosen = shortest_path([table[first + k][tuple(choices[k : k + 3])] for k in range(len(choices) - 2)])
    better = genes.copy()
    better[free.start : free.stop] = chosen[free.start - first : free.stop - first]
    return better
