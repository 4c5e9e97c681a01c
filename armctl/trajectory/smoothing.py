"""Velocity and acceleration of what was sampled: local cubics.

Differences of whole ticks are mostly noise: at 0.1 s one tick is 3 deg/s, and 30 deg/s^2. So a cubic is fitted to the
samples around each instant by weighted least squares (tricube weights, which fade out at the window's ends); its value
and derivatives there are the smoothed ones. A cubic passes unchanged; what is shorter than the window is flattened.
"""

import numpy as np

from armctl.kinematics.transform import FloatArray

DEGREE = 3


def local_cubics(time_s: FloatArray, values: FloatArray, at_s: FloatArray, half_width_s: float) -> FloatArray:
    """Value, first and second derivative of samples at instants, shape (3, k, n).

    Args:
        time_s: When the samples were taken, shape (m,), increasing.
        values: Samples, shape (m, n).
        at_s: Where they are wanted, shape (k,).
        half_width_s: Samples farther than this from an instant do not count for it.
    Raises:
        ValueError: fewer than five samples around some instant.
    """
    found = np.empty((3, len(at_s), values.shape[1]))
    # Powers of the time count in half widths, and the second derivative of the square is 2.
    units = np.array([[1.0], [half_width_s], [half_width_s**2 / 2.0]])
    for index, instant in enumerate(at_s):
        away = (time_s - instant) / half_width_s
        near = np.abs(away) < 1.0
        if near.sum() < DEGREE + 2:
            raise ValueError(f"{near.sum()} samples within {half_width_s} s of {instant:.3f} s; five are needed")
        weights = (1.0 - np.abs(away[near]) ** 3) ** 1.5  # the root of the tricube
        powers = away[near][:, None] ** np.arange(DEGREE + 1)
        coefficients = np.linalg.lstsq(powers * weights[:, None], values[near] * weights[:, None])[0]
        found[:, index] = coefficients[:3] / units
    return found
