"""What a path through the candidates costs, as tables, so that evaluating one is looking up and adding.

A path takes, at every station, the joint positions of one recording: gene k is the index of that recording ("recorded
genes alone"). Its cost is the mean distance of its tool points to AB (eq. 20), or the mean of a power of it where large
distances shall count for more, plus a charge for every place where it cannot be followed in the nominal time:
- joint speed between two neighbouring stations above the joint's limit,
- joint acceleration over three neighbouring stations above the joint's limit,
- progress of the tool going back between two neighbouring stations.
Station times come from the time law of the plan. The charge of one place is W * (1 + relative excess), where W exceeds
what any choice of genes can gain in distance: a path that keeps the limits always beats one that does not, and where
none keeps them, the fewest and smallest breaks win. With that charge the cost stays a sum over triples of
neighbouring genes (`triple_cost.py`), which the genetic algorithm and the exact search (`shortest_path.py`) share.
"""

from typing import NamedTuple

import numpy as np

from armctl.genetic.alignment import Candidates
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.placement import POWER, Objective


class PathCost(NamedTuple):
    """Tables over m stations and R recordings."""

    # Distance of each gene's tool point to AB, shape (m, R).
    distance_m: FloatArray
    # 1 + relative excess per broken limit of each triple of neighbouring genes, 0 where all hold;
    # shape (m - 2, R, R, R).
    breaks: FloatArray
    # What each triple adds to the mean distance, every station counted once, shape (m - 2, R, R, R).
    straight_m: FloatArray
    # W in the text above.
    charge_m: float
    # p of the p-norm. Tables can hold a sum over stations; the maximum is none, the 10-norm stands for it.
    power: float
    # Largest distance of any gene: distances count as scale_m * (distance / scale_m)^power.
    scale_m: float

    def table(self, charge_share: float = 1.0) -> FloatArray:
        """Cost of each triple [m], with a share of the charges, shape (m - 2, R, R, R)."""
        return self.straight_m + charge_share * self.charge_m * self.breaks

    def norm_m(self, cost_m: float) -> float:
        """p-norm of the distances of a path of that cost, which is the cost itself where p is 1."""
        return float(self.scale_m * (cost_m / self.scale_m) ** (1.0 / self.power))


def path_cost(
    candidates: Candidates,
    distance_m: FloatArray,
    time_s: FloatArray,
    speed_limits: FloatArray,
    acceleration_limits: FloatArray,
    tool_progress: FloatArray,
    objective: Objective = "mean",
) -> PathCost:
    """Tables for candidates whose stations are passed at the times `time_s`.

    Args:
        distance_m: Distance of each station of each candidate to AB, shape (R, m), m >= 3.
        time_s: Station times, shape (m,).
        speed_limits, acceleration_limits: Bounds of the joints that count, shape (j,) [rad/s, rad/s^2]; the first j
            joints of the candidates are looked at.
        tool_progress: Progress of each station of each candidate along AB, shape (R, m).
    """
    recordings, stations = distance_m.shape
    distance = np.ascontiguousarray(distance_m.T)
    # Joints first: the largest of a few numbers is found many times faster along the first axis.
    q = np.ascontiguousarray(candidates.positions_rad[..., : len(speed_limits)].transpose(1, 2, 0))
    dt = np.diff(time_s)
    pitch = 1.0 / (stations - 1)
    pairs = np.empty((stations - 1, recordings, recordings))
    breaks = np.empty((stations - 2, recordings, recordings, recordings))
    before = np.empty(0)
    for k in range(stations - 1):
        speed = (q[k + 1][:, None, :] - q[k][:, :, None]) / dt[k]
        back = (tool_progress.T[k][:, None] - tool_progress.T[k + 1][None, :]) / pitch
        pairs[k] = _broken((np.abs(speed) / speed_limits[:, None, None]).max(axis=0) - 1.0) + _broken(back)
        if k > 0:
            acceleration = np.abs(speed[:, None] - before[..., None])
            acceleration /= (acceleration_limits * ((dt[k - 1] + dt[k]) / 2.0))[:, None, None, None]
            breaks[k - 1] = _broken(acceleration.max(axis=0) - 1.0)
        before = speed
    # Fold stations and pairs into the triples: each triple carries its first, the last one all of its own.
    breaks += pairs[:-1, :, :, None]
    breaks[-1] += pairs[-1][None]
    power, scale = POWER[objective], max(float(distance.max()), 1e-9)
    mean = scale * (distance / scale) ** power / stations
    straight = np.broadcast_to(mean[:-2, :, None, None], breaks.shape).copy()
    straight[-1] += mean[-2][None, :, None] + mean[-1][None, None, :]
    charge = 1e-3 + float((mean.max(axis=1) - mean.min(axis=1)).sum())
    return PathCost(distance, breaks, straight, charge, power, scale)


def _broken(excess: FloatArray) -> FloatArray:
    # A whisker above 0 is rounding, not a broken limit.
    return np.where(excess > 1e-9, 1.0 + excess, 0.0)
