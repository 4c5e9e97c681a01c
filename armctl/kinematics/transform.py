"""Homogeneous transforms, rotations and quaternions, vectorised over leading axes."""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]


def quaternion_from_matrix(R: FloatArray) -> tuple[float, float, float, float]:
    """Unit quaternion (x, y, z, w), w >= 0, of one rotation matrix (Shepperd's method).

    Args:
        R: Rotation, shape (3, 3).
    """
    X, Y, Z = R.T.tolist()
    return quaternion_from_columns(X, Y, Z)


def quaternion_from_columns(
    X: Sequence[float], Y: Sequence[float], Z: Sequence[float]
) -> tuple[float, float, float, float]:
    """`quaternion_from_matrix` of the three columns of a rotation."""
    (m00, m10, m20), (m01, m11, m21), (m02, m12, m22) = X, Y, Z
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
    x, y, z, w = q
    # Written out: Python's own sum of floats rounds differently from 3.12 on, and logs are replayed there.
    norm = math.sqrt(x * x + y * y + z * z + w * w) * (-1.0 if w < 0.0 else 1.0)
    return x / norm, y / norm, z / norm, w / norm


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


def matrix_from_rpy(roll: float, pitch: float, yaw: float) -> FloatArray:
    """Rotation Rz(yaw) Ry(pitch) Rx(roll) of angles [rad], shape (3, 3)."""
    cr, sr, cp, sp, cy, sy = (f(angle) for angle in (roll, pitch, yaw) for f in (math.cos, math.sin))
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


def pose_from_xyz_rpy(
    x: float, y: float, z: float, roll: float = 0.0, pitch: float = 0.0, yaw: float = 0.0
) -> FloatArray:
    """Pose at a point [m] with the rotation of `matrix_from_rpy`, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = matrix_from_rpy(roll, pitch, yaw)
    T[:3, 3] = x, y, z
    return T


def rotation_vector(R: FloatArray) -> FloatArray:
    """Axis times angle [rad] of rotations, shape (..., 3, 3) -> (..., 3).

    At half a turn, where the axis has two signs and the skew part vanishes, it is taken from the symmetric part.
    """
    R = np.asarray(R, dtype=np.float64)
    skew = 0.5 * np.stack(
        (R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]), axis=-1
    )
    sine = np.linalg.norm(skew, axis=-1)
    cosine = 0.5 * (R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0)
    angle = np.arctan2(sine, cosine)
    vector = skew * np.where(sine > 0.0, angle / np.where(sine > 0.0, sine, 1.0), 1.0)[..., None]
    half_turn = (cosine < 0.0) & (sine < 1e-6)
    if half_turn.any():
        # R = 2 a a^T - 1 nearly: the largest column of R + 1 is along the axis a.
        S = R[half_turn] + np.swapaxes(R[half_turn], -1, -2) + 2.0 * np.eye(3)
        column = np.argmax(np.diagonal(S, axis1=-2, axis2=-1), axis=-1)
        axis = np.take_along_axis(S, column[:, None, None], axis=-1)[..., 0]
        axis /= np.linalg.norm(axis, axis=-1, keepdims=True)
        sign = np.where((axis * skew[half_turn]).sum(axis=-1) < 0.0, -1.0, 1.0)
        vector[half_turn] = axis * (sign * angle[half_turn])[:, None]
    return np.asarray(vector)


def rotation_error(R: FloatArray, R_wanted: FloatArray) -> FloatArray:
    """The turn [rad] in the base frame that takes R to R_wanted, shape (..., 3)."""
    return rotation_vector(np.asarray(R_wanted) @ np.swapaxes(R, -1, -2))


def finite(rows: FloatArray) -> FloatArray:
    """The rows (last axis) without a NaN, shape (k, n)."""
    rows = rows.reshape(-1, rows.shape[-1])
    return np.asarray(rows[np.isfinite(rows).all(axis=1)])
