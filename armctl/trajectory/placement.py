"""Via points placed off the line, so that the interpolated and lagging motion is on it.

Between via points joints are interpolated, which bends the tool's path; below its goals an arm sags and lags. Both
can be made up for: the waypoints W are chosen such that what the arm will do, q(t) = Phi(t) W - lag(t), keeps the
tool on AB. Phi is the interpolation's basis, so the tool's derivative by W is J(q) Phi, and Gauss-Newton converges in
a few steps. Deviations across the line count in full, at the ends and along the line as far as the weights say; what
redundancy is left stays where it was.
"""

from typing import Literal, NamedTuple

import numpy as np

from armctl.kinematics.chain import SerialChain, jacobian, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.straightness import distance_to_line

Objective = Literal["mean", "mix", "max"]
# The p-norm of the distances that is made small; the 10-norm stands for the maximum.
POWER: dict[Objective, float] = {"mean": 1.0, "mix": 2.0, "max": 10.0}
# Weight of being early or late on the line, against being off it.
ALONG = 0.05
# Weight of the ends themselves, along the line as well.
END = 1.0
# The same weight where there are no points in between: the path bows, and a shorter one beside A and B bows less.
HELD_END = 30.0
# What moving a waypoint by a radian without need would cost: keeps redundancy where it is.
STAY_M_RAD = 0.002
STEPS = 12
# A step this small [rad, and of progress] is the last.
SETTLED = 1e-5
# Least progress between two waypoints.
CLOSEST_KNOTS = 0.06


class StraightMotion(NamedTuple):
    """A motion that shall be straight, and what keeps it from being so."""

    chain: SerialChain
    kind: Interpolation
    # Ends of the line [m], shape (3,).
    A: FloatArray
    B: FloatArray
    # Joint limits [rad], shape (n, 2).
    limits: FloatArray
    # By how much each joint stays behind its goal [rad] at even times, shape (m, n); None: not at all.
    lag: FloatArray | None = None
    # Where the tool is, less where the joints would have it [m], shape (m, 3); None: the same place.
    offset_m: FloatArray | None = None
    objective: Objective = "mix"


class Placement(NamedTuple):
    """Waypoints [rad], shape (k, n), at progress `knots` (k,), and the distances [m] predicted for them, shape (m,)."""

    waypoints: FloatArray
    knots: FloatArray
    distance_m: FloatArray


def place(
    motion: StraightMotion, W: FloatArray, knots: FloatArray, *, held: FloatArray | None = None, move_knots: bool = True
) -> Placement:
    """Waypoints near the given ones whose motion, less the lag, is straightest.

    Args:
        W: Waypoints where to begin [rad], shape (k, n).
        knots: Their progress, shape (k,).
        held: 1 for a joint whose waypoints stay as they are, else 0, shape (n,); None: all may move.
        move_knots: Whether inner waypoints may be reached earlier or later.
    """
    search = _Search(motion, np.array(W, dtype=np.float64), np.array(knots, dtype=np.float64), held)
    W, tau = search.begin, search.knots
    k, limits = len(tau), motion.limits
    free = k - 2 if move_knots and k > 2 else 0
    # A goal every tick: Phi is the identity.
    each = not free and k == len(search.s) and bool((np.abs(tau - search.s) < 1e-12).all())
    best, best_cost, settled = Placement(W, tau, np.full(len(search.s), np.nan)), np.inf, False
    for turn in range(STEPS + 1):
        phi, q, points = search.tool(W, tau)
        distance = distance_to_line(points, motion.A, motion.B)
        cost = search.cost_m(points, distance)
        if cost < best_cost:
            best, best_cost = Placement(W, tau, distance), cost
        if settled or turn == STEPS:
            break
        r, rows = search.linear(q, points, distance)
        step = search.step_each(r, rows, W) if each else search.step(r, rows, W, tau, phi, free)
        W = np.clip(W + np.clip(step[: W.size].reshape(W.shape), -0.3, 0.3), limits[:, 0], limits[:, 1])
        if free:
            tau = tau.copy()
            tau[1:-1] += np.clip(step[W.size :], -0.05, 0.05)
            for i in range(1, k - 1):
                tau[i] = min(max(tau[i], tau[i - 1] + CLOSEST_KNOTS), 1.0 - CLOSEST_KNOTS * (k - 1 - i))
        settled = float(np.abs(step).max()) < SETTLED
    return best


