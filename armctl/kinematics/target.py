"""What inverse kinematics is asked for: a pose, a point, or a point and where the tool points there."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.transform import FloatArray

# How far R R^T may be from 1, element by element: the rounding of numbers somebody typed.
ROTATION_SLACK = 1e-4


class Target(NamedTuple):
    """Where the tool shall be: a pose, a point, or a point and where the tool points there."""

    # Shape (4, 4); of a point, with or without a direction, the rotation is left out.
    T: FloatArray
    # Whether the rotation counts.
    turned: bool
    # Of the rotation only where the tool points counts, and this is where: unit vector in the base frame, shape (3,).
    direction: FloatArray | None = None

    @property
    def position_m(self) -> FloatArray:
        return self.T[:3, 3]


def point_target(xyz: tuple[float, float, float] | FloatArray) -> Target:
    """A target for the tool point [m].

    Raises:
        ConfigError: not three finite numbers.
    """
    point = np.asarray(xyz, dtype=np.float64)
    if point.shape != (3,) or not np.isfinite(point).all():
        raise ConfigError("target", "xyz", f"{point.tolist()} is not three finite numbers", "give x,y,z in metres")
    T = np.eye(4)
    T[:3, 3] = point
    return Target(T, turned=False)


def direction_target(xyz: tuple[float, float, float] | FloatArray, direction: Sequence[float] | FloatArray) -> Target:
    """A target for the tool point [m], and the direction in which the tool points there, of any length.

    Raises:
        ConfigError: not three finite numbers each, or the direction is none.
    """
    along = np.asarray(direction, dtype=np.float64)
    if along.shape != (3,) or not np.isfinite(along).all() or float(np.linalg.norm(along)) < 1e-9:
        text = f"{along.tolist()} is no direction"
        raise ConfigError("target", "direction", text, "give x,y,z in the base frame, such as 0,0,-1 for down")
    return point_target(xyz)._replace(turned=True, direction=along / np.linalg.norm(along))


def pose_target(T: FloatArray) -> Target:
    """A target for the tool's pose; the rotation is freed of the rounding of typed numbers.

    Raises:
        ConfigError: not 4x4, not finite, not a homogeneous transform, or its rotation is none.
    """
    T = np.asarray(T, dtype=np.float64)
    if T.shape != (4, 4):
        raise ConfigError("target", "T", f"shape {T.shape}", "give 4x4, row by row")
    if not np.isfinite(T).all():
        raise ConfigError("target", "T", "holds a number that is not finite")
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0], rtol=0.0, atol=1e-9):
        raise ConfigError("target", "T", f"last row {T[3].tolist()}", "it must be 0 0 0 1")
    R = T[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    if off > ROTATION_SLACK:
        raise ConfigError("target", "T", f"not a rotation: R R^T is off 1 by {off:.3g}", f"at most {ROTATION_SLACK:g}")
    if np.linalg.det(R) < 0.0:
        raise ConfigError("target", "T", "not a rotation but a reflection", "the columns must be right-handed")
    U, _, V = np.linalg.svd(R)
    clean = T.copy()
    clean[:3, :3] = U @ V
    return Target(clean, turned=True)
