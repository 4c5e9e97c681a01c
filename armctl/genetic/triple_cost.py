"""Costs of chromosomes that are sums over triples of neighbouring genes, as tables.

Entry (k, i, j, l) of a table, shape (m - 2, R, R, R), is what genes i, j, l at places k, k + 1, k + 2 cost together:
enough for anything that depends on a gene, its speed and its acceleration.
"""

import numpy as np

from armctl.kinematics.transform import FloatArray, IntArray


def evaluate(table: FloatArray, genes: IntArray) -> FloatArray:
    """Cost of each chromosome.

    Args:
        genes: Chromosomes, shape (..., m).
    Returns:
        Costs, shape (...).
    """
    return np.asarray(triples(table, genes, genes, genes).sum(axis=-1))


def triples(table: FloatArray, first: IntArray, second: IntArray, third: IntArray) -> FloatArray:
    """Cost of each triple whose first gene is from `first`, its second from `second`, its third from `third`.

    Args:
        first, second, third: Chromosomes, shape (..., m).
    Returns:
        Costs, shape (..., m - 2).
    """
    places, choices = table.shape[:2]
    index = (first[..., :-2] * choices + second[..., 1:-1]) * choices + third[..., 2:]
    return np.asarray(table.reshape(-1)[index + np.arange(places) * choices**3])