class _Search:
    """The least squares problem: what stays the same from step to step, and one step."""

    def __init__(self, motion: StraightMotion, begin: FloatArray, knots: FloatArray, held: FloatArray | None) -> None:
        n, between = motion.chain.n, len(knots) > 2
        self.motion, self.begin, self.knots = motion, begin, knots
        self.moving = np.ones(n) if held is None else 1.0 - held
        self.lag = np.zeros((201, n)) if motion.lag is None else motion.lag
        m = len(self.lag)
        self.offset_m = np.zeros((m, 3)) if motion.offset_m is None else motion.offset_m
        self.s = time_law(np.linspace(0.0, 1.0, m))
        self.along = (motion.B - motion.A) / float(np.linalg.norm(motion.B - motion.A))
        self.power = POWER[motion.objective]
        self.end = np.sqrt(m / 20.0) * (END if between else HELD_END)
        self.at_end = np.zeros(m)
        self.at_end[[0, -1]] = self.end
        self.stay = STAY_M_RAD**2 * m
        # With the ends alone the path keeps its bow; without damping the search would move the free joints for nothing.
        self.damping = (1e-6 if between else 1e-3) * m

    def tool(self, W: FloatArray, tau: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Phi, shape (m, k), the joints [rad], shape (m, n), and the tool points [m], shape (m, 3)."""
        phi = joint_path(np.eye(len(tau)), tau, self.s, self.motion.kind)
        q = phi @ W - self.lag
        return phi, q, tool_position(self.motion.chain, q) + self.offset_m

    def cost_m(self, points: FloatArray, distance: FloatArray) -> float:
        """The p-norm of the distances; without points in between the ends' own distances count too."""
        if len(self.knots) > 2:
            return _norm(distance, self.power)
        missed = self.end * np.linalg.norm(points[[0, -1]] - [self.motion.A, self.motion.B], axis=1)
        return _norm(np.concatenate([distance, missed]), self.power)

    def linear(self, q: FloatArray, points: FloatArray, distance: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Residuals, shape (m, 4), and their derivatives by the joints, shape (m, 4, n).

        Across the line (three components of two dimensions), and along it.
        """
        weight = np.ones(len(distance))
        if self.power != 2.0:
            weight = (distance / max(float(distance.max()), 1e-6) + 0.05) ** ((self.power - 2.0) / 2.0)
            weight /= np.sqrt((weight**2).mean())
        by_across, by_forward = weight + self.at_end, ALONG + self.at_end
        A, B, along = self.motion.A, self.motion.B, self.along
        off = points - A - self.s[:, None] * (B - A)
        forward = off @ along
        across = off - forward[:, None] * along
        r = np.concatenate([across * by_across[:, None], (forward * by_forward)[:, None]], axis=1)
        J = jacobian(self.motion.chain, q)[:, :3]
        forward = along @ J
        across = J - along[:, None] * forward[:, None, :]
        return r, np.concatenate([across * by_across[:, None, None], (forward * by_forward[:, None])[:, None]], axis=1)

    def step(
        self, r: FloatArray, rows: FloatArray, W: FloatArray, tau: FloatArray, phi: FloatArray, free: int
    ) -> FloatArray:
        """The Gauss-Newton step: of the waypoints [rad], row by row, and of `free` inner knots."""
        (m, k), size = phi.shape, W.size
        columns = [((rows * self.moving)[:, :, None, :] * phi[:, None, :, None]).reshape(m * 4, size)]
        for i in range(1, free + 1):
            moved = tau.copy()
            moved[i] += 1e-4
            slope = (joint_path(np.eye(k), moved, self.s, self.motion.kind) - phi) @ W / 1e-4
            columns.append((rows @ slope[..., None]).reshape(m * 4, 1))
        D = np.concatenate(columns, axis=1)
        stay = np.full(D.shape[1], self.stay)
        stay[size:] = (0.01**2) * m
        pull = np.concatenate([(W - self.begin).ravel(), (tau - self.knots)[1 : free + 1]])
        return np.asarray(-np.linalg.solve(D.T @ D + np.diag(stay + self.damping), D.T @ r.ravel() + stay * pull))

    def step_each(self, r: FloatArray, rows: FloatArray, W: FloatArray) -> FloatArray:
        """The same step where each instant has a waypoint of its own: the normal equations fall apart."""
        rows = rows * self.moving
        transposed = np.swapaxes(rows, 1, 2)
        normal = transposed @ rows + (self.stay + self.damping) * np.eye(rows.shape[2])
        gradient = transposed @ r[..., None] + self.stay * (W - self.begin)[..., None]
        return np.asarray(-np.linalg.solve(normal, gradient)[..., 0].ravel())


def _norm(distance: FloatArray, power: float) -> float:
    largest = max(float(distance.max()), 1e-12)
    return float(largest * float(((distance / largest) ** power).mean()) ** (1.0 / power))
