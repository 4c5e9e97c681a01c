"""Numeric inverse kinematics for any chain: damped least squares on the tool's position, or on its whole pose.

Levenberg-Marquardt: the damping falls while steps help and rises when one does not. Position errors count in units of
the arm's length, so that a turn does not outweigh them.
"""

import math

import numpy as np

from armctl.errors import UnreachableTarget
from armctl.kinematics.chain import SerialChain, forward_kinematics, jacobian, link_frames, tool_position
from armctl.kinematics.transform import FloatArray, rotation_error

# A joint whose range is at least this wide has no ends.
TURN_RAD = 2.0 * np.pi - 1e-9
# Largest error, in arm lengths and radians, at which a pose is refined no further.
REFINED = 1e-13


def solve_position(
    chain: SerialChain,
    target: FloatArray,
    q_start: FloatArray,
    limits: FloatArray,
    *,
    tolerance_m: float = 1e-9,
    iterations: int = 200,
) -> FloatArray:
    """Joint positions near `q_start` that put the tool point on `target`.

    Damped least squares (Levenberg-Marquardt damping), joints clamped to their limits.

    Args:
        target: Tool point in the base frame [m], shape (3,).
        q_start: Where the search begins [rad], shape (n,).
        limits: Lowest and highest position [rad], shape (n, 2).
    Returns:
        q, shape (n,), within limits.
    Raises:
        UnreachableTarget: no solution was found; carries the least distance seen.
    """
    low, high = limits[:, 0], limits[:, 1]
    q = np.minimum(np.maximum(q_start, low), high)
    damping = 1e-4
    error = target - tool_position(chain, q)
    distance = math.hypot(*error)
    for _ in range(iterations):
        if distance <= tolerance_m:
            return q
        J = jacobian(chain, q)[:3]
        # A joint pressed against its limit cannot help: take it out of the step.
        step = np.zeros(chain.n)
        free = np.ones(chain.n, dtype=bool)
        for _ in range(chain.n):
            Jf = J[:, free]
            step[:] = 0.0
            step[free] = (_divided(Jf, damping, error)[:, None] * Jf).sum(axis=0)
            blocked = free & (((q <= low) & (step < 0.0)) | ((q >= high) & (step > 0.0)))
            if not blocked.any() or blocked.sum() == free.sum():
                break
            free &= ~blocked
        candidate = np.minimum(np.maximum(q + step, low), high)
        candidate_error = target - tool_position(chain, candidate)
        candidate_distance = math.hypot(*candidate_error)
        if candidate_distance < distance:
            q, error, distance = candidate, candidate_error, candidate_distance
            damping = max(damping * 0.3, 1e-12)
        else:
            damping = min(damping * 10.0, 1e3)
    if distance <= tolerance_m:
        return q
    raise unreachable(target, distance, " within the joint limits")


def _divided(J: FloatArray, damping: float, error: FloatArray) -> FloatArray:
    """(J J' + damping I)^-1 error of three rows J, shape (3, n), by Cramer's rule: the same bits on every processor.

    LAPACK's depend on the processor, and by them what a simulated hand does.
    """
    (a, h, g), (_, b, f), (_, _, c) = ((J[:, None, :] * J).sum(axis=-1) + damping * np.eye(3)).tolist()
    x, y, z = error.tolist()
    A, B, C, F, G, H = b * c - f * f, c * a - g * g, a * b - h * h, g * h - a * f, h * f - b * g, f * g - c * h
    size = a * A + h * H + g * G
    return np.array([A * x + H * y + G * z, H * x + B * y + F * z, G * x + F * y + C * z]) / float(size)


def unreachable(target: FloatArray, near_m: float, more: str = "") -> UnreachableTarget:
    """The refusal of a target to which the tool comes no nearer than this."""
    x, y, z = target
    distance = f"{near_m * 1000.0:.1f} mm{more}"
    return UnreachableTarget(f"target ({x:.4f}, {y:.4f}, {z:.4f}) m: the tool comes no nearer than {distance}", near_m)


def pointing(chain: SerialChain) -> FloatArray:
    """Where the tool points in its own frame: from the last joint to the tool point, unit vector, shape (3,).

    Along z, the last joint's axis, where the tool point stands on it at that joint's frame.
    """
    frames = link_frames(chain, np.zeros(chain.n))
    out = frames[-1, :3, :3].T @ (frames[-1, :3, 3] - frames[chain.n - 1 + chain.first_axis, :3, 3])
    length = float(np.linalg.norm(out))
    return np.asarray(out / length) if length > 1e-9 else np.array([0.0, 0.0, 1.0])


def turn_left(chain: SerialChain, R: FloatArray, T: FloatArray, direction: FloatArray | None) -> FloatArray:
    """The turn [rad] in the base frame that the tool at rotations R still has to make, shape (..., 3).

    To the rotations of T, shape (..., 4, 4), or only so far that it points in a direction, unit vector.
    """
    if direction is None:
        return rotation_error(R, T[..., :3, :3])
    points = R @ pointing(chain)
    axis, cosine = np.cross(points, direction), points @ direction
    sine = np.linalg.norm(axis, axis=-1)
    # Opposite to it there is no shortest way: any turn about what lies across will do.
    across = np.cross(direction, np.eye(3)[np.abs(direction).argmin()])
    axis = np.where(((sine < 1e-9) & (cosine < 0.0))[..., None], across, axis)
    return np.asarray(axis * (np.arctan2(sine, cosine) / np.maximum(np.linalg.norm(axis, axis=-1), 1e-300))[..., None])


