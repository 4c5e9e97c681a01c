"""Inverse kinematics as a question with an answer: a target, every solution, and which to take.

A target is a pose, a point, or a point and where the tool points there. A solution reaches it to `REACHED`; where none
exists the answer holds the configurations nearest to it and the least distance, exact where there is a formula. Joint
ranges do not make a target unreachable: each solution says whether it is within them. Solutions are sorted: within the
ranges first, then the least weighted travel from the present configuration (Bao, Liu & Zhao eq. 10).
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from armctl.errors import ConfigError
from armctl.kinematics.chain import jacobian, tool_position
from armctl.kinematics.inverse import TURN_RAD, masked_jacobian, pose_errors, refine_poses, solve_poses, within_a_turn
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.structure import ClosedForm
from armctl.kinematics.target import Target
from armctl.kinematics.transform import FloatArray, finite

# Errors up to which a pose or a point counts as reached.
REACHED_M = 1e-6
REACHED_RAD = 1e-6
LIMIT_SLACK_RAD = 1e-9
# Configurations that are one.
SAME_RAD = 1e-6
# An arm that has to travel more than this to a pose that is not singular is not there.
NEAR_RAD = 1e-2
# Below this share of the largest singular value the joints can move while the tool stays.
SINGULAR = 1e-6
# How many starts a search has where no formula helps, and how often what it found is moved nearer.
STARTS, NEARER_STEPS = 64, 12


@dataclass(frozen=True)
class Solution:
    """One configuration and what it misses."""

    q_rad: tuple[float, ...]
    within_limits: bool
    # Tells the errors [m, rad] of the configuration, which take longer than a closed form does.
    judge: Callable[[tuple[float, ...]], tuple[float, float]] = field(repr=False, compare=False)

    @property
    def position_error_m(self) -> float:
        return self._errors[0]

    @property
    def orientation_error_rad(self) -> float:
        """It is 0 where the target is a point."""
        return self._errors[1]

    @cached_property
    def _errors(self) -> tuple[float, float]:
        return self.judge(self.q_rad)


@dataclass(frozen=True)
class Answer:
    """What there is to say about a target."""

    reachable: bool
    # How near the tool can come: to a point in any direction; to a pose, with its rotation where the arm has a
    # spherical wrist, else in any direction. 0 means that the position is no obstacle. Exact for robots with a closed
    # form, else the least found.
    least_position_error_m: float
    # Best first; the nearest configurations where the target is out of reach.
    solutions: tuple[Solution, ...]


def weighted_travel(q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Joint travel from the present configuration, the waist counted double (Bao, Liu & Zhao eq. 10).

    A joint with a whole turn goes the short way round.

    Args:
        q: Configurations [rad], shape (..., n).
        present: Where the arm is [rad], shape (n,).
    Returns:
        Delta [rad], shape (...,).
    """
    travel = np.abs(q - present)
    turning = limits[:, 1] - limits[:, 0] >= TURN_RAD
    around = np.abs((travel + np.pi) % (2.0 * np.pi) - np.pi)
    weights = np.where(np.arange(len(present)) == 0, 1.0, 0.5)
    return np.asarray((np.where(turning, around, travel) * weights).sum(axis=-1))  # (eq. 10)


def within_limits(q: FloatArray, limits: FloatArray) -> NDArray[np.bool_]:
    """Whether each configuration, shape (..., n), keeps all joint ranges; bool, shape (...,)."""
    inside = (q >= limits[:, 0] - LIMIT_SLACK_RAD) & (q <= limits[:, 1] + LIMIT_SLACK_RAD)
    return np.asarray(inside.all(axis=-1))


