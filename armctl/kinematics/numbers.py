"""Formulas over a float, or over an array of as many as there are poses side by side.

Closed forms are written once, over these functions. Plain floats take less time for one pose, arrays for many.
"""

import math
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np


class Numbers(NamedTuple):
    """Functions of numbers, each a float or an array of shape (m,); angles in radians."""

    cos: Callable[[Any], Any]
    sin: Callable[[Any], Any]
    atan2: Callable[[Any, Any], Any]
    copysign: Callable[[Any, Any], Any]
    # Which of two numbers, by a truth value.
    where: Callable[[Any, Any, Any], Any]
    # A number, or the bound that it is beyond.
    within: Callable[[Any, float, float], Any]
    # An angle within +-pi.
    wrapped: Callable[[Any], Any]
    # Square root; what lies within a slack below zero counts as zero, what lies further below has none: NaN.
    root: Callable[[Any, Any], Any]


FLOATS = Numbers(
    *(math.cos, math.sin, math.atan2, math.copysign),
    where=lambda truth, yes, no: yes if truth else no,
    within=lambda x, low, high: min(max(x, low), high),
    wrapped=lambda angle: math.remainder(angle, 2.0 * math.pi),
    root=lambda x, slack: math.sqrt(x) if x >= 0.0 else 0.0 if x >= -slack else math.nan,
)
ARRAYS = Numbers(
    *(np.cos, np.sin, np.arctan2, np.copysign, np.where, np.clip),
    wrapped=lambda angle: angle - 2.0 * math.pi * np.round(angle / (2.0 * math.pi)),
    root=lambda x, slack: np.sqrt(np.where((x < 0.0) & (x >= -slack), 0.0, x)),
)
