"""How straight a tool path is: distance to the line through A and B (Raharjo et al. eqs. 19, 20).

The line is endless: to run past A or B costs nothing. Where the ends matter, something else must hold them.
"""

import numpy as np

from armctl.kinematics.transform import FloatArray

# A and B of a line [m], each of shape (3,).
Ends = tuple[FloatArray, FloatArray]


def distance_to_line(points: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """Distance of tool points to the line AB [m], |(P - A) x (P - B)| / |B - A| (eq. 19).

    Args:
        points: Tool points [m], shape (..., 3).
        A, B: Ends of the line [m], shape (3,).
    Returns:
        Distances, shape (...).
    Raises:
        ValueError: A and B are the same point, or a shape is wrong.
    """
    points, A, B, length = _checked(points, A, B)
    return np.asarray(np.linalg.norm(np.cross(points - A, points - B), axis=-1) / length)


def progress_along_line(points: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """Foot of the perpendicular from each point as a fraction of AB: 0 at A, 1 at B, not clipped.

    Args, raises: as `distance_to_line`.
    Returns:
        Progress, shape (...).
    """
    points, A, B, length = _checked(points, A, B)
    return np.asarray(((points - A) * (B - A)).sum(axis=-1) / length**2)


def mean_error(points: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """Mean distance of each path to the line AB [m], the paper's objective (eq. 20).

    Args:
        points: Paths of m tool points [m], shape (..., m, 3).
    Returns:
        Mean over m, shape (...).
    Raises:
        ValueError: as `distance_to_line`.
    """
    return np.asarray(distance_to_line(points, A, B).mean(axis=-1))


def errors_mm(points: FloatArray, A: FloatArray, B: FloatArray) -> tuple[float, float]:
    """Mean (eq. 20) and largest distance of a path, shape (m, 3) [m], from the line AB [mm]; errors as `mean_error`."""
    distance_m = distance_to_line(points, A, B)
    return float(distance_m.mean()) * 1e3, float(distance_m.max()) * 1e3


def best_line(points: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The path's own chord: the line from which its points are least far, root mean square.

    How straight a path is in itself, wherever it lies: errors of an arm's geometry move and turn a path much more than
    they bend it.

    Args:
        points: Tool points [m], shape (m, 3), not all the same.
    Returns:
        Two points of the line, a metre apart, each shape (3,).
    """
    middle = points.mean(axis=0)
    return middle, middle + np.linalg.svd(points - middle, full_matrices=False)[2][0]


def own_chord_mm(points: FloatArray) -> tuple[float, float]:
    """Mean and largest distance of a path, shape (m, 3) [m], from its `best_line` [mm]."""
    return errors_mm(points, *best_line(points))


def _checked(points: FloatArray, A: FloatArray, B: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray, float]:
    points, A, B = (np.asarray(value, dtype=np.float64) for value in (points, A, B))
    if A.shape != (3,) or B.shape != (3,) or points.shape[-1:] != (3,):
        raise ValueError(f"points {points.shape}, A {A.shape}, B {B.shape}: the last axis must be x, y, z")
    length = float(np.linalg.norm(B - A))
    if not length > 0.0:
        raise ValueError(f"A and B are the same point {A.tolist()}: they make no line")
    return points, A, B, length