def solve(
    robot: Robot,
    target: Target,
    *,
    method: Literal["closed", "numeric"] = "closed",
    present: FloatArray | None = None,
    limits: FloatArray | None = None,
    polish: bool = True,
    seed: int = 0,
) -> Answer:
    """Every solution of a target, best first, or the nearest configurations.

    Args:
        method: "closed" lists one solution a branch; "numeric" finds one, and stands in where there is no closed form.
        present: Where the arm is [rad], shape (n,); the middle of the joint ranges if not given.
        limits: Joint ranges [rad], shape (n, 2); the robot's own if not given.
        polish: Bring what is near the target onto it by damped least squares.
        seed: Of the numeric method's random starts.
    Raises:
        ConfigError: `present` or `limits` have another number of joints than the chain.
    """
    limits = robot.limits_rad if limits is None else np.asarray(limits, dtype=np.float64)
    stands = present is not None
    present = limits.mean(axis=1) if present is None else np.asarray(present, dtype=np.float64)
    if limits.shape != (robot.chain.n, 2) or present.shape != (robot.chain.n,):
        shapes = f"present {present.shape}, limits {limits.shape}"
        raise ConfigError(robot.name, "q", shapes, f"the chain has {robot.chain.n} joints")
    closed = method == "closed" and robot.closed_form is not None and target.direction is None
    if closed and target.turned and (alone := _alone(robot, target, present, limits)) is not None:
        return alone
    if closed:
        q, least = _closed(robot, target, present, limits)
    else:
        q, least = _numeric(robot, target, present, limits, seed)
    found = answer(robot, target, q, present, limits, least=least, polish=polish)
    if not (stands and within_limits(present, limits)):
        return found
    if not _errors(robot, target, present[None])[2][0]:
        return found
    # The arm is there: it stays.
    here = Solution(tuple(present.tolist()), True, _judge(robot, target))
    others = [one for one in found.solutions if np.abs(present - one.q_rad).max() > SAME_RAD]
    return Answer(True, 0.0, (here, *(others if found.reachable else ())))


def answer(
    robot: Robot,
    target: Target,
    q: FloatArray,
    present: FloatArray,
    limits: FloatArray,
    *,
    least: float,
    polish: bool = True,
) -> Answer:
    """Configurations, shape (k, n), judged, polished and sorted; `least` is the least distance [m]."""
    q = within_a_turn(q, limits)
    if polish:
        q = _polished(robot, target, q)
    position_m, turn_rad, reached = _errors(robot, target, q)
    keep = np.flatnonzero(reached) if reached.any() else np.arange(len(q))
    inside = within_limits(q[keep], limits)
    misses = np.zeros(len(keep)) if reached.any() else np.round(position_m + turn_rad, 9)[keep]
    order = keep[np.lexsort((weighted_travel(q[keep], present, limits), ~inside, misses))]
    solutions: list[Solution] = []
    for i in order:
        if not any(np.abs(q[i] - other.q_rad).max() < 1e-9 for other in solutions):
            within = bool(within_limits(q[i], limits))
            solutions.append(Solution(tuple(q[i].tolist()), within, _judge(robot, target)))
    return Answer(bool(reached.any()), least, tuple(solutions))


def _alone(robot: Robot, target: Target, present: FloatArray, limits: FloatArray) -> Answer | None:
    """Every solution of a pose by its closed form in plain floats.

    None where the pose is singular or a family, none is within limits, or the arm may be there already.
    """
    assert robot.closed_form is not None
    ranges, turn = [(*ends, here) for ends, here in zip(limits.tolist(), present.tolist(), strict=True)], 2.0 * math.pi
    found = []
    for angles in robot.closed_form.pose(target.T.tolist()):
        q, inside, travel, weight = [], True, 0.0, 1.0
        for at, (low, high, here) in zip(angles, ranges, strict=True):
            for near in (at, at + turn, at - turn):
                if low - LIMIT_SLACK_RAD <= near <= high + LIMIT_SLACK_RAD:
                    break
            else:
                near, inside = at, False
            way = abs(near - here)
            travel += weight * (abs(math.remainder(way, turn)) if high - low >= TURN_RAD else way)  # (eq. 10)
            weight = 0.5
            q.append(near)
        found.append((not inside, travel, tuple(q)))
    found.sort()
    if not found or found[0][0] or found[0][1] < NEAR_RAD:
        return None
    judge = _judge(robot, target)
    return Answer(True, 0.0, tuple(Solution(q, not outside, judge) for outside, _, q in found))