def pose_errors(
    chain: SerialChain, q: FloatArray, T: FloatArray, direction: FloatArray | None = None
) -> tuple[FloatArray, FloatArray]:
    """Distance [m] and turn [rad] between the tool at q, shape (..., n), and poses T, shape (..., 4, 4).

    Args:
        direction: The turn is that to point in it, unit vector in the base frame; None: that to the poses' rotation.
    """
    reached = forward_kinematics(chain, q)
    turn = turn_left(chain, reached[..., :3, :3], T, direction)
    return np.linalg.norm(reached[..., :3, 3] - T[..., :3, 3], axis=-1), np.linalg.norm(turn, axis=-1)


def refine_poses(
    chain: SerialChain,
    T: FloatArray,
    q_start: FloatArray,
    limits: FloatArray,
    *,
    turned: bool = True,
    direction: FloatArray | None = None,
    iterations: int = 60,
) -> FloatArray:
    """Joint configurations near the starts that bring the tool as near to the poses as they go.

    Args:
        T: Wanted tool poses, shape (m, 4, 4).
        q_start: Where each search begins [rad], shape (m, n).
        limits: Lowest and highest position [rad], shape (n, 2); a joint with a whole turn is not clamped.
        turned: Whether the rotation counts; without it the position alone does.
        direction: Of the rotation only where the tool points counts, and this is where, unit vector in the base frame.
    Returns:
        q, shape (m, n): never worse than the (clamped) start.
    """
    turning = limits[:, 1] - limits[:, 0] >= TURN_RAD
    low, high = np.where(turning, -np.inf, limits[:, 0]), np.where(turning, np.inf, limits[:, 1])
    q = np.clip(np.asarray(q_start, dtype=np.float64), low, high)
    weights = np.array([1.0 / max(chain.reach_m, 1e-9)] * 3 + [1.0 if turned else 0.0] * 3)
    error = _weighted_error(chain, q, T, weights, direction)
    cost = (error**2).sum(axis=-1)
    damping = np.full(len(q), 1e-6)
    for _ in range(iterations):
        active = np.flatnonzero((cost > REFINED**2) & (damping < 1e5))
        if not len(active):
            break
        J = masked_jacobian(chain, q[active], direction) * weights[:, None]
        JT = np.swapaxes(J, -1, -2)
        gradient = (JT @ error[active][..., None])[..., 0]
        # A joint pressed against its limit cannot help: its row and column leave the step.
        held = ((q[active] <= low) & (gradient < 0.0)) | ((q[active] >= high) & (gradient > 0.0))
        gradient[held] = 0.0
        gram = JT @ J
        gram[held[:, :, None] | held[:, None, :]] = 0.0
        gram[:, np.arange(chain.n), np.arange(chain.n)] += damping[active][:, None] + held
        candidate = np.clip(q[active] + np.linalg.solve(gram, gradient[..., None])[..., 0], low, high)
        candidate_error = _weighted_error(chain, candidate, T[active], weights, direction)
        candidate_cost = (candidate_error**2).sum(axis=-1)
        better = candidate_cost < cost[active]
        chosen = active[better]
        q[chosen], error[chosen], cost[chosen] = candidate[better], candidate_error[better], candidate_cost[better]
        damping[active] = np.where(better, np.maximum(damping[active] * 0.1, 1e-15), damping[active] * 10.0)
    return within_a_turn(q, limits)


def within_a_turn(q: FloatArray, limits: FloatArray) -> FloatArray:
    """The same configurations, each angle moved by whole turns to where its range has it, or else to +-pi."""
    turn = 2.0 * np.pi
    near = q - turn * np.round(q / turn)
    low, high = limits[:, 0] - 1e-9, limits[:, 1] + 1e-9
    for shifted in (near + turn, near - turn):
        near = np.where(((near < low) | (near > high)) & (shifted >= low) & (shifted <= high), shifted, near)
    return np.asarray(near)


def masked_jacobian(chain: SerialChain, q: FloatArray, direction: FloatArray | None) -> FloatArray:
    """The Jacobian, shape (..., 6, n), without turns about the direction in which the tool is to point."""
    J = jacobian(chain, q)
    if direction is not None:
        J[..., 3:, :] -= direction[:, None] * (direction @ J[..., 3:, :])[..., None, :]
    return J


def _weighted_error(
    chain: SerialChain, q: FloatArray, T: FloatArray, weights: FloatArray, direction: FloatArray | None
) -> FloatArray:
    reached = forward_kinematics(chain, q)
    gap = T[:, :3, 3] - reached[:, :3, 3]
    return np.concatenate((gap, turn_left(chain, reached[:, :3, :3], T, direction)), axis=1) * weights
