"""Where the joints have to be for the tool to be somewhere: the choice nearest to where they are.

The search begins at the present pose, where the rotation counts at all that inverse kinematics lists (of a point that
takes too long), and at `STARTS` poses drawn within the limits, always the same ones. The solutions are sorted by how
far their farthest joint travels. An arm with a joint to spare has families of them; the nearest is found by narrowing
the joints' ranges about the present pose.
"""

import math
from collections.abc import Callable, Iterable, Sequence
from typing import TypeVar

import numpy as np
from pydantic import Field

from armctl.config import Frozen
from armctl.errors import RequestRefused
from armctl.kinematics.inverse import unreachable
from armctl.kinematics.solution import errors_of, refine, solve, within_limits
from armctl.kinematics.target import Target, direction_target, point_target
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S
from armctl.trajectory.bounds import Direction, Joints, Point, Pose
from armctl.trajectory.preflight import Driven

STARTS = 12
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


def postures_at(target: Target, q_now: Sequence[float], on: Driven, *, nearest: bool = False) -> list[list[float]]:
    """Joint positions [rad] inside the limits that bring the tool to a target, the nearest first.

    Joints beyond the chain stay.

    Args:
        q_now: Present joint positions [rad], shape (joints,).
        nearest: Whether of a family the nearest member that a search finds is taken; without it any member is.
    Raises:
        UnreachableTarget: there are none; carries the nearest distance found.
    """
    chain = on.robot.chain
    limits = np.array([joint.limits_rad for joint in on.arm.joints[: chain.n]])
    here = np.array(q_now[: chain.n])
    known = solve(on.robot, target, present=here, limits=limits).solutions if target.turned else ()
    drawn = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (STARTS, chain.n))
    starts = np.vstack([here, *(one.q_rad for one in known), *drawn])

    def searched(ranges: FloatArray) -> tuple[FloatArray, FloatArray, FloatArray]:
        """What reaches the target within joint ranges, the nearest first; the distance and turn that each ends at."""
        q = refine(on.robot, target, starts, ranges)
        away_m, turned_rad, reached = errors_of(on.robot, target, q)
        q = np.clip(q[reached & within_limits(q, ranges)], ranges[:, 0], ranges[:, 1])
        return q[np.abs(q - here).max(axis=1).argsort(kind="stable")], away_m, turned_rad

    found, away_m, turned_rad = searched(limits)
    if not len(found):
        # How near the best of the searches came; a pose is judged by both, a decimetre against a radian.
        best = int((away_m + 0.1 * turned_rad).argmin())
        turn = f" and {math.degrees(turned_rad[best]):.1f} deg" if target.turned else ""
        raise unreachable(target.position_m, float(away_m[best]), f"{turn} within the joint limits")
    # Of a family a search finds any member. The nearest lies in the least box about the present pose that holds one.
    too_small, holds = 0.0, float(np.abs(found[0] - here).max()) if nearest else 0.0
    box = holds - SAME_RAD
    while holds - too_small > SAME_RAD:
        inside, *_ = searched(np.clip(here[:, None] + np.array([-box, box]), *limits.T[..., None]))
        found = np.vstack([inside[:1], found])
        too_small, holds = (too_small, float(np.abs(inside[0] - here).max())) if len(inside) else (box, holds)
        box = (too_small + holds) / 2.0
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