def _judge(robot: Robot, target: Target) -> Callable[[tuple[float, ...]], tuple[float, float]]:
    def judge(q: tuple[float, ...]) -> tuple[float, float]:
        position_m, turn_rad, _ = _errors(robot, target, np.array([q]))
        return float(position_m[0]), float(turn_rad[0])

    return judge


def _closed(robot: Robot, target: Target, present: FloatArray, limits: FloatArray) -> tuple[FloatArray, float]:
    form = robot.closed_form
    assert form is not None
    families = form.pose_families(target.T) if target.turned else form.positions(target.position_m[None])[0]
    if families.shape[1] == 1:
        q = finite(families)
    else:
        q = np.array([_best(finite(family), present, limits) for family in families if np.isfinite(family).any()])
    if len(q) and _errors(robot, target, q)[2].any():
        if target.turned:
            q = _slid(robot, target, q, present, limits)
        if families.shape[1] > 1 and not within_limits(within_a_turn(q, limits), limits).any():
            # Members of families lie in steps: between two of them there may be one within the limits.
            return np.vstack([q, _from_many(robot, target, finite(families), present, limits)]), 0.0
        return q, 0.0
    q, least = _nearest(form, target)
    return _numeric(robot, target, present, limits, 0) if least == 0.0 and not target.turned else (q, least)


