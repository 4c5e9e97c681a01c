"""Velocities and accelerations of the tool, and where the arm loses a direction.

The Jacobian J stands in chain.py. Its rate follows from every axis z_i turning with the joints before it, at
omega_{i-1}, and every origin moving with them:

    d(z_i)/dt = omega_{i-1} x z_i
    d(z_i x (p - o_i))/dt = (omega_{i-1} x z_i) x (p - o_i) + z_i x (v_tool - v_{o_i})
"""

from typing import NamedTuple

import numpy as np

from armctl.kinematics.chain import SerialChain, cross, jacobian, joint_axes
from armctl.kinematics.transform import FloatArray

# A singular value below this share of the largest counts as none.
RANK_TOLERANCE = 1e-9
# Joint rates are damped where the smallest singular value [m/rad] is below the first; at a singularity by the second.
DAMPING_REGION = 0.05
MOST_DAMPING = 0.05


class Dexterity(NamedTuple):
    """What the Jacobian allows at one configuration."""

    rank: int
    # Product of the singular values: sqrt(det(J J^T)), or sqrt(det(J^T J)) with fewer than six joints.
    manipulability: float
    singular_values: FloatArray


def dexterity(J: FloatArray) -> Dexterity:
    """Rank, manipulability (Yoshikawa) and singular values of a Jacobian, shape (6, n)."""
    values = np.asarray(np.linalg.svd(J, compute_uv=False), dtype=np.float64)
    rank = int((values > RANK_TOLERANCE * values[0]).sum()) if values[0] > 0.0 else 0
    return Dexterity(rank, float(np.prod(values)), values)


def tool_velocity(chain: SerialChain, q: FloatArray, q_rate: FloatArray) -> FloatArray:
    """Velocity [m/s] and angular velocity [rad/s] of the tool, shape (..., 6): J dq/dt."""
    return np.asarray((jacobian(chain, q) @ np.asarray(q_rate)[..., None])[..., 0])


def tool_acceleration(chain: SerialChain, q: FloatArray, q_rate: FloatArray, q_rate2: FloatArray) -> FloatArray:
    """Acceleration [m/s^2] and angular acceleration [rad/s^2] of the tool, shape (..., 6).

    J d2q/dt2 + dJ/dt dq/dt, for joint positions [rad], velocities and accelerations of shape (..., n).
    """
    pushed = jacobian(chain, q) @ np.asarray(q_rate2)[..., None]
    return np.asarray((pushed + jacobian_rate(chain, q, q_rate) @ np.asarray(q_rate)[..., None])[..., 0])


def jacobian_rate(chain: SerialChain, q: FloatArray, q_rate: FloatArray) -> FloatArray:
    """dJ/dt, shape (..., 6, n), of joint positions [rad] and velocities [rad/s], shape (..., n)."""
    q, q_rate = np.asarray(q, dtype=np.float64), np.asarray(q_rate, dtype=np.float64)
    flat, rates = q.reshape(-1, chain.n), q_rate.reshape(-1, chain.n).T
    axes, tool = joint_axes(chain, flat)
    v_tool = np.zeros((3, len(flat)))
    for (z, origin), rate in zip(axes, rates, strict=True):
        v_tool = v_tool + cross(z, tool - origin) * rate
    J_rate = np.empty((len(flat), 6, chain.n))
    omega, v_origin, before = np.zeros((3, len(flat))), np.zeros((3, len(flat))), np.zeros((3, 1))
    for i, ((z, origin), rate) in enumerate(zip(axes, rates, strict=True)):
        v_origin = v_origin + cross(omega, origin - before)
        before = origin
        z_rate = cross(omega, z)
        J_rate[:, :3, i] = (cross(z_rate, tool - origin) + cross(z, v_tool - v_origin)).T
        J_rate[:, 3:, i] = z_rate.T
        omega = omega + z * rate
    return J_rate.reshape(*q.shape[:-1], 6, chain.n)


def joint_rates(J: FloatArray, velocity: FloatArray) -> FloatArray:
    """Joint rates [rad/s] for a tool velocity, bounded near singularities.

    Least squares; where the smallest singular value falls below `DAMPING_REGION`, damped by
    lambda^2 = (1 - (s / region)^2) most^2 (Nakamura & Hanafusa), so that the rates stay below |velocity| / (2 lambda).

    Args:
        J: Jacobian, or some of its rows, shape (k, n).
        velocity: Wanted velocity, shape (k,).
    """
    U, values, VT = np.linalg.svd(J, full_matrices=False)
    least = float(values[-1])
    square = (1.0 - (least / DAMPING_REGION) ** 2) * MOST_DAMPING**2 if least < DAMPING_REGION else 0.0
    return np.asarray(VT.T @ (values / (values**2 + square) * (U.T @ velocity)))
