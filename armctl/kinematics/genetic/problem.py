"""What a chromosome is worth: targets, the joints that are searched, and the error to make small.

The error of a pose is eq. (4) of the improved algorithm's paper, the squared differences of n, o and a plus k times
those of p; that of a point is the squared distance alone, what eq. (18) of Xiang Yao et al. means (as printed it holds
the height only).
"""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np

from armctl.kinematics.chain import SerialChain, forward_kinematics, jacobian, tool_position
from armctl.kinematics.genetic.chromosomes import Coding, Words
from armctl.kinematics.inverse import within_a_turn
from armctl.kinematics.transform import FloatArray

MOVES_M = 1e-12


@dataclass(frozen=True, eq=False)
class Problem:
    """As many targets as runs, for one chain."""

    chain: SerialChain
    # Wanted tool poses, shape (runs, 4, 4); of points the rotation is left out.
    T: FloatArray
    # Whether the rotation counts.
    turned: bool
    # Joint ranges, shape (n, 2).
    limits_rad: FloatArray
    # Where the joints stand that are not searched, shape (runs, n).
    base_rad: FloatArray
    # Joints that are searched.
    free: tuple[int, ...]
    # k of eq. (4) [1/m^2].
    position_weight: float = 1.0

    def configurations(self, angles: FloatArray) -> FloatArray:
        """Joint positions [rad], shape (runs, individuals, n), of the free joints' angles."""
        q = np.repeat(self.base_rad[:, None], angles.shape[1], axis=1)
        q[..., self.free] = angles
        return q

    def cost(self, q: FloatArray) -> FloatArray:
        """Error of configurations, shape (runs, individuals, n) -> (runs, individuals); metres squared for points."""
        if not self.turned:
            gap = tool_position(self.chain, q) - self.T[:, None, :3, 3]
            return np.asarray((gap**2).sum(axis=-1))
        gap = forward_kinematics(self.chain, q)[..., :3, :] - self.T[:, None, :3, :]
        squares = (gap**2).sum(axis=-2)
        return np.asarray(squares[..., :3].sum(axis=-1) + self.position_weight * squares[..., 3])  # (eq. 4)


class Evolution(NamedTuple):
    """What came out of every run."""

    # Best configuration, shape (runs, n).
    q_rad: FloatArray
    # Its error, shape (runs,).
    cost: FloatArray
    # Least error found so far, shape (generations, runs).
    best_cost: FloatArray
    # Mean error of the population, shape (generations, runs).
    mean_cost: FloatArray


class Course:
    """What the generations of every run find, the best kept."""

    def __init__(self, problem: Problem, coding: Coding, runs: int) -> None:
        """
        Raises:
            ValueError: other than one run a target.
        """
        if runs != len(problem.T):
            raise ValueError(f"{runs} seeds for {len(problem.T)} targets")
        self._problem, self._coding = problem, coding
        self._best: Words = np.zeros((runs, coding.joints), dtype=np.uint32)
        self._cost: FloatArray = np.full(runs, np.inf)
        self._best_cost: list[FloatArray] = []
        self._mean_cost: list[FloatArray] = []

    def judged(self, words: Words) -> FloatArray:
        """Errors of the next generation, shape (runs, individuals, joints) -> (runs, individuals)."""
        cost = self._problem.cost(self._problem.configurations(self._coding.angles(words)))
        every, first = np.arange(len(cost)), cost.argmin(axis=1)
        least = cost[every, first]
        self._best = np.where((least < self._cost)[:, None], words[every, first], self._best)
        self._cost = np.minimum(least, self._cost)
        self._best_cost.append(self._cost)
        self._mean_cost.append(cost.mean(axis=1))
        return cost

    def evolution(self) -> Evolution:
        """What came out of the generations judged so far."""
        q = self._problem.configurations(self._coding.angles(self._best[:, None]))[:, 0]
        return Evolution(q, self._cost, np.array(self._best_cost), np.array(self._mean_cost))


def points_problem(
    chain: SerialChain, points_m: FloatArray, limits_rad: FloatArray, present_rad: FloatArray | None = None
) -> Problem:
    """Points [m], shape (runs, 3); joints that do not move the tool point stay at `present_rad`, shape (n,).

    Without it they stay in the middle of their ranges.
    """
    T = np.repeat(np.eye(4)[None], len(points_m), axis=0)
    T[:, :3, 3] = points_m
    base = np.repeat((limits_rad.mean(axis=1) if present_rad is None else present_rad)[None], len(points_m), axis=0)
    return Problem(chain, T, False, limits_rad, base, moving(chain))


def poses_problem(chain: SerialChain, T: FloatArray, limits_rad: FloatArray, position_weight: float) -> Problem:
    """Poses, shape (runs, 4, 4); every joint is searched."""
    base = np.repeat(limits_rad.mean(axis=1)[None], len(T), axis=0)
    return Problem(chain, T, True, limits_rad, base, tuple(range(chain.n)), position_weight)


def behind_the_waist(problem: Problem) -> Problem:
    """The same points with the first joint turned towards them (Xiang Yao et al. eq. 12) and no longer searched.

    For arms whose other joints stay in the waist's plane. The ranges of eq. (18) are those of theta2 to theta4 alone:
    this is how the paper can be read too.
    """
    base = problem.base_rad.copy()
    base[:, 0] = np.arctan2(problem.T[:, 1, 3], problem.T[:, 0, 3])  # (eq. 12)
    base = within_a_turn(base, problem.limits_rad)
    return replace(problem, base_rad=base, free=tuple(joint for joint in problem.free if joint != 0))


def moving(chain: SerialChain) -> tuple[int, ...]:
    """The joints that move the tool point."""
    q = np.random.default_rng(0).uniform(-np.pi, np.pi, (8, chain.n))
    return tuple(int(joint) for joint in np.flatnonzero(np.abs(jacobian(chain, q)[:, :3]).max(axis=(0, 1)) > MOVES_M))
