"""Where two or more links in a plane that a waist turns can go, and how far a point is from there.

The links reach an annulus about the shoulder; the shoulder stands `a1` in front of the waist's axis and the plane
`offset` beside it, so the plane's point (u, v) is at the distance rho = hypot(u + a1, offset) from the axis. The
workspace is what the annulus sweeps: a point is in it if one of its two places in the plane lies in the annulus.
The nearest point of the workspace to one outside lies on a circle of the annulus or, inside the cylinder
rho < |offset|, on that cylinder. Joint ranges do not count here.
"""

import math
import sys
from typing import Any, NamedTuple

import numpy as np

from armctl.kinematics.numbers import Numbers
from armctl.kinematics.transform import FloatArray

# Relative excess of a length that is rounding, not distance.
ROUNDING = 1e-12
_GRID = np.linspace(-1.0, 1.0, 721)


def annulus(links_m: tuple[float, ...]) -> tuple[float, float]:
    """Least and greatest distance [m] that links in a plane can span."""
    total = sum(links_m)
    return max(0.0, 2.0 * max(links_m) - total), total


def waists_of_point(x: Any, y: Any, offset: float, on: Numbers) -> list[tuple[Any, Any, Any]]:
    """Where the waist stands so that the plane `offset` beside its axis holds a point: before and behind the axis.

    Returns:
        Cosine and sine of the waist, and how far out in the plane the point then is [m]; NaN where the axis is nearer.
    """
    square = x * x + y * y
    aside, off_axis = square > 0.0, on.where(square > 0.0, square, math.nan)
    root = on.root(square - offset * offset, ROUNDING * (square + offset * offset))
    return [
        (
            on.where(aside, (radial * x - offset * y) / off_axis, 1.0),
            on.where(aside, (radial * y + offset * x) / off_axis, 0.0),
            radial,
        )
        for radial in (root, -root)
    ]


class PlaneReach(NamedTuple):
    """The swept annulus; lengths in metres."""

    links_m: tuple[float, ...]
    a1: float
    # Signed distance of the plane from the waist's axis: x sin(theta1) - y cos(theta1).
    offset: float
    # Height of the shoulder.
    height: float

    def nearest(self, point: FloatArray) -> tuple[FloatArray, float]:
        """The point of the workspace nearest to `point` [m], shape (3,), and its distance [m]; 0 if it is in it."""
        x, y, z = (float(value) for value in point)
        rho, v = math.hypot(x, y), z - self.height
        low, high = annulus(self.links_m)
        slack = ROUNDING * high
        if rho >= abs(self.offset) * (1.0 - ROUNDING):
            radial = math.sqrt(max(0.0, rho * rho - self.offset**2))
            for u in (radial - self.a1, -radial - self.a1):
                if low - slack <= math.hypot(u, v) <= high + slack:
                    return np.array([x, y, z]), 0.0
        candidates = [self._on_circle(radius, rho, v) for radius in (low, high) if radius > 0.0]
        if low <= math.hypot(self.a1, v) <= high:
            candidates.append((-self.a1, v))
        if low == 0.0:
            candidates.append((0.0, 0.0))
        u, height = min(candidates, key=lambda uv: self._square(uv[0], uv[1], rho, v))
        near_rho = math.hypot(u + self.a1, self.offset)
        c, s = (x / rho, y / rho) if rho > sys.float_info.min else (1.0, 0.0)
        return np.array([near_rho * c, near_rho * s, height + self.height]), math.sqrt(self._square(u, height, rho, v))

    def _square(self, u: float, height: float, rho: float, v: float) -> float:
        return (math.hypot(u + self.a1, self.offset) - rho) ** 2 + (height - v) ** 2

    def _on_circle(self, radius: float, rho: float, v: float) -> tuple[float, float]:
        """The (u, v) on a circle about the shoulder nearest to the point at (rho, v): a grid, finer and finer."""
        best, half = 0.0, math.pi
        while half > 1e-9:
            angles = best + half * _GRID
            squares = (np.hypot(radius * np.cos(angles) + self.a1, self.offset) - rho) ** 2
            squares += (radius * np.sin(angles) - v) ** 2
            best, half = float(angles[int(np.argmin(squares))]), half * 2.0 / len(_GRID)
        return radius * math.cos(best), radius * math.sin(best)
