"""Inverse kinematics as a question with an answer: a target, every solution, and which to take.

A target is a pose, a point, or a point and where the tool points there. A solution reaches it to `REACHED`; where none
exists the answer holds the configurations nearest to it and the least distance, exact where there is a formula. Joint
ranges do not make a target unreachable: each solution says whether it is within them. Solutions are sorted: within the
ranges first, then the least weighted travel from the present configuration (Bao, Liu & Zhao eq. 10). Of mirror images
that are as near, the one whose first joint that differs stands higher comes first, on every processor.
"""

import math
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property, partial
from itertools import pairwise
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from armctl.errors import ConfigError
from armctl.kinematics.chain import tool_position
from armctl.kinematics.inverse import TURN_RAD, masked_jacobian, pose_errors, refine_poses, within_a_turn
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
# Of a travel and an angle [rad]: what differs after these differs by how a processor rounds.
EQUAL_DIGITS = 6
# An arm that has to travel more than this to a pose that is not singular is not there.
NEAR_RAD = 1e-2
# Below this share of the largest singular value the joints can move while the tool stays.
SINGULAR = 1e-6
# Starts of a search where no formula helps, and how often it begins anew where nothing within limits is found.
STARTS, ROUNDS = 64, 3
# Of a branch that leaves a family so many members, and of what a search finds so many, are slid nearer.
MEMBERS, FOUND = 6, 24
# How often; what a joint's being beyond its limit costs beside travel.
SLIDES, BEYOND = 24, 100.0


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


class Answer(NamedTuple):
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
    return np.asarray(((q >= limits[:, 0] - LIMIT_SLACK_RAD) & (q <= limits[:, 1] + LIMIT_SLACK_RAD)).all(axis=-1))


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
    form = robot.closed_form if method == "closed" and target.direction is None else None
    if form and target.turned and (alone := _alone(form, robot, target, present, limits)) is not None:
        return alone
    q, least = _found(form, robot, target, present, limits, seed)
    found = answer(robot, target, q, present, limits, least=least, polish=polish)
    if not (stands and within_limits(present, limits) and errors_of(robot, target, present[None])[2][0]):
        return found
    # The arm is there: it stays.
    here = Solution(tuple(present.tolist()), True, partial(_missed, robot, target))
    others = [one for one in found.solutions if np.abs(present - one.q_rad).max() > SAME_RAD]
    return Answer(True, 0.0, (here, *(others if found.reachable else ())))


def answer(
    robot: Robot, target: Target, q: FloatArray, present: FloatArray, limits: FloatArray, *, least: float, polish: bool
) -> Answer:
    """Configurations, shape (k, n), judged, polished and sorted; `least` is the least distance [m]."""
    q = within_a_turn(q, limits)
    if polish:
        q = _polished(robot, target, q)
    position_m, turn_rad, reached = errors_of(robot, target, q)
    keep = np.flatnonzero(reached) if reached.any() else np.arange(len(q))
    misses = np.zeros(len(keep)) if reached.any() else np.round(position_m + turn_rad, 9)[keep]
    order = keep[_order(q[keep], weighted_travel(q[keep], present, limits), ~within_limits(q[keep], limits), misses)]
    judge = partial(_missed, robot, target)
    solutions = [Solution(tuple(one.tolist()), bool(within_limits(one, limits)), judge) for one in _distinct(q[order])]
    return Answer(bool(reached.any()), least, tuple(solutions))


def _alone(form: ClosedForm, robot: Robot, target: Target, present: FloatArray, limits: FloatArray) -> Answer | None:
    """Every solution of a pose by its closed form in plain floats.

    None where the pose is singular or a family, none is within limits, or the arm may be there already.
    """
    ranges, turn = [(*ends, here) for ends, here in zip(limits.tolist(), present.tolist(), strict=True)], 2.0 * math.pi
    found = []
    for angles in form.pose(target.T.tolist()):
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
    if any(more[1] - one[1] < SAME_RAD for one, more in pairwise(found)):
        found.sort(key=lambda one: (one[0], round(one[1], EQUAL_DIGITS), [-round(at, EQUAL_DIGITS) for at in one[2]]))
    if not found or found[0][0] or found[0][1] < NEAR_RAD:
        return None
    judge = partial(_missed, robot, target)
    return Answer(True, 0.0, tuple(Solution(q, not outside, judge) for outside, _, q in found))


