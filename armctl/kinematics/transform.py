"""Homogeneous transforms, rotations and quaternions, vectorised over leading axes."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]


def quaternion_from_matrix(R: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w), w >= 0, of one rotation matrix (Shepperd's method).

    Args:
        R: Rotation, shape (3, 3).
    """
    (m00, m01, m02), (m10, m11, m12), (m20, m21, m22) = R.tolist()
    trace = m00 + m11 + m22
    candidates = (trace, m00, m11, m22)
    largest = candidates.index(max(candidates))
    if largest == 0:
        q = (m21 - m12, m02 - m20, m10 - m01, 1.0 + trace)
    elif largest == 1:
        q = (1.0 + m00 - m11 - m22, m01 + m10, m02 + m20, m21 - m12)
    elif largest == 2:
        q = (m01 + m10, 1.0 - m00 + m11 - m22, m12 + m21, m02 - m20)
    else:
        q = (m02 + m20, m12 + m21, 1.0 - m00 - m11 + m22, m10 - m01)
    norm = math.sqrt(sum(c * c for c in q)) * (-1.0 if q[3] < 0.0 else 1.0)
    return q[0] / norm, q[1] / norm, q[2] / norm, q[3] / norm


def matrix_from_quaternion(quaternion: tuple[float, float, float, float]) -> FloatArray:
    """Rotation matrix of a unit quaternion (x, y, z, w), shape (3, 3)."""
    x, y, z, w = quaternion
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def rpy_from_matrix(R: FloatArray) -> tuple[float, float, float]:
    """Roll about x, pitch about y, yaw about z [rad] with R = Rz(yaw) Ry(pitch) Rx(roll).

    At pitch = +-90 deg, where only yaw -+ roll is defined, roll is 0.

    Args:
        R: Rotation, shape (3, 3).
    """
    horizontal = math.hypot(float(R[0, 0]), float(R[1, 0]))
    pitch = math.atan2(-float(R[2, 0]), horizontal)
    if horizontal < 1e-12:
        return 0.0, pitch, math.atan2(-float(R[0, 1]), float(R[1, 1]))
    return math.atan2(float(R[2, 1]), float(R[2, 2])), pitch, math.atan2(float(R[1, 0]), float(R[0, 0]))
