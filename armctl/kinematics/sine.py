"""Cosine and sine that come out the same, to the last bit, on every machine.

A C library's may differ in the last bit from one processor, system or version to the next, and a log is replayed
elsewhere than it was made. Here are only sums, products and roundings to a whole number, whose results
IEEE 754 fixes. One angle and many go through the same operations in the same order.

The angle is brought into -pi/4..pi/4 by whole quarter turns, pi/2 being kept in three parts (Cody and Waite), the rest
in two. There nine and ten terms of the Taylor series are enough. Both are within 1.2e-16 of the truth.
"""

import math
from functools import lru_cache
from typing import Any

import numpy as np

from armctl.kinematics.transform import FloatArray

# Beyond this angle the product of a part of pi/2 and the quarter turns has too many digits; the C library is used.
LARGEST_RAD = 1e6
# Up to so many angles, one by one takes less time than numpy's calls do.
FEW = 24
QUARTERS_PER_RAD = 2.0 / math.pi
# Of pi/2: its first 33 bits, the next 33 and the next 53.
PARTS_RAD = (
    float.fromhex("0x1.921fb544p+0"),
    float.fromhex("0x1.0b4611a6p-34"),
    float.fromhex("0x1.3198a2e037073p-69"),
)


@lru_cache(maxsize=8192)
def cos_sin(angle: float) -> tuple[float, float]:
    """Cosine and sine of an angle [rad]; the last ones are kept, because the angles of a servo's ticks come often."""
    if not -LARGEST_RAD <= angle <= LARGEST_RAD:
        return float(np.cos(angle)), float(np.sin(angle))
    turns = round(angle * QUARTERS_PER_RAD)
    c, s = _beyond_turns(angle, turns)
    return ((c, s), (-s, c), (-c, -s), (s, -c))[turns & 3]


def cos_sin_of_all(angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Cosines and sines of angles [rad], both of their shape: what `cos_sin` says of each."""
    if angles.size <= FEW:
        both = np.array([cos_sin(angle) for angle in angles.ravel().tolist()]).reshape(*angles.shape, 2)
        return both[..., 0], both[..., 1]
    beyond = ~(np.abs(angles) <= LARGEST_RAD)
    if beyond.any():
        c, s = cos_sin_of_all(np.where(beyond, 0.0, angles))
        return np.where(beyond, np.cos(angles), c), np.where(beyond, np.sin(angles), s)
    turns = np.rint(angles * QUARTERS_PER_RAD)
    c, s = _beyond_turns(angles, turns)
    quarter = turns.astype(np.int64) & 3
    odd = (quarter & 1) != 0
    c, s = np.where(odd, s, c), np.where(odd, c, s)
    np.negative(c, out=c, where=(quarter + 1 & 2) != 0)
    np.negative(s, out=s, where=(quarter & 2) != 0)
    return c, s


def _beyond_turns(angle: Any, turns: Any) -> tuple[Any, Any]:
    """Cosine and sine of what an angle has beyond so many quarter turns; floats and arrays take the same operations."""
    first, second, third = PARTS_RAD
    rest, way = angle - turns * first, turns * second
    x = rest - way
    bent = rest - x
    low = ((rest - (x + bent)) + (bent - way)) - turns * third
    x, low = x + low, (x - (x + low)) + low
    z = x * x
    c = -1 / 6402373705728000 * z + 1 / 20922789888000
    c = ((c * z - 1 / 87178291200) * z + 1 / 479001600) * z - 1 / 3628800
    c = ((c * z + 1 / 40320) * z - 1 / 720) * z + 1 / 24
    s = 1 / 355687428096000 * z - 1 / 1307674368000
    s = ((s * z + 1 / 6227020800) * z - 1 / 39916800) * z + 1 / 362880
    s = ((s * z - 1 / 5040) * z + 1 / 120) * z - 1 / 6
    half = 0.5 * z
    near = 1.0 - half
    return near + (((1.0 - near) - half) + (z * z * c - x * low)), x + (x * z * s + low * near)
