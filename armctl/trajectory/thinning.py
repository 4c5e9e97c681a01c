"""Long motions in few numbers: between two points kept, the path is straight to less than half a servo tick.

A motion is made, and judged, on an even grid; a long one has too many rows for the link to the control process
(`messages.MAX_NUMBERS`). Points stay where the path bends, so that a slow motion of ten minutes keeps some dozens. No
joint gets faster by it: between two points of a path the straight way is the shortest.
"""

from dataclasses import replace

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import RequestRefused
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory, most_points

# Goals are whole ticks.
AWAY_RAD = 0.49 * TICK_RAD


def thinned(trajectory: JointTrajectory) -> JointTrajectory:
    """The same motion in few enough points; as it is where it has no more.

    Raises:
        RequestRefused: code LIMIT, it winds too much for its length.
    """
    q = np.array(trajectory.positions_rad)
    if trajectory.times_s or q.ndim != 2 or len(q) <= (most := most_points(q.shape[1])):
        return trajectory
    kept = [0]
    while kept[-1] < len(q) - 1:
        kept.append(_farthest(q, kept[-1]))
    if len(kept) > most:
        needs = f"the motion of {trajectory.duration_s:.1f} s winds so much that it needs {len(kept)} points"
        bound = f"at most {most} reach the servos at once; make it shorter, or split it"
        raise RequestRefused("LIMIT", f"{needs}, {bound}")
    rows, period_s = trajectory.positions_rad, trajectory.period_s
    return replace(trajectory, positions_rad=tuple(rows[i] for i in kept), times_s=tuple(i * period_s for i in kept))


def _farthest(q: FloatArray, begin: int) -> int:
    """A row beyond `begin` up to which the path is straight; by doubling the way, then halving what was too much."""
    good, too_far = begin + 1, len(q)
    while good + 1 < too_far:
        ahead = min(2 * good - begin, len(q) - 1) if too_far == len(q) else (good + too_far) // 2
        if _straight(q[begin : ahead + 1]):
            good = ahead
        else:
            too_far = ahead
    return good


def _straight(q: FloatArray) -> bool:
    part = np.linspace(0.0, 1.0, len(q))[:, None]
    return bool((np.abs(q - (q[0] + part * (q[-1] - q[0]))) < AWAY_RAD).all())
