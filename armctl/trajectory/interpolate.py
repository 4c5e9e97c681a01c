"""Joint motion through waypoints: a path over progress, and a time law that runs along it.

The path q(s) passes every waypoint at its own progress s in [0, 1]; "linear" joins them by straight joint lines,
"cubic" by one C2 spline. The time law s(u), u = t / duration, starts and ends at rest and never stops in between:
speed rises over the first fifth by a quintic step, stays constant, falls over the last fifth. Keeping the two apart is
what lets via points cost no time.
"""

from typing import Literal

import numpy as np

from armctl.kinematics.transform import FloatArray

Interpolation = Literal["linear", "cubic"]

# Share of the duration in which the motion speeds up; as much in which it slows down.
RAMP = 0.2
# Speed of the constant middle, as a multiple of the mean speed.
PEAK_SPEED = 1.0 / (1.0 - RAMP)
# Largest speed and acceleration of `rest_to_rest` over a unit distance in unit time.
QUINTIC_PEAK_SPEED = 1.875
QUINTIC_PEAK_ACCELERATION = 10.0 / 3.0**0.5


def time_law(u: FloatArray, ramp_share: float = RAMP) -> FloatArray:
    """Progress at the fraction `u` of the duration; C3, rest at both ends, peak speed 1 / (1 - ramp_share).

    Args:
        u: Fractions, any shape; below 0 counts as 0, above 1 as 1.
        ramp_share: Of the duration, in which it speeds up, and in which it slows down; 0.5 at most.
    """
    peak_speed = 1.0 / (1.0 - ramp_share)
    u = np.clip(u, 0.0, 1.0)
    # Speed climbs as 6x^5 - 15x^4 + 10x^3; `ramp` is its integral.
    x = np.minimum(np.minimum(u, 1.0 - u) / ramp_share, 1.0)
    ramp = peak_speed * ramp_share * np.square(x * x) * (x * (x - 3.0) + 2.5)
    even = peak_speed * (u - ramp_share / 2.0)
    return np.where(u < ramp_share, ramp, np.where(u > 1.0 - ramp_share, 1.0 - ramp, even))


def time_of_progress(s: FloatArray) -> FloatArray:
    """The inverse of `time_law`, to 1e-4 of the duration: fraction of the duration at which progress is `s`."""
    u = np.linspace(0.0, 1.0, 8193)
    return np.interp(s, time_law(u), u)


def rest_to_rest(q0: FloatArray, q1: FloatArray, u: FloatArray) -> FloatArray:
    """Synchronised rest-to-rest motion of all joints, fifth-order polynomial in time.

    Args:
        q0, q1: Start and end [rad], shape (n,).
        u: Fractions of the duration, shape (m,); clipped to 0..1.
    Returns:
        q, shape (m, n).
    """
    u = np.clip(u, 0.0, 1.0)
    blend = u * u * u * (u * (6.0 * u - 15.0) + 10.0)  # no power, which another machine may round differently
    return np.asarray(q0 + blend[:, None] * (np.asarray(q1) - q0))


def joint_path(waypoints: FloatArray, knots: FloatArray, s: FloatArray, kind: Interpolation) -> FloatArray:
    """Joint positions at progress `s` of paths through waypoints; vectorised over leading axes.

    Between two waypoints the second derivative M runs linearly: with a = (s1 - s) / h, b = 1 - a,
    q = a q0 + b q1 + ((a^3 - a) M0 + (b^3 - b) M1) h^2 / 6; M = 0 is the straight joint line.

    Args:
        waypoints: Joint positions [rad], shape (..., k, n), k >= 2.
        knots: Progress of the waypoints, shape (..., k), strictly increasing.
        s: Where to evaluate, shape (m,); clipped to the first and last knot.
    Returns:
        q, shape (..., m, n).
    Raises:
        ValueError: shapes do not fit, fewer than two waypoints, or knots that do not increase.
    """
    waypoints, knots = np.asarray(waypoints, dtype=np.float64), np.asarray(knots, dtype=np.float64)
    if waypoints.shape[:-1] != knots.shape or knots.shape[-1] < 2:
        raise ValueError(f"waypoints {waypoints.shape}, knots {knots.shape}: expected (..., k, n) and (..., k), k >= 2")
    h = np.diff(knots, axis=-1)
    if not (h > 0.0).all():
        raise ValueError("knots must increase strictly")
    s = np.clip(s, knots[..., :1], knots[..., -1:])
    segment = (s[..., :, None] >= knots[..., None, 1:-1]).sum(axis=-1)
    begin, length = np.take_along_axis(knots, segment, -1), np.take_along_axis(h, segment, -1)
    b = ((s - begin) / length)[..., None]
    a = 1.0 - b
    left, right = segment[..., None], segment[..., None] + 1
    q = a * np.take_along_axis(waypoints, left, -2) + b * np.take_along_axis(waypoints, right, -2)
    if kind == "cubic" and knots.shape[-1] > 2:
        M = _second_derivatives(waypoints, h)
        bend = (a * a * a - a) * np.take_along_axis(M, left, -2) + (b * b * b - b) * np.take_along_axis(M, right, -2)
        q += bend * (length**2)[..., None] / 6.0
    return np.asarray(q)


def _second_derivatives(waypoints: FloatArray, h: FloatArray) -> FloatArray:
    """Second derivatives at the knots of the C2 spline, shape (..., k, n); Thomas algorithm.

    The end segments are parabolas (M0 = M1): a path along a line is curved at its ends as much as elsewhere, which
    natural ends (M0 = 0) would deny.
    """
    right = 6.0 * np.diff(np.diff(waypoints, axis=-2) / h[..., None], axis=-2)
    diagonal = 2.0 * (h[..., :-1] + h[..., 1:])
    diagonal[..., 0] += h[..., 0]
    diagonal[..., -1] += h[..., -1]
    inner = diagonal.shape[-1]
    for i in range(1, inner):
        factor = h[..., i] / diagonal[..., i - 1]
        diagonal[..., i] -= factor * h[..., i]
        right[..., i, :] -= factor[..., None] * right[..., i - 1, :]
    M = np.empty_like(waypoints)
    M[..., inner, :] = right[..., -1, :] / diagonal[..., -1, None]
    for i in range(inner - 2, -1, -1):
        M[..., i + 1, :] = (right[..., i, :] - h[..., i + 1, None] * M[..., i + 2, :]) / diagonal[..., i, None]
    M[..., 0, :] = M[..., 1, :]
    M[..., -1, :] = M[..., -2, :]
    return M


def columns_at(at: FloatArray, known_at: FloatArray, values: FloatArray) -> FloatArray:
    """Columns of values, shape (m, k), known at increasing places (m,), read at others (l,): linear in between.

    Returns:
        Shape (l, k); outside of what is known the first or last row.
    """
    return np.stack([np.interp(at, known_at, column) for column in values.T], axis=1)
