"""Where the joints have to be for the tool to be somewhere: the choice nearest to where they are.

The search begins at the present pose, where the rotation counts at all that inverse kinematics lists (of a point that
takes too long), and at `STARTS` poses drawn within the limits, always the same ones. The solutions are sorted by how
far their farthest joint travels.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from pydantic import Field

from armctl.config import Frozen
from armctl.errors import RequestRefused
from armctl.kinematics.inverse import pose_errors, refine_poses, unreachable
from armctl.kinematics.solution import solve, within_limits
from armctl.kinematics.target import Target, direction_target, point_target
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S
from armctl.trajectory.bounds import Direction, Joints, Point, Pose
from armctl.trajectory.preflight import Driven

STARTS = 12
POSITION_TOLERANCE_M = 1e-6
ORIENTATION_TOLERANCE_RAD = 1e-5
# Postures that are one.
SAME_RAD = 0.02
# As many postures as a request may choose among.
MOST_POSTURES = STARTS + 1

Way = TypeVar("Way")


class MoveRequest(Frozen):
    """Where to go: just one of `joints_rad`, `point_m` and `pose`."""

    joints_rad: Joints | None = None
    point_m: Point | None = None
    pose: Pose | None = None
    # Of a point: where the tool points there; about that direction it may turn. None: anywhere.
    direction: Direction | None = None
    # How long the motion takes; None: as long as it needs at a slow speed.
    duration_s: float | None = Field(None, gt=0.0, le=LONGEST_S)
    # Which posture of those that may be gone to, the nearest first; None: the nearest.
    posture: int | None = Field(None, ge=1, le=MOST_POSTURES)

    def _check(self) -> None:
        if sum(target is not None for target in (self.joints_rad, self.point_m, self.pose)) != 1:
            raise ValueError("joints_rad, point_m, pose: give just one of them")
        if self.direction is not None and self.point_m is None:
            raise ValueError("direction: it goes with point_m alone; a pose has its own")


def postures_at(
    T: FloatArray, q_now: Sequence[float], on: Driven, *, turned: bool = True, direction: FloatArray | None = None
) -> list[list[float]]:
    """Joint positions [rad] inside the limits that bring the tool to a pose, the nearest first.

    Joints beyond the chain stay.

    Args:
        T: Wanted tool pose in the base frame, shape (4, 4).
        q_now: Present joint positions [rad], shape (joints,).
        turned: Whether the rotation counts; without it the position alone does.
        direction: Where the tool is to point, unit vector; of the rotation nothing else counts then.
    Raises:
        UnreachableTarget: there are none; carries the nearest distance found.
    """
    chain = on.robot.chain
    limits = np.array([joint.limits_rad for joint in on.arm.joints[: chain.n]])
    here = np.array(q_now[: chain.n])
    target = Target(T, turned, direction)
    known = [one.q_rad for one in solve(on.robot, target, present=here, limits=limits).solutions] if turned else []
    starts = np.vstack([here, *known, *np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (STARTS, chain.n))])
    targets = np.broadcast_to(T, (len(starts), 4, 4))
    q = refine_poses(chain, targets, starts, limits, turned=turned, direction=direction)
    away_m, turned_rad = pose_errors(chain, q, targets, direction)
    turned_rad = turned_rad * turned
    reached = (away_m <= POSITION_TOLERANCE_M) & (turned_rad <= ORIENTATION_TOLERANCE_RAD) & within_limits(q, limits)
    if not reached.any():
        # How near the best of the searches came; a pose is judged by both, a decimetre against a radian.
        nearest = int((away_m + 0.1 * turned_rad).argmin())
        turn = f" and {math.degrees(turned_rad[nearest]):.1f} deg" if turned else ""
        raise unreachable(T[:3, 3], float(away_m[nearest]), f"{turn} within the joint limits")
    found = np.clip(q[reached], limits[:, 0], limits[:, 1])
    found = found[np.abs(found - here).max(axis=1).argsort(kind="stable")]
    distinct = [q for i, q in enumerate(found) if not (np.abs(found[:i] - q).max(axis=1) < SAME_RAD).any()]
    return [[*q.tolist(), *q_now[chain.n :]] for q in distinct]


def aimed(point_m: Point, direction: Direction | None) -> Target:
    """The target of a point [m], and where the tool points there, if that is wanted."""
    return point_target(point_m) if direction is None else direction_target(point_m, direction)


def way_by(postures: Iterable[Sequence[float]], way: Callable[[Sequence[float]], Way], wanted: int | None) -> Way:
    """The way by the first of the postures that may be gone, or by the one that was asked for.

    Args:
        postures: Joint positions [rad], the best first.
        way: Makes the way to one, or refuses it.
        wanted: Which of those that may be gone, from 1; None: the first.
    Raises:
        RequestRefused: the first refusal where none may be gone; POSTURE, each of them, where there are not so many.
    """
    allowed: list[Sequence[float]] = []
    refused: list[RequestRefused] = []
    for posture in postures:
        try:
            found = way(posture)
        except RequestRefused as refusal:
            refused.append(refusal)
            continue
        allowed.append(posture)
        if len(allowed) == (wanted or 1):
            return found
    if not allowed:
        raise refused[0]
    ends = [np.degrees(one).round(1).tolist() for one in allowed]
    told = [f"posture {i}: {', '.join(f'{angle:g}' for angle in end)} deg" for i, end in enumerate(ends, start=1)]
    raise RequestRefused("POSTURE", [f"of posture {wanted} there is none; these can be gone to", *told])
