"""Genes that leave the recordings: small offsets in joint space that bring each station onto the line.

Recorded genes can be no straighter than the straightest recording was at each station. Here every joint position may
differ from the recorded one by a bounded offset. The offsets come from damped least squares; how much of them counts
is decided by the same limits that the recorded path was held to: a share of the step is kept only while the path is
straighter than before and breaks no more limits. Where none is, the path is smoothed over its stations first.
"""

import math
from collections.abc import Callable, Iterator

import numpy as np

from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.line_path import step_towards
from armctl.trajectory.straightness import Ends, mean_error

MOST_OFFSET_RAD = math.radians(3.0)
STEPS = 8
SHARES = (1.0, 0.7, 0.4, 0.2, 0.1)
# How badly a path of joint positions [rad], shape (m, n), breaks the limits of motion; 0: not at all.
Breaks = Callable[[FloatArray], float]


def free_path(
    chain: SerialChain, path: FloatArray, progress: FloatArray, ends: Ends, limits: FloatArray, breaks: Breaks
) -> FloatArray:
    """The path, each joint position moved by at most `MOST_OFFSET_RAD`, nearer to the line; its ends stay.

    Args:
        path: Joint positions [rad], shape (m, n), n the chain's joints.
        progress: Where along the line each station belongs, shape (m,).
        ends: A and B, of the line [m].
        limits: Of the joints [rad], shape (n, 2).
    """
    low = np.maximum(limits[:, 0], path - MOST_OFFSET_RAD)
    high = np.minimum(limits[:, 1], path + MOST_OFFSET_RAD)
    low[[0, -1]] = high[[0, -1]] = path[[0, -1]]
    on_line = ends[0] + progress[:, None] * (ends[1] - ends[0])
    q, error, broken = path, float(mean_error(tool_position(chain, path), *ends)), breaks(path)
    for _ in range(STEPS):
        for offered in _nearer(chain, q, on_line):
            moved = np.clip(offered, low, high)
            moved_error = float(mean_error(tool_position(chain, moved), *ends))
            if moved_error < error and (moved_broken := breaks(moved)) <= broken:
                q, error, broken = moved, moved_error, moved_broken
                break
        else:
            break
    return q


def _nearer(chain: SerialChain, q: FloatArray, on_line: FloatArray) -> Iterator[FloatArray]:
    """Paths nearer to the line, as it is and smoothed: one that changes takes as fast as it may has no room to move."""
    smooth = q.copy()
    smooth[1:-1] = (q[:-2] + 2.0 * q[1:-1] + q[2:]) / 4.0
    for begin in (q, smooth):
        step = step_towards(chain, on_line, begin)
        yield from (begin + share * step for share in SHARES)
