"""Where the tool can be within the joint ranges: exact extents, a random cloud, a map of a grid.

Exact extents. Turning one joint alone moves the tool on a circle, so a coordinate of it is A + B cos t + C sin t, whose
greatest value on a range is known. Taking the joints in turn never lowers the coordinate and ends where no single
joint improves it; from many random starts at once the best end is the extent. The last digits come from taking turns
until nothing moves.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.errors import ConfigError
from armctl.kinematics.chain import SerialChain, blocks, cross, joint_axes, tool_position
from armctl.kinematics.inverse import TURN_RAD, within_a_turn
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import within_limits
from armctl.kinematics.transform import FloatArray

STARTS = 256
ROUNDS = 400
SETTLED_M = 1e-15
# Points of a map worked on together.
GRID_BLOCK = 16


class ReachabilityMap(NamedTuple):
    """For every point of a grid, which share of the configurations tried there keeps the joint ranges."""

    # Shape (m, 3).
    points_m: FloatArray
    # Shape (m,); 0: out of reach.
    share: FloatArray

    @property
    def reachable(self) -> NDArray[np.bool_]:
        return np.asarray(self.share > 0.0)


def extents(chain: SerialChain, limits: FloatArray, rng: np.random.Generator) -> FloatArray:
    """Least and greatest x, y and z of the tool [m], shape (3, 2), over the joint ranges [rad], shape (n, 2)."""
    # The sum makes a zero of what would be -0.
    found = [[sign * _furthest(chain, limits, sign * axis + 0.0, rng) for sign in (-1.0, 1.0)] for axis in np.eye(3)]
    return np.array(found)


def cloud(chain: SerialChain, limits: FloatArray, samples: int, rng: np.random.Generator) -> FloatArray:
    """Tool points [m] of random configurations, shape (samples, 3) (Bao, Liu & Zhao eq. 12)."""
    return tool_position(chain, rng.uniform(limits[:, 0], limits[:, 1], (samples, chain.n)))


def cloud_extents(points: FloatArray) -> FloatArray:
    """Least and greatest coordinate of points, shape (3, 2)."""
    return np.stack((points.min(axis=0), points.max(axis=0)), axis=1)


def reachability(robot: Robot, points: FloatArray, limits: FloatArray | None = None) -> ReachabilityMap:
    """Which points [m], shape (m, 3), the tool reaches within the joint ranges, and how freely.

    Raises:
        ConfigError: the robot has no closed form.
    """
    form, limits = robot.closed_form, robot.limits_rad if limits is None else limits
    if form is None:
        raise ConfigError(robot.name, "", "no closed form to map its reach with")
    share = np.empty(len(points))
    for block in blocks(len(points), GRID_BLOCK):
        q = form.positions(points[block])
        q = q.reshape(len(q), -1, q.shape[-1])
        share[block] = within_limits(within_a_turn(q, limits), limits).mean(axis=1)
    return ReachabilityMap(np.asarray(points, dtype=np.float64), share)


def grid(extent_m: FloatArray, per_axis: int) -> FloatArray:
    """Points of a regular grid over extents, shape (3, 2) -> (per_axis^3, 3)."""
    axes = [np.linspace(low, high, per_axis) for low, high in extent_m]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def _furthest(chain: SerialChain, limits: FloatArray, direction: FloatArray, rng: np.random.Generator) -> float:
    """Greatest direction . tool [m] over the joint ranges."""
    q = rng.uniform(limits[:, 0], limits[:, 1], (STARTS, chain.n))
    low, high = limits[:, 0], limits[:, 1]
    best = -np.inf
    for _ in range(ROUNDS):
        for i in range(chain.n):
            axes, tool = joint_axes(chain, q)
            z, origin = axes[i]
            # Turned by t from here the coordinate is a constant + B cos t + C sin t.
            lever = tool - origin
            across = lever - z * (z * lever).sum(axis=0)
            peak = q[:, i] + np.arctan2(direction @ cross(z, across), direction @ across)
            if high[i] - low[i] < TURN_RAD:
                middle = (low[i] + high[i]) / 2.0
                # The peak's place nearest to the middle of the range; outside it the nearer end is the best.
                peak = np.clip(middle + (peak - middle + np.pi) % (2.0 * np.pi) - np.pi, low[i], high[i])
            q[:, i] = peak
        reached = float((tool_position(chain, q) @ direction).max())
        if reached - best <= SETTLED_M:
            break
        best = reached
    return max(best, reached)
