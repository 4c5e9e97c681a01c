"""Recordings made by hand -> candidates: joint paths at the same stations of progress along AB.

A recording has dead time at both ends, stops and goes back, and every one its own speed; what it shares with the others
is the way from A to B. So time is thrown away:
1. Positions outside the joint limits are clipped to them, because nothing else can be commanded; the tool path of a
   recording is that of the clipped positions.
2. The dead ends go, and with them the way to A, from wherever the arm was: the way begins where progress was last at 0
   before, once near A, it first reaches 1 (or its greatest value).
3. Progress is kept monotone: only samples further along than all before count.
4. Both ends are held: the first and last configuration of the way, corrected by inverse kinematics until the tool is
   on A and on B exactly, become its points of progress 0 and 1. They stay each recording's own. A common end (the
   mean of all) would be a jump for every recording of another posture, and then no candidate could be followed.
5. Joint positions are interpolated linearly at stations of equal progress.

Means of two recordings are candidates too (`with_blends`): a path goes over from one to the other by a station or more
of their mean, where a jump would be too fast, and what two hands do wrong on opposite sides cancels out.
"""

from collections.abc import Sequence
from contextlib import suppress
from itertools import combinations
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.inverse import solve_position
from armctl.kinematics.transform import FloatArray, IntArray
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.line_path import out_of_reach, point_text
from armctl.trajectory.straightness import distance_to_line, progress_along_line

# How near A and B a recording must come; a quarter of the line's length where that is less.
REACH_M = 0.04
SHORTEST_LINE_M = 0.01
# Tables of the search grow with the third power: 40 recordings take 50 MB.
MAX_RECORDINGS = 40
# Up to so many candidates there are blends; six recordings have room for all of theirs.
MOST_CANDIDATES = 24


class Candidates(NamedTuple):
    """R aligned recordings, or means of two, at m stations."""

    # Progress of the stations, 0 to 1, shape (m,).
    progress: FloatArray
    # Joint positions, shape (R, m, joints).
    positions_rad: FloatArray
    # Tool points, shape (R, m, 3).
    tool_m: FloatArray
    # Of which two recordings each is the mean, shape (R, 2); a recording itself: of twice the same.
    takes: IntArray


def align(
    recordings: Sequence[FloatArray], arm: ArmConfig, chain: SerialChain, A: FloatArray, B: FloatArray, stations: int
) -> Candidates:
    """The recordings as candidates for the line from A to B.

    Args:
        recordings: Joint positions [rad], each of shape (samples, joints).
        A, B: Ends of the line in the base frame [m], shape (3,).
        stations: Number of stations, at least 3.
    Raises:
        RequestRefused: nothing to align, A and B are (nearly) the same or out of reach, or a recording does not
            lead from A to B; names every recording that is unfit and why.
    """
    length = float(np.linalg.norm(B - A))
    if not length >= SHORTEST_LINE_M:
        found, bound = f"{length * 1e3:.1f} mm apart", f"at least {SHORTEST_LINE_M * 1e3:.0f} mm"
        raise RequestRefused("BAD_LINE", f"A and B are {found}, {bound}; move one of them")
    if not 1 <= len(recordings) <= MAX_RECORDINGS:
        text = f"{len(recordings)} recordings given; give 1 to {MAX_RECORDINGS} that lead from A to B"
        raise RequestRefused("BAD_RECORDINGS", text)
    progress = np.linspace(0.0, 1.0, stations)
    aligned, reasons = [], []
    for number, samples in enumerate(recordings, 1):
        try:
            aligned.append(_along_line(np.asarray(samples, dtype=np.float64), arm, chain, A, B, progress))
        except (ValueError, UnreachableTarget) as error:
            reasons.append(f"recording {number}: {error}")
    if reasons:
        raise RequestRefused("BAD_RECORDINGS", _out_of_reach(arm, chain, A, B) + reasons)
    return _candidates(chain, progress, np.array(aligned), np.repeat(np.arange(len(aligned))[:, None], 2, axis=1))


