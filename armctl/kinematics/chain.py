"""Serial chains of revolute joints in Denavit-Hartenberg parameters, both conventions.

Standard:  A_i = Rz(theta_i) Tz(d_i) Tx(a_i) Rx(alpha_i)
Modified:  A_i = Rx(alpha_{i-1}) Tx(a_{i-1}) Rz(theta_i) Tz(d_i)

with theta_i = q_i + offset_i. Products are written out elementwise (no BLAS), so that the same input gives the
same bits for one pose and for a batch.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Literal

import numpy as np

from armctl.kinematics.transform import FloatArray


@dataclass(frozen=True)
class DHRow:
    """One row of a Denavit-Hartenberg table; lengths in metres, angles in radians."""

    a: float = 0.0
    alpha: float = 0.0
    d: float = 0.0
    offset: float = 0.0


@dataclass(frozen=True)
class SerialChain:
    """A Denavit-Hartenberg table and its convention."""

    rows: tuple[DHRow, ...]
    convention: Literal["standard", "modified"] = "standard"

    @property
    def n(self) -> int:
        return len(self.rows)

    @cached_property
    def _alpha_trig(self) -> tuple[tuple[float, float], ...]:
        # The alphas of real arms are multiples of 90 deg: keep their sines and cosines exact.
        pairs = []
        for row in self.rows:
            quarter = row.alpha / (np.pi / 2.0)
            if abs(quarter - round(quarter)) < 1e-12:
                pairs.append(((1.0, 0.0), (0.0, 1.0), (-1.0, 0.0), (0.0, -1.0))[round(quarter) % 4])
            else:
                pairs.append((float(np.cos(row.alpha)), float(np.sin(row.alpha))))
        return tuple(pairs)


def link_transforms(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Transform of every link frame to the one before it.

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        A, shape (..., n, 4, 4); translation in metres.
    Raises:
        ValueError: the last axis of q is not n.
    """
    q = np.asarray(q, dtype=np.float64)
    if q.ndim == 0 or q.shape[-1] != chain.n:
        raise ValueError(f"q has shape {q.shape}; the last axis must be {chain.n}, the chain's joints")
    A = np.zeros((*q.shape, 4, 4))
    A[..., 3, 3] = 1.0
    for i, row in enumerate(chain.rows):
        c, s = np.cos(q[..., i] + row.offset), np.sin(q[..., i] + row.offset)
        ca, sa = chain._alpha_trig[i]
        Ai = A[..., i, :, :]
        if chain.convention == "standard":
            Ai[..., 0, 0], Ai[..., 0, 1], Ai[..., 0, 2], Ai[..., 0, 3] = c, -s * ca, s * sa, row.a * c
            Ai[..., 1, 0], Ai[..., 1, 1], Ai[..., 1, 2], Ai[..., 1, 3] = s, c * ca, -c * sa, row.a * s
            Ai[..., 2, 1], Ai[..., 2, 2], Ai[..., 2, 3] = sa, ca, row.d
        else:
            Ai[..., 0, 0], Ai[..., 0, 1], Ai[..., 0, 3] = c, -s, row.a
            Ai[..., 1, 0], Ai[..., 1, 1], Ai[..., 1, 2], Ai[..., 1, 3] = s * ca, c * ca, -sa, -row.d * sa
            Ai[..., 2, 0], Ai[..., 2, 1], Ai[..., 2, 2], Ai[..., 2, 3] = s * sa, c * sa, ca, row.d * ca
    return A


def link_frames(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Pose of the base (index 0) and of every link frame in the base frame.

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        T_base_link, shape (..., n + 1, 4, 4).
    Raises:
        ValueError: the last axis of q is not n.
    """
    A = link_transforms(chain, q)
    T = np.empty((*A.shape[:-3], chain.n + 1, 4, 4))
    T[..., 0, :, :] = np.eye(4)
    for i in range(chain.n):
        T[..., i + 1, :, :] = _product(T[..., i, :, :], A[..., i, :, :])
    return T


def forward_kinematics(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Tool pose in the base frame.

    Product of the link transforms, Raharjo et al. eq. (6).

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        T_base_tool, shape (..., 4, 4); translation in metres.
    Raises:
        ValueError: the last axis of q is not n.
    """
    return link_frames(chain, q)[..., -1, :, :]


def tool_position(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Tool point in the base frame [m], shape (..., 3), of joint positions q [rad], shape (..., n)."""
    return forward_kinematics(chain, q)[..., :3, 3]


def _product(A: FloatArray, B: FloatArray) -> FloatArray:
    """A @ B of homogeneous transforms, summed in a fixed order."""
    C = A[..., :, 0, None] * B[..., None, 0, :]
    for k in range(1, 4):
        C += A[..., :, k, None] * B[..., None, k, :]
    return C


def jacobian(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Geometric Jacobian of the tool frame in the base frame, by vector products (Lu & Liu eq. 8).

    Args:
        q: Joint positions [rad], shape (..., n).
    Returns:
        J, shape (..., 6, n): rows 0..2 velocity [m/rad], rows 3..5 angular velocity [rad/rad].
    Raises:
        ValueError: the last axis of q is not n.
    """
    T = link_frames(chain, q)
    # Joint i turns about z of frame i - 1 (standard) or of its own frame i (modified).
    axes = T[..., :-1, :, :] if chain.convention == "standard" else T[..., 1:, :, :]
    z = axes[..., :3, 2]
    lever = T[..., -1:, :3, 3] - axes[..., :3, 3]
    J = np.empty((*np.shape(q)[:-1], 6, chain.n))
    J[..., :3, :] = np.swapaxes(np.cross(z, lever), -1, -2)
    J[..., 3:, :] = np.swapaxes(z, -1, -2)
    return J