def _missed(robot: Robot, target: Target, q: tuple[float, ...]) -> tuple[float, float]:
    position_m, turn_rad, _ = errors_of(robot, target, np.array([q]))
    return float(position_m[0]), float(turn_rad[0])


def _found(
    form: ClosedForm | None, robot: Robot, target: Target, present: FloatArray, limits: FloatArray, seed: int
) -> tuple[FloatArray, float]:
    """Configurations that reach the target, shape (k, n), and 0, or the nearest and how near they come [m]."""
    starts = np.empty((0, len(present)))
    if form is not None:
        families = form.pose_families(target.T) if target.turned else form.positions(target.position_m[None])[0]
        branches = [_cheapest(finite(family), present, limits, MEMBERS) for family in families]
        of, starts = np.repeat(np.arange(len(branches)), list(map(len, branches))), np.concatenate(branches)
        on = errors_of(robot, target, starts)[2]
        q = _slid(robot, target, starts[on], present, limits)
        # Where members of families lie in steps there may be one within the limits between two of them.
        if len(q) and (families.shape[1] == 1 or not _beyond_rad(q, limits).all()):
            return np.concatenate([_nearest(q[of[on] == k], present, limits) for k in np.unique(of[on])]), 0.0
        if target.turned and not len(q):
            return form.nearest_pose(target.T)
        starts = _cheapest(finite(families), present, limits, STARTS)
    q, least = _searched(robot, target, starts, present, limits, seed)
    closed = robot.closed_form if target.direction is None else None
    if closed is None or least == 0.0:
        return q if form is closed else _cheapest(q, present, limits, 1), least
    return closed.nearest_pose(target.T) if target.turned else closed.nearest_position(target.position_m)


def _searched(
    robot: Robot, target: Target, starts: FloatArray, present: FloatArray, limits: FloatArray, seed: int
) -> tuple[FloatArray, float]:
    """As `_found`, from many starts, shape (k, n): those given, the present one, and drawn ones."""
    rng = np.random.default_rng(seed)
    for ranges in (*(limits,) * ROUNDS, _whole_turns(robot)):
        drawn = rng.uniform(ranges[:, 0], ranges[:, 1], (STARTS, len(ranges)))
        q = refine(robot, target, np.vstack([present, starts, drawn]), ranges)
        position_m, turn_rad, on = errors_of(robot, target, q)
        if on.any():
            q = _distinct(_cheapest(q[on], present, limits, len(q)))[:FOUND]
            return _slid(robot, target, q, present, limits), 0.0
    best = int((position_m + turn_rad).argmin())
    return q[best : best + 1], float(position_m[best])


def _beyond_rad(q: FloatArray, limits: FloatArray) -> FloatArray:
    """By how much configurations, shape (..., n), are beyond their limits, all joints together; 0: they are not."""
    return np.asarray(np.maximum(np.maximum(limits[:, 0] - q, q - limits[:, 1]) - LIMIT_SLACK_RAD, 0.0).sum(axis=-1))