def with_blends(some: Candidates, arm: ArmConfig, chain: SerialChain, A: FloatArray, B: FloatArray) -> Candidates:
    """The recordings, and means of two of them, of the straightest first; both ends are put on A and B again.

    Args:
        some: Recordings alone.
        A, B: Ends of the line in the base frame [m], shape (3,).
    """
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
    positions, takes = list(some.positions_rad), some.takes.tolist()
    for pair in combinations(distance_to_line(some.tool_m, A, B).mean(axis=1).argsort(kind="stable").tolist(), 2):
        if len(positions) >= MOST_CANDIDATES:
            break
        blend = some.positions_rad[list(pair)].mean(axis=0)
        with suppress(UnreachableTarget):  # postures too different to be between them
            for end, target in ((0, A), (-1, B)):
                blend[end, : chain.n] = solve_position(chain, target, blend[end, : chain.n], limits)
            positions.append(blend)
            takes.append(list(pair))
    return _candidates(chain, some.progress, np.array(positions), np.array(takes))


def _candidates(chain: SerialChain, progress: FloatArray, positions_rad: FloatArray, takes: IntArray) -> Candidates:
    return Candidates(progress, positions_rad, tool_position(chain, positions_rad[..., : chain.n]), takes)


def _along_line(
    samples: FloatArray, arm: ArmConfig, chain: SerialChain, A: FloatArray, B: FloatArray, stations: FloatArray
) -> FloatArray:
    if samples.ndim != 2 or samples.shape[1] != len(arm.joints) or len(samples) < 2 or not np.isfinite(samples).all():
        wanted = f"two or more samples of the arm's {len(arm.joints)} joints, all finite"
        raise ValueError(f"shape {samples.shape} is not {wanted}; leave it out or record it again with this arm")
    limits = np.array([joint.limits_rad for joint in arm.joints])
    q = np.clip(samples, limits[:, 0], limits[:, 1])
    tool = tool_position(chain, q[:, : chain.n])
    p = progress_along_line(tool, A, B)

    reach = min(REACH_M, float(np.linalg.norm(B - A)) / 4.0)
    arrived = int(np.argmax(np.linalg.norm(tool - A, axis=1) <= reach))  # 0 if it never comes near A
    after = p[arrived:]
    at_B = arrived + (int(np.argmax(after >= 1.0)) if (after >= 1.0).any() else int(after.argmax()))
    before = p[arrived : at_B + 1]
    at_A = arrived + (int(np.flatnonzero(before <= 0.0)[-1]) if (before <= 0.0).any() else int(before.argmin()))
    for name, end, passed in (("A", A, tool[: at_B + 1]), ("B", B, tool[at_A:])):
        nearest = float(np.linalg.norm(passed - end, axis=1).min())
        if nearest > reach:
            found = f"comes no nearer to {name} than {nearest * 1e3:.0f} mm, at most {reach * 1e3:.0f} mm"
            other = f"ask for the line it leads along, from {point_text(tool[0])} to {point_text(tool[-1])}"
            raise ValueError(f"on its way from A to B it {found}; record from A to B, or {other}")

    q, p = q[at_A : at_B + 1], p[at_A : at_B + 1]
    kept = (p > np.maximum.accumulate(np.concatenate([[0.0], p]))[:-1]) & (p < 1.0)
    ends = [q[0].copy(), q[-1].copy()]
    for end, target in zip(ends, (A, B), strict=True):
        end[: chain.n] = solve_position(chain, target, end[: chain.n], limits[: chain.n])
    q = np.concatenate([ends[:1], q[kept], ends[1:]])
    p = np.concatenate([[0.0], p[kept], [1.0]])
    return columns_at(stations, p, q)


def _out_of_reach(arm: ArmConfig, chain: SerialChain, A: FloatArray, B: FloatArray) -> list[str]:
    """What to say of an end that no posture within the joint limits reaches, with the nearest point that one does."""
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
    far = [(X, out_of_reach(chain, X, limits, arm.floor_m, np.random.default_rng(0))) for X in (A, B)]
    return [f"{name} {point_text(X)} is {missing}" for name, (X, missing) in zip("AB", far, strict=True) if missing]