def _slid(robot: Robot, target: Target, q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Configurations of a pose, shape (k, n); of a singular one the best of those into which it can move.

    There the joints can move and the tool stays. Along that motion the places are tried at which a joint is where it is
    at present or at its limits: between two of them nothing gets better.
    """
    _, values, directions = np.linalg.svd(jacobian(robot.chain, q))
    for k in np.flatnonzero(values[:, -1] <= SINGULAR * values[:, 0]).tolist():
        q[k] = _along(robot, target, q[k], directions[k, -1], present, limits)
    return q


def _along(
    robot: Robot, target: Target, q: FloatArray, way: FloatArray, present: FloatArray, limits: FloatArray
) -> FloatArray:
    """The best of the configurations that a singular one, shape (n,), can move into along a way."""
    moving = np.flatnonzero(np.abs(way) > SINGULAR)
    ends = np.stack([present, *limits.T])[:, moving]
    turns = (ends - q[moving] + np.pi) % (2.0 * np.pi) - np.pi
    steps = np.concatenate([turns, turns - np.copysign(2.0 * np.pi, turns)]) / way[moving]
    slid = q + steps.reshape(-1, 1) * way
    slid = slid[np.abs(slid - q).max(axis=1) <= 2.0 * np.pi]
    T = np.broadcast_to(target.T, (len(slid), 4, 4))
    slid = refine_poses(robot.chain, T, slid, _whole_turns(robot), turned=True)
    return _best(np.vstack([q, slid[_errors(robot, target, slid)[2]]]), present, limits)


def _from_many(
    robot: Robot, target: Target, starts: FloatArray, present: FloatArray, limits: FloatArray, seed: int = 0
) -> FloatArray:
    """Configurations within limits that reach the target, found from many starts, shape (k, n); k may be 0.

    Args:
        starts: Such as almost do, shape (k, n); the nearest to the limits are tried, beside the present one and others.
    """
    starts = within_a_turn(starts, limits)
    beyond = np.maximum(limits[:, 0] - starts, starts - limits[:, 1]).max(axis=1, initial=0.0)
    drawn = np.random.default_rng(seed).uniform(limits[:, 0], limits[:, 1], (STARTS, len(limits)))
    starts = np.vstack([present, starts[np.argsort(beyond, kind="stable")[:STARTS]], drawn])
    q = _refined(robot, target, starts, limits)
    return np.asarray(q[_errors(robot, target, q)[2] & within_limits(q, limits)])


def _nearest(form: ClosedForm, target: Target) -> tuple[FloatArray, float]:
    """Configurations [rad] near a target that is out of reach, and the least distance [m]."""
    return form.nearest_pose(target.T) if target.turned else form.nearest_position(target.position_m)


def _best(q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Of configurations, shape (k, n), the one within limits with the least travel, else the least travel."""
    q = within_a_turn(q, limits)
    order = np.lexsort((weighted_travel(q, present, limits), ~within_limits(q, limits)))
    return np.asarray(q[order[0]])


def _numeric(
    robot: Robot, target: Target, present: FloatArray, limits: FloatArray, seed: int
) -> tuple[FloatArray, float]:
    """Configurations within limits from many starts, else one without them, else the nearest."""
    rng = np.random.default_rng(seed)
    form = robot.closed_form if target.direction is None else None
    if form is None:
        q = _from_many(robot, target, present[None], present, limits, seed)
        if len(q):
            return _nearer(robot, target, q, present, limits), 0.0
    for ranges in (limits, _whole_turns(robot)):
        T, turned, direction = target.T[None], target.turned, target.direction
        q = solve_poses(robot.chain, T, ranges, rng, q_start=present[None], turned=turned, direction=direction)
        position_m, _, reached = _errors(robot, target, q)
        if reached[0]:
            return q, 0.0
    return (q, float(position_m[0])) if form is None else _nearest(form, target)


def _nearer(robot: Robot, target: Target, q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Configurations within limits, each moved towards the present one as far as the target leaves it free."""
    rows = 6 if target.turned else 3
    if robot.chain.n <= rows - (target.direction is not None):
        return q
    for _ in range(NEARER_STEPS):
        J = masked_jacobian(robot.chain, q, target.direction)[:, :rows]
        away = present - q
        along = away - (np.linalg.pinv(J, rcond=SINGULAR) @ (J @ away[..., None]))[..., 0]
        moved = _refined(robot, target, np.clip(q + along, *limits.T), limits)
        better = _errors(robot, target, moved)[2] & (
            weighted_travel(moved, present, limits) < weighted_travel(q, present, limits) - SAME_RAD
        )
        if not better.any():
            break
        q = np.where(better[:, None], moved, q)
    return q


def _errors(robot: Robot, target: Target, q: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Distance [m], turn [rad] and whether the target counts as reached, for configurations of shape (k, n)."""
    if target.turned:
        position_m, turn_rad = pose_errors(robot.chain, q, np.broadcast_to(target.T, (len(q), 4, 4)), target.direction)
    else:
        position_m = np.linalg.norm(tool_position(robot.chain, q) - target.position_m, axis=-1)
        turn_rad = np.zeros(len(q))
    return position_m, turn_rad, (position_m <= REACHED_M) & (turn_rad <= REACHED_RAD)


def _refined(robot: Robot, target: Target, q: FloatArray, limits: FloatArray) -> FloatArray:
    """The configurations, shape (k, n), brought as near to the target as they go within limits."""
    T = np.broadcast_to(target.T, (len(q), 4, 4))
    return refine_poses(robot.chain, T, q, limits, turned=target.turned, direction=target.direction)


def _whole_turns(robot: Robot) -> FloatArray:
    """Joint ranges of a whole turn each [rad], shape (n, 2)."""
    return np.tile([-np.pi, np.pi], (robot.chain.n, 1))


def _polished(robot: Robot, target: Target, q: FloatArray) -> FloatArray:
    """The configurations brought onto the target, each near where it was; as they are where that does not succeed."""
    refined = _refined(robot, target, q, _whole_turns(robot))
    reached = _errors(robot, target, refined)[2]
    near = q + (refined - q + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(reached[:, None], near, q)