def _cost(q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Travel, or more than any travel beyond the limits; shape (..., n) -> (...,)."""
    return np.asarray(weighted_travel(q, present, limits) + BEYOND * _beyond_rad(q, limits))


def _cheapest(q: FloatArray, present: FloatArray, limits: FloatArray, count: int) -> FloatArray:
    q = within_a_turn(q, limits)
    return np.asarray(q[_order(q, _cost(q, present, limits))[:count]])


def _nearest(q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Of one branch, shape (k, n), the nearest member, and its mirror image where that is as near."""
    q = _cheapest(q, present, limits, len(q))
    cost = _cost(q, present, limits)
    twins = np.flatnonzero((cost < cost[0] + SAME_RAD) & (np.abs(q - q[0]).max(axis=1) > NEAR_RAD))
    return np.asarray(q[[0, *twins[:1]]])


def _order(q: FloatArray, travel: FloatArray, *before: FloatArray | NDArray[np.bool_]) -> NDArray[np.intp]:
    """Indices that sort configurations, shape (k, n): first by the last key `before`, ..., then travel, then joints."""
    return np.lexsort((*np.round(-q, EQUAL_DIGITS).T[::-1], np.round(travel, EQUAL_DIGITS), *before))


def _distinct(q: FloatArray) -> FloatArray:
    """Of configurations, shape (k, n), those that none taken before them is; few are, of thousands."""
    taken, joints = [], q.shape[1]
    while len(q):
        taken.append(q[0])
        q = q[np.abs(q - q[0]).max(axis=1) >= SAME_RAD]
    return np.reshape(taken, (-1, joints))


def _slid(robot: Robot, target: Target, q: FloatArray, present: FloatArray, limits: FloatArray) -> FloatArray:
    """Configurations that reach a target, shape (k, n), each moved nearer as far as that leaves it free.

    A redundant arm is, and any arm in a singular pose. There each joint in turn may move while others make up for it,
    or all towards the present. Travel along such a way is least where a joint comes to where it is at present, or to a
    limit: these places are tried, brought onto the target again, and kept if they are nearer. Where ways bend too much
    for that, shorter ones are tried.
    """
    rows, turning = 6 if target.turned else 3, limits[:, 1] - limits[:, 0] >= TURN_RAD
    most, cost, q = np.full(len(q), TURN_RAD), _cost(q, present, limits), q.copy()
    for _ in range(SLIDES):
        open_ = np.flatnonzero(most > SAME_RAD)
        if not len(open_):
            break
        now, step = q[open_], most[open_, None, None]
        J = masked_jacobian(robot.chain, now, target.direction)[:, :rows]
        free = np.eye(len(limits)) - np.linalg.pinv(J, rcond=SINGULAR) @ J
        here = np.where(turning, now + np.remainder(present - now + np.pi, TURN_RAD) - np.pi, present)
        ways = np.concatenate([free, (free @ (here - now)[..., None]).swapaxes(1, 2)], axis=1)  # candidate, way, joint
        size = np.abs(ways).max(axis=2)
        ways /= np.where(size > SINGULAR, size, np.inf)[..., None]
        low, high = (np.broadcast_to(end, now.shape) for end in limits.T)
        ends = np.stack([end + turn for end in (here, low, high) for turn in (0.0, TURN_RAD, -TURN_RAD)], axis=1)
        with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
            steps = ((ends - now[:, None])[:, None] / ways[:, :, None]).reshape(*ways.shape[:2], -1)
        steps = np.clip(np.nan_to_num(steps, posinf=0.0, neginf=0.0), -step, step)
        tried = (now[:, None, None] + steps[..., None] * ways[:, :, None]).reshape(len(now), -1, len(limits))
        tried = within_a_turn(tried, limits)
        tried_cost = _cost(tried, present, limits)
        moved = refine(robot, target, tried[np.arange(len(now)), tried_cost.argmin(axis=1)], limits)
        moved_cost = np.where(errors_of(robot, target, moved)[2], _cost(moved, present, limits), np.inf)
        better = moved_cost < cost[open_] - SAME_RAD
        q[open_[better]], cost[open_[better]] = moved[better], moved_cost[better]
        # Where even the straight way comes no nearer there is nothing to be had.
        least = tried_cost.min(axis=1) < cost[open_] - SAME_RAD
        most[open_] = np.where(better, most[open_], np.where(least, most[open_] / 4.0, 0.0))
    return q


def errors_of(robot: Robot, target: Target, q: FloatArray) -> tuple[FloatArray, FloatArray, NDArray[np.bool_]]:
    """Distance [m], turn [rad] and whether the target counts as reached, for configurations of shape (k, n)."""
    if target.turned:
        position_m, turn_rad = pose_errors(robot.chain, q, np.broadcast_to(target.T, (len(q), 4, 4)), target.direction)
    else:
        position_m = np.linalg.norm(tool_position(robot.chain, q) - target.position_m, axis=-1)
        turn_rad = np.zeros(len(q))
    return position_m, turn_rad, (position_m <= REACHED_M) & (turn_rad <= REACHED_RAD)


def refine(robot: Robot, target: Target, q: FloatArray, limits: FloatArray) -> FloatArray:
    """The configurations, shape (k, n), brought as near to the target as they go within limits."""
    T = np.broadcast_to(target.T, (len(q), 4, 4))
    return refine_poses(robot.chain, T, q, limits, turned=target.turned, direction=target.direction)


def _whole_turns(robot: Robot) -> FloatArray:
    """Joint ranges of a whole turn each [rad], shape (n, 2)."""
    return np.tile([-np.pi, np.pi], (robot.chain.n, 1))


def _polished(robot: Robot, target: Target, q: FloatArray) -> FloatArray:
    """The configurations brought onto the target, each near where it was; as they are where that does not succeed."""
    refined = refine(robot, target, q, _whole_turns(robot))
    near = q + (refined - q + np.pi) % (2.0 * np.pi) - np.pi
    return np.where(errors_of(robot, target, refined)[2][:, None], near, q)
