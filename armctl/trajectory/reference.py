"""Where the tool is to be along a motion, and how far from there it was.

A reference path has tool points at progress 0 to 1 of its motion, with straight lines between them; beyond its ends it
goes on straight. A line from A to B has two points. There are two distances:
1. `apart_m` is that from where the tool is to be at the same progress: to be early or late counts.
2. `off_m` is that from the path, whose nearest place is looked for `NEAR_M` around there: to be early or late costs
   nothing. For a line it is the distance of Raharjo et al. eq. 19.
"""

from typing import NamedTuple, Self

import numpy as np

from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import columns_at

# Farther than a tool at its speed limit gets in the longest dead time; nearer than the other side of a small figure.
NEAR_M = 0.015


class ReferencePath(NamedTuple):
    """Tool points `tool_m` [m], shape (m, 3), due at `progress`, shape (m,), which rises from 0 to 1; m >= 2."""

    progress: FloatArray
    tool_m: FloatArray

    @classmethod
    def line(cls, A: FloatArray, B: FloatArray) -> Self:
        """The line from A to B [m], shape (3,)."""
        return cls(np.array([0.0, 1.0]), np.array([A, B], dtype=np.float64))

    def at(self, progress: FloatArray) -> FloatArray:
        """Where the tool is to be [m], shape (k, 3), at progress of shape (k,)."""
        return columns_at(progress, self.progress, self.tool_m)

    def apart_m(self, tool_m: FloatArray, progress: FloatArray) -> FloatArray:
        """Distances [m], shape (k,), of tool points, shape (k, 3), from the places of the same progress."""
        return np.asarray(np.linalg.norm(tool_m - self.at(progress), axis=1))

    def off_m(self, tool_m: FloatArray, progress: FloatArray) -> FloatArray:
        """Distances [m], shape (k,), of tool points, shape (k, 3), from the path around where they are to be."""
        step = np.diff(self.tool_m, axis=0)
        way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(step, axis=1))])
        here_m = np.interp(progress, self.progress, way_m)
        # Segments that reach into the neighbourhood: the first that ends in it, and the last that begins in it.
        first = np.clip(np.searchsorted(way_m, here_m - NEAR_M, "right") - 1, 0, len(step) - 1)
        last = np.clip(np.searchsorted(way_m, here_m + NEAR_M, "left"), first + 1, len(step))
        return np.array([self._off_m(P, a, b) for P, a, b in zip(tool_m, first.tolist(), last.tolist(), strict=True)])

    def _off_m(self, point: FloatArray, first: int, last: int) -> float:
        """Least distance of a point from the segments `first` to `last`, the last one left out."""
        begin, step = self.tool_m[first:last], np.diff(self.tool_m[first : last + 1], axis=0)
        away, square = point - begin, (step**2).sum(axis=1)
        foot = np.divide((away * step).sum(axis=1), square, out=np.zeros(len(step)), where=square > 0.0)
        low, high = np.zeros(len(step)), np.ones(len(step))
        low[0] -= np.inf if first == 0 else 0.0
        high[-1] += np.inf if last == len(self.tool_m) - 1 else 0.0
        return float(np.linalg.norm(away - np.clip(foot, low, high)[:, None] * step, axis=1).min())


def error_mm(distance_m: FloatArray) -> dict[str, float]:
    """Mean and largest of distances [m] as results name them."""
    return {"mean_error_mm": 1e3 * float(distance_m.mean()), "max_error_mm": 1e3 * float(distance_m.max())}
