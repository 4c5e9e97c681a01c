"""Via points: which points of a joint path to keep so that interpolation between them stays nearest to the line.

A plan is executed by joint interpolation (`interpolate.py`), so each choice is judged by simulating that motion: tool
points at even time steps, mean distance to AB (eq. 20). The first and last point of the path are always kept. Up to two
via points are found by trying all choices; more are added one by one, then exchanged one at a time until nothing
improves, which is a local optimum.
"""

from collections.abc import Iterable
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.interpolate import Interpolation, joint_path, time_law
from armctl.trajectory.straightness import Ends, mean_error

# Tool points on a simulated motion.
SAMPLES = 200
# Motions simulated at once: their link transforms stay in the processor's cache, three times faster than all.
_BATCH = 24


def predict_tool_path(chain: SerialChain, waypoints: FloatArray, knots: FloatArray, kind: Interpolation) -> FloatArray:
    """Tool points of the interpolated motion at even time steps, the servos taken as perfect.

    Args:
        waypoints: Joint positions [rad], shape (..., k, n), n the chain's joints.
        knots: Their progress, shape (..., k).
    Returns:
        Tool points [m], shape (..., SAMPLES, 3).
    """
    return tool_position(chain, joint_path(waypoints, knots, time_law(np.linspace(0.0, 1.0, SAMPLES)), kind))


def choose_via_points(
    chain: SerialChain, path: FloatArray, progress: FloatArray, count: int, kind: Interpolation, ends: Ends
) -> tuple[int, ...]:
    """Indices of the `count` inner points of `path` whose interpolated motion has the least mean error.

    Args:
        path: Joint positions [rad], shape (m, n), n the chain's joints.
        progress: Progress of the points, shape (m,), strictly increasing.
        count: 0 <= count <= m - 2.
        ends: A and B, of the line [m].
    Returns:
        Increasing indices into `path`, without the ends.
    Raises:
        ValueError: the path has too few points.
    """
    inner = range(1, len(path) - 1)
    if not 0 <= count <= len(inner):
        raise ValueError(f"{count} via points wanted from a path with {len(inner)} inner points")

    def best_of(choices: Iterable[tuple[int, ...]]) -> tuple[float, tuple[int, ...]]:
        indices = np.array([sorted(choice) for choice in choices], dtype=np.intp)
        errors = np.concatenate([simulate(batch) for batch in np.split(indices, range(_BATCH, len(indices), _BATCH))])
        best = int(errors.argmin())
        return float(errors[best]), tuple(indices[best].tolist())

    def simulate(indices: NDArray[np.intp]) -> FloatArray:
        first = np.zeros((len(indices), 1), dtype=np.intp)
        kept = np.concatenate([first, indices, first + len(path) - 1], axis=1)
        return mean_error(predict_tool_path(chain, path[kept], progress[kept], kind), *ends)

    if count == 0:
        return ()
    error, chosen = best_of(combinations(inner, min(count, 2)))
    while len(chosen) < count:
        error, chosen = best_of((*chosen, new) for new in inner if new not in chosen)
    improving = 2 < count < len(inner)
    while improving:
        improving = False
        for old in chosen:
            rest = tuple(index for index in chosen if index != old)
            candidate_error, candidate = best_of((*rest, new) for new in inner if new not in chosen)
            if candidate_error < error:
                error, chosen, improving = candidate_error, candidate, True
                break
    return chosen
