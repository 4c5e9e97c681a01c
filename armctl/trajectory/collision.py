"""Links as capsules: how near they come to each other and to the floor.

Rules.
1. A link is the straight segment between the origins of consecutive frames, thick all round by one radius; link 1 is
   the base column, which begins where it stands or hangs (`base_m`). The radius covers an AX-12A (32 x 50 x 38 mm) with
   its brackets along the longest side.
2. Neighbours share a joint and touch in every pose: the joint's limits bound their angle. Two links whose links
   between, even stretched, do not hold them two radii apart are not judged either. All other pairs are judged.
3. The base column stands on the floor, or hangs far from it; what comes down is beyond the shoulder. There a link is as
   thick as its radius at its joint and tapers to the tool point, which is a point, because a tool has to touch things.
4. A capsule is fatter than the arm: an arm that stands where capsules overlap must be allowed to leave.

Nothing here knows cables, grippers, what else stands on the table, or what an arm hangs from.
"""

from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from armctl.kinematics.chain import SerialChain, link_frames
from armctl.kinematics.transform import FloatArray


def link_points(chain: SerialChain, q: FloatArray) -> FloatArray:
    """Ends of all links in the base frame [m], base first, tool point last: shape (..., n + 1, 3).

    Args:
        q: Joint positions [rad], shape (..., n).
    """
    points = link_frames(chain, q)[..., :3, 3]
    points[..., 0, :] = chain.base_m
    return points


def judged_pairs(points: FloatArray, radius_m: float) -> NDArray[np.intp]:
    """Which links can touch each other and need not: indices of the two, the first lower, shape (pairs, 2).

    Args:
        points: Ends of all links in one pose [m], shape (n + 1, 3); lengths are the same in every pose.
    """
    end_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(points, axis=0), axis=1))])
    chosen = [(i, j) for i, j in combinations(range(len(points) - 1), 2) if end_m[j] - end_m[i + 1] > 2.0 * radius_m]
    return np.array(chosen, dtype=np.intp).reshape(-1, 2)


def link_clearance(points: FloatArray, pairs: NDArray[np.intp], radius_m: float) -> FloatArray:
    """Gap between the surfaces of each pair of links [m], below 0 where they overlap; shape (..., pairs).

    Args:
        points: Ends of all links [m], shape (..., n + 1, 3).
        pairs: Indices of links, shape (pairs, 2); see `judged_pairs`.
    """
    first, second = pairs.T
    ends = (points[..., link, :] for link in (first, first + 1, second, second + 1))
    return segment_distance(*ends) - 2.0 * radius_m


def floor_clearance(points: FloatArray, floor_m: float, radius_m: float) -> FloatArray:
    """Height [m] above the floor of the underside at the end of each link from the second on; shape (..., n - 1).

    A taper is lowest at one of its ends, so that these are the lowest points of everything beyond the shoulder.

    Args:
        points: Ends of all links [m], shape (..., n + 1, 3).
    """
    thickness = np.full(points.shape[-2] - 2, radius_m)
    thickness[-1:] = 0.0
    return np.asarray(points[..., 2:, 2] - thickness - floor_m)


def segment_distance(a0: FloatArray, a1: FloatArray, b0: FloatArray, b1: FloatArray) -> FloatArray:
    """Least distance of segments a0 a1 and b0 b1, vectorised; either may be a point.

    The squared distance is a convex quadratic of the places s, t in [0, 1] on both: its least value lies where the
    endless lines are nearest, if that is inside, else on an edge of the square, where one end is nearest to the other
    segment. Every candidate is a distance that occurs, so rounding never makes the result too small.

    Args:
        a0, a1, b0, b1: Ends, shape (..., 3), broadcast.
    Returns:
        Distances, shape (...), in the unit of the ends.
    """
    a, b, between = a1 - a0, b1 - b0, a0 - b0
    aa, bb, ab = _dot(a, a), _dot(b, b), _dot(a, b)
    # Nearest points of the endless lines; for parallel ones (determinant 0) any place will do.
    s = np.clip(_ratio(ab * _dot(b, between) - bb * _dot(a, between), aa * bb - ab**2), 0.0, 1.0)
    t = np.clip(_ratio(ab * s + _dot(b, between), bb), 0.0, 1.0)
    inside = np.linalg.norm(between + s[..., None] * a - t[..., None] * b, axis=-1)
    edges = (_to_segment(a0, b0, b1), _to_segment(a1, b0, b1), _to_segment(b0, a0, a1), _to_segment(b1, a0, a1))
    return np.asarray(np.minimum.reduce([inside, *edges]))


def _to_segment(point: FloatArray, b0: FloatArray, b1: FloatArray) -> FloatArray:
    b = b1 - b0
    t = np.clip(_ratio(_dot(b, point - b0), _dot(b, b)), 0.0, 1.0)
    return np.asarray(np.linalg.norm(point - b0 - t[..., None] * b, axis=-1))


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    return np.asarray((a * b).sum(axis=-1))


def _ratio(above: FloatArray, below: FloatArray) -> FloatArray:
    return np.divide(above, below, out=np.zeros(np.broadcast(above, below).shape), where=below > 0.0)
