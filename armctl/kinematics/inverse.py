"""Numeric inverse kinematics for any chain: damped least squares on the tool position."""

from __future__ import annotations

import numpy as np

from armctl.errors import UnreachableTarget
from armctl.kinematics.chain import SerialChain, jacobian, tool_position
from armctl.kinematics.transform import FloatArray


def solve_position(
    chain: SerialChain,
    target: FloatArray,
    q_start: FloatArray,
    limits: FloatArray,
    *,
    tolerance_m: float = 1e-9,
    iterations: int = 200,
    rest: FloatArray | None = None,
    rest_gain: float = 0.0,
) -> FloatArray:
    """Joint positions near `q_start` that put the tool point on `target`.

    Damped least squares (Levenberg-Marquardt damping), joints clamped to their limits; what redundancy is left
    is pulled towards `rest` with `rest_gain`.

    Args:
        target: Tool point in the base frame [m], shape (3,).
        q_start: Where the search begins [rad], shape (n,).
        limits: Lowest and highest position [rad], shape (n, 2).
    Returns:
        q, shape (n,), within limits.
    Raises:
        UnreachableTarget: no solution was found; carries the least distance seen.
    """
    q = np.clip(np.asarray(q_start, dtype=np.float64), limits[:, 0], limits[:, 1])
    damping = 1e-4
    error = target - tool_position(chain, q)
    distance = float(np.linalg.norm(error))
    best, best_distance = q, distance
    for _ in range(iterations):
        if distance <= tolerance_m:
            return q
        J = jacobian(chain, q)[:3]
        # A joint pressed against its limit cannot help: take it out of the step.
        step = np.zeros(chain.n)
        free = np.ones(chain.n, dtype=bool)
        for _ in range(chain.n):
            Jf = J[:, free]
            gram = Jf @ Jf.T + damping * np.eye(3)
            step[:] = 0.0
            step[free] = Jf.T @ np.linalg.solve(gram, error)
            if rest is not None and rest_gain > 0.0 and distance > 100.0 * tolerance_m:
                pull = rest_gain * (rest - q)[free]
                step[free] += pull - Jf.T @ np.linalg.solve(gram, Jf @ pull)
            blocked = free & (((q <= limits[:, 0]) & (step < 0.0)) | ((q >= limits[:, 1]) & (step > 0.0)))
            if not blocked.any() or blocked.sum() == free.sum():
                break
            free &= ~blocked
        candidate = np.clip(q + step, limits[:, 0], limits[:, 1])
        candidate_error = target - tool_position(chain, candidate)
        candidate_distance = float(np.linalg.norm(candidate_error))
        if candidate_distance < distance:
            q, error, distance = candidate, candidate_error, candidate_distance
            damping = max(damping * 0.3, 1e-12)
        else:
            damping = min(damping * 10.0, 1e3)
        if distance < best_distance:
            best, best_distance = q, distance
    if best_distance <= tolerance_m:
        return best
    raise UnreachableTarget(
        f"target ({target[0]:.4f}, {target[1]:.4f}, {target[2]:.4f}) m: the tool comes no nearer than "
        f"{best_distance * 1000.0:.1f} mm within the joint limits",
        best_distance,
    )
