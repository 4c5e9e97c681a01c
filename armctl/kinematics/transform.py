"""Rotations: cosine and sine, quaternions, homogeneous transforms, vectorised over leading axes.

Cosine and sine come out the same, to the last bit, on every machine. A C library's may differ in the last bit from one
processor, system or version to the next, and a log is replayed elsewhere than it was made. Here are only sums, products
and roundings to a whole number, whose results IEEE 754 fixes. One angle and many go through the same operations in the
same order.

The angle is brought into -pi/4..pi/4 by whole quarter turns, pi/2 being kept in three parts (Cody and Waite), the rest
in two. There nine and ten terms of the Taylor series are enough. Both are within 1.2e-16 of the truth.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.intp]
# x, y, z, w.
Quaternion = tuple[float, float, float, float]


def quaternion_from_matrix(R: FloatArray) -> Quaternion:
    """Unit quaternion (x, y, z, w), w >= 0, of one rotation matrix (Shepperd's method).

    Args:
        R: Rotation, shape (3, 3).
    """
    X, Y, Z = R.T.tolist()
    return quaternion_from_columns(X, Y, Z)


def quaternion_from_columns(X: Sequence[float], Y: Sequence[float], Z: Sequence[float]) -> Quaternion:
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


def matrix_from_quaternion(quaternion: Quaternion) -> FloatArray:
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


def pose_from_xyz_rpy(x: float, y: float, z: float, roll: float = 0, pitch: float = 0, yaw: float = 0) -> FloatArray:
    """Pose at a point [m] with the rotation of `matrix_from_rpy`, shape (4, 4)."""
    T = np.eye(4)
    T[:3, :3] = matrix_from_rpy(roll, pitch, yaw)
    T[:3, 3] = x, y, z
    return T


def inverted(T: FloatArray) -> FloatArray:
    """The inverse of a homogeneous transform, shape (4, 4)."""
    inverse = np.eye(4)
    inverse[:3, :3] = T[:3, :3].T
    inverse[:3, 3] = -T[:3, :3].T @ T[:3, 3]
    return inverse


def rotation_vector(R: FloatArray) -> FloatArray:
    """Axis times angle [rad] of rotations, shape (..., 3, 3) -> (..., 3).

    At half a turn, where the axis has two signs and the skew part vanishes, it is taken from the symmetric part.
    """
    R = np.asarray(R, dtype=np.float64)
    skew = 0.5 * np.stack([R[..., i, k] - R[..., k, i] for i, k in ((2, 1), (0, 2), (1, 0))], axis=-1)
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


# ------------------------------------------------------------------------------------------- cosine and sine

# Beyond this angle the product of a part of pi/2 and the quarter turns has too many digits; the C library is used.
LARGEST_RAD = 1e6
# Up to so many angles, one by one takes less time than numpy's calls do.
FEW = 24
QUARTERS_PER_RAD = 2.0 / math.pi
# Of pi/2: its first 33 bits, the next 33 and the next 53.
PARTS_RAD = tuple(map(float.fromhex, ("0x1.921fb544p+0", "0x1.0b4611a6p-34", "0x1.3198a2e037073p-69")))


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
