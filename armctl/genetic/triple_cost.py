"""Costs of chromosomes that are sums over triples of neighbouring genes, as tables.

Entry (k, i, j, l) of a table, shape (m - 2, R, R, R), is what genes i, j, l at places k, k + 1, k + 2 cost together:
enough for anything that depends on a gene, its speed and its acceleration.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from armctl.kinematics.transform import FloatArray

IntArray = NDArray[np.intp]


def evaluate(table: FloatArray, genes: IntArray) -> FloatArray:
    """Cost of each chromosome.

    Args:
        genes: Chromosomes, shape (..., m).
    Returns:
        Costs, shape (...).
    """
    return np.asarray(_triples(table, genes, genes, genes).sum(axis=-1))


def cut_costs(table: FloatArray, first: IntArray, second: IntArray) -> FloatArray:
    """Cost of `first` up to a cut and `second` after it, for every cut at once.

    Args:
        first, second: Chromosomes, shape (P, m).
    Returns:
        Cost of joining first[:c] and second[c:], shape (P, m + 1) over c = 0..m.
    """
    rows, genes = first.shape
    costs = np.zeros((rows, genes + 1))
    head = np.cumsum(_triples(table, first, first, first), axis=1)
    tail = np.cumsum(_triples(table, second, second, second)[:, ::-1], axis=1)[:, ::-1]
    costs[:, 3:] += head
    costs[:, : genes - 2] += tail
    # The two triples that the cut runs through.
    costs[:, 2:genes] += _triples(table, first, first, second)
    costs[:, 1 : genes - 1] += _triples(table, first, second, second)
    return costs


def _triples(table: FloatArray, first: IntArray, second: IntArray, third: IntArray) -> FloatArray:
    places, choices = table.shape[:2]
    index = (first[..., :-2] * choices + second[..., 1:-1]) * choices + third[..., 2:]
    return np.asarray(table.reshape(-1)[index + np.arange(places) * choices**3])
