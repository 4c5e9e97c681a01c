"""Via points placed off the line, so that the interpolated and lagging motion is on it.

Between via points joints are interpolated, which bends the tool's path; below its goals an arm sags and lags. Neither
has to cost anything: the waypoints W are chosen such that what the arm will do, q(t) = Phi(t) W - lag(t), keeps the
tool on AB. Phi is the interpolation's basis, so the tool's derivative by W is J(q) Phi, and Gauss-Newton converges in
a few steps. Deviations across the line count in full, at the ends and along the line as far as the weights say; what
redundancy is left stays where it was.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np

from armctl.kinematics.chain import SerialChain, jacobian, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.straightness import distance_to_line

Objective = Literal["mean", "mix", "max"]
_POWER: dict[Objective, float] = {"mean": 1.0, "mix": 2.0, "max": 10.0}
"""The p-norm of the distances that is made small."""
ALONG = 0.05
"""Weight of being early or late on the line, against being off it."""
END = 1.0
"""Weight of the ends themselves, along the line as well."""
HELD_END = 30.0
"""That weight where there are no points in between: the path bows, and a shorter one beside A and B would bow less."""
STAY_M_RAD = 0.002
"""What moving a waypoint by a radian without need would cost: keeps redundancy where it is."""
STEPS = 12
SETTLED = 1e-5
"""A step this small [rad, and of progress] is the last."""
CLOSEST_KNOTS = 0.06
"""Least progress between two waypoints."""


@dataclass(frozen=True, eq=False)
class Placement:
    """Waypoints [rad], shape (k, n), at progress `knots` (k,), and the distances [m] predicted for them, shape (m,)."""

    waypoints: FloatArray
    knots: FloatArray
    distance_m: FloatArray


def place(
    chain: SerialChain,
    waypoints: FloatArray,
    knots: FloatArray,
    kind: Interpolation,
    A: FloatArray,
    B: FloatArray,
    limits: FloatArray,
    lag: FloatArray | None = None,
    *,
    offset_m: FloatArray | None = None,
    held: FloatArray | None = None,
    objective: Objective = "mix",
    move_knots: bool = True,
    stay_m_rad: float = STAY_M_RAD,
) -> Placement:
    """Waypoints near the given ones whose motion, less the lag, is straightest.

    Args:
        waypoints: Where to begin [rad], shape (k, n).
        knots: Their progress, shape (k,).
        limits: Of the joints [rad], shape (n, 2).
        lag: By how much each joint stays behind its goal [rad] at even times, shape (m, n); None: not at all.
        offset_m: Where the tool is, less where the joints would have it [m], shape (m, 3); None: the same place.
        held: 1 for a joint whose waypoints stay as they are, else 0, shape (n,); None: all may move.
        move_knots: Whether inner waypoints may be reached earlier or later.
    """
    n, k = chain.n, len(knots)
    lag = np.zeros((201, n)) if lag is None else lag
    m = len(lag)
    offset = np.zeros((m, 3)) if offset_m is None else offset_m
    moving = np.ones(n) if held is None else 1.0 - held
    s = time_law(np.linspace(0.0, 1.0, m))
    length = float(np.linalg.norm(B - A))
    along = (B - A) / length
    power = _POWER[objective]
    at_end = np.zeros(m)
    end = END if k > 2 else HELD_END
    at_end[[0, -1]] = np.sqrt(m / 20.0) * end
    begin, W, tau = waypoints, np.array(waypoints, dtype=np.float64), np.array(knots, dtype=np.float64)
    free = k - 2 if move_knots and k > 2 else 0
    each = not free and k == m and bool((np.abs(tau - s) < 1e-12).all())  # a goal every tick: Phi is the identity

    def tool(W: FloatArray, tau: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        phi = joint_path(np.eye(k), tau, s, kind)
        q = phi @ W - lag
        return phi, q, tool_position(chain, q) + offset

    def weighted(points: FloatArray, weight: FloatArray) -> FloatArray:
        """Residuals, shape (m, 4): across the line (three components of two dimensions), and along it."""
        off = points - A - s[:, None] * (B - A)
        forward = off @ along
        across = off - forward[:, None] * along
        return np.concatenate([across * (weight + at_end)[:, None], (forward * (ALONG + at_end))[:, None]], axis=1)

    def cost_m(points: FloatArray, distance: FloatArray) -> float:
        if k > 2:
            return _norm(distance, power)
        missed = np.sqrt(m / 20.0) * end * np.linalg.norm(points[[0, -1]] - [A, B], axis=1)
        return _norm(np.concatenate([distance, missed]), power)

    best = Placement(W, tau, distance_to_line(tool(W, tau)[2], A, B))
    best_cost = np.inf
    damping = 1e-6 if k > 2 else 1e-3  # a bow that cannot be removed would drive what redundancy there is about
    weight = np.ones(m)
    for _ in range(STEPS):
        phi, q, points = tool(W, tau)
        distance = distance_to_line(points, A, B)
        cost = cost_m(points, distance)
        if cost < best_cost:
            best, best_cost = Placement(W, tau, distance), cost
        if power != 2.0:
            weight = (distance / max(float(distance.max()), 1e-6) + 0.05) ** ((power - 2.0) / 2.0)
            weight /= np.sqrt((weight**2).mean())
        r = weighted(points, weight)
        J = jacobian(chain, q)[:, :3]
        forward = along @ J
        across = J - along[:, None] * forward[:, None, :]
        rows = np.concatenate(
            [across * (weight + at_end)[:, None, None], (forward * (ALONG + at_end)[:, None])[:, None]], axis=1
        )
        rows_W = rows * moving
        if each:
            step = _step_each(rows_W, r, W - begin, stay_m_rad**2 * m, damping * m)
            W = np.clip(W + np.clip(step, -0.3, 0.3), limits[:, 0], limits[:, 1])
            if float(np.abs(step).max()) < SETTLED:
                break
            continue
        by_W = rows_W[:, :, None, :] * phi[:, None, :, None]
        columns = [by_W.reshape(m * 4, k * n)]
        for i in range(1, free + 1):
            moved = tau.copy()
            moved[i] += 1e-4
            slope = (joint_path(np.eye(k), moved, s, kind) - phi) @ W / 1e-4
            columns.append((rows @ slope[..., None]).reshape(m * 4, 1))
        D = np.concatenate(columns, axis=1)
        stay = np.full(D.shape[1], stay_m_rad**2 * m)
        stay[k * n :] = (0.01**2) * m
        pull = np.concatenate([(W - begin).ravel(), (tau - knots)[1 : free + 1]])
        normal = D.T @ D + np.diag(stay + damping * m)
        step = -np.linalg.solve(normal, D.T @ r.ravel() + stay * pull)
        W = np.clip(W + np.clip(step[: k * n].reshape(k, n), -0.3, 0.3), limits[:, 0], limits[:, 1])
        if free:
            tau = tau.copy()
            tau[1:-1] += np.clip(step[k * n :], -0.05, 0.05)
            for i in range(1, k - 1):
                tau[i] = min(max(tau[i], tau[i - 1] + CLOSEST_KNOTS), 1.0 - CLOSEST_KNOTS * (k - 1 - i))
        if float(np.abs(step).max()) < SETTLED:
            break
    points = tool(W, tau)[2]
    distance = distance_to_line(points, A, B)
    return Placement(W, tau, distance) if cost_m(points, distance) < best_cost else best


def _step_each(rows: FloatArray, r: FloatArray, pull: FloatArray, stay: float, damping: float) -> FloatArray:
    """The step [rad], shape (m, n), where each instant has a waypoint of its own: the normal equations fall apart.

    Args:
        rows: Derivatives of the residuals by the joints, shape (m, 4, n).
        r: Residuals, shape (m, 4).
        pull: How far the waypoints are from where they began [rad], shape (m, n).
    """
    transposed = np.swapaxes(rows, 1, 2)
    normal = transposed @ rows + (stay + damping) * np.eye(rows.shape[2])
    gradient = transposed @ r[..., None] + stay * pull[..., None]
    return np.asarray(-np.linalg.solve(normal, gradient)[..., 0])


def _norm(distance: FloatArray, power: float) -> float:
    largest = max(float(distance.max()), 1e-12)
    return float(largest * float(((distance / largest) ** power).mean()) ** (1.0 / power))
