"""`solve` as users call it: what it finds, what it takes, and what others take in the same run.

Poses come of configurations drawn within the joint ranges, and of such with some joints at an end of their range or at
a quarter turn, where arms are singular. The arm stands somewhere else within its ranges. Of every pose

- there is a posture within the ranges: one has to be found, and the best is no farther than the one it was made of;
- where that one stands alone (its Jacobian has full rank), it has to be among those that are found;
- an arm that is in it stays.

Of the first poses of each kind a search of its own looks for more: damped least squares from 30 starts, one of them the
present posture, on a chain that is multiplied out here. None of what it finds alone may be missing; the nearest of it
is not nearer than the best by more than rounding. Arms whose poses leave them a family, and chains without a closed
form, take longer and get fewer poses; of those the shares are told.
"""

import importlib.util
import math
import tempfile
import time
import warnings
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import solve
from armctl.kinematics.target import pose_target
from proving.drawn_arms import DrawnArm, along_x, along_z, drawn, turned
from proving.figures import check, row
from proving.truth import FloatArray

CLOSED = (
    "puma560",
    "transfer-6dof",
    "lanzhou-4dof",
    "xiang-6dof",
    "crane-plus-v2",
    "phantomx-pincher",
    "phantomx-reactor",
)
FAMILIES = ("ax12-line",)
# Numbers of drawn arms without a closed form: three joints, an offset wrist, seven joints.
DRAWN = (0, 1, 2)
POSES, EDGES, DENSE = 100_000, 10_000, 200
SLOW_POSES, SLOW_EDGES, SLOW_DENSE = 300, 100, 50
RESTARTS, STEPS = 30, 60
ALONE_US, FOUND_SHARE, NEAREST_SHARE = 60.0, 0.999, 0.99
# Configurations that are one, and Jacobians of full rank (smallest over largest singular value).
SAME_RAD, FULL = 1e-4, 1e-3
# What the search counts as reached [m and rad], and how much nearer is nearer [rad].
REACHED, NEARER_RAD = 1e-7, 1e-3
TIMED = 300


@dataclass
class Told:
    """What is counted of one arm."""

    poses: int = 0
    # In range a posture exists, and none was found; one that stands alone is not among those found.
    none_found: int = 0
    missed: int = 0
    # Searched for, and something nearer was found.
    searched: int = 0
    farther: int = 0
    left: int = 0
    us: list[float] = field(default_factory=list)


def bench(
    seed: int,
    poses: tuple[int, int, int] = (POSES, EDGES, DENSE),
    slow: tuple[int, int, int] = (SLOW_POSES, SLOW_EDGES, SLOW_DENSE),
    arms: tuple[str | int, ...] = (*CLOSED, *FAMILIES, *DRAWN),
) -> dict[str, Any]:
    """Rows and checks; `ratio` is to the same of a PUMA 560 where it is a time."""
    rows, checks = [], []
    for name in arms:
        robot, arm = _arm(seed, name)
        told = judged(robot, arm, seed, *(poses if name in CLOSED else slow))
        us = float(np.median(told.us))
        found, nearest = 1.0 - told.none_found / told.poses, 1.0 - told.farther / max(told.searched, 1)
        rows += [
            row("solve() of a pose, alone", str(name), us, "us", us / ALONE_US),
            row("poses with a posture in range", str(name), found, "", found),
            row("the nearest of 30 restarts", str(name), nearest, "", nearest),
            row("postures missed", str(name), float(told.missed), "", 0.0),
        ]
        checks.append(check(f"{name}: present posture left", told.left, 0))
        if name in CLOSED:
            checks.append(check(f"{name}: postures missed", told.missed + told.none_found, 0))
            checks.append(check(f"{name}: solve() alone [us]", us, ALONE_US))
        else:
            checks.append(check(f"{name}: found in range", found, FOUND_SHARE, least=True))
        checks.append(check(f"{name}: nearest of 30 restarts", nearest, NEAREST_SHARE, least=True))
    rows += _peers(seed)
    return {"rows": rows, "checks": checks, "seed": seed}


def judged(robot: Robot, arm: DrawnArm, seed: int, poses: int, edges: int, dense: int) -> Told:
    """Everything of one arm."""
    told, rng = Told(), np.random.default_rng((seed, 41))
    low, high = arm.limits_rad.T
    for count, at_edges in ((poses, False), (edges, True)):
        q = rng.uniform(low, high, (count, arm.n))
        if at_edges:
            special = np.stack([low, high, *(np.full(arm.n, a) for a in np.radians((-90.0, 0.0, 90.0)))])
            special = np.clip(special[rng.integers(len(special), size=q.shape), np.arange(arm.n)], low, high)
            q = np.where(rng.random(q.shape) < 0.4, special, q)
        T, rank = arm.tool_pose(q), _rank(arm, q)
        present = rng.uniform(low, high, (count, arm.n))
        for k in range(count):
            _one(told, robot, arm, q[k], T[k], present[k], bool(rank[k] > FULL))
        for k in range(min(dense, count)):
            _dense(told, robot, arm, T[k], present[k], rng)
    return told


def _one(told: Told, robot: Robot, arm: DrawnArm, q: FloatArray, T: FloatArray, at: FloatArray, alone: bool) -> None:
    target = pose_target(T)
    begin = time.perf_counter()
    answer = solve(robot, target, present=at, limits=arm.limits_rad)
    if len(told.us) < TIMED:
        told.us.append((time.perf_counter() - begin) * 1e6)
    told.poses += 1
    best, inside = np.array(answer.solutions[0].q_rad), answer.solutions[0].within_limits and answer.reachable
    told.none_found += not inside
    if inside and alone:
        found = np.array([one.q_rad for one in answer.solutions])
        told.missed += bool(_apart(found, q).min() > SAME_RAD)
    if inside and told.poses % 10 == 0:
        told.left += bool(_apart(np.array(solve(robot, target, present=q, limits=arm.limits_rad).solutions[0].q_rad), q)
                          > 0.0)  # fmt: skip
        told.missed += bool(_travel(best, at, arm) > _travel(q, at, arm) + NEARER_RAD) and robot.closed_form is not None


def _dense(told: Told, robot: Robot, arm: DrawnArm, T: FloatArray, at: FloatArray, rng: np.random.Generator) -> None:
    """What a search of its own finds."""
    low, high = arm.limits_rad.T
    found = search(arm, T, np.vstack([at, rng.uniform(low, high, (RESTARTS - 1, arm.n))]))
    if not len(found):
        return
    answer = solve(robot, pose_target(T), present=at, limits=arm.limits_rad)
    ours = np.array([one.q_rad for one in answer.solutions])
    told.searched += 1
    best_rad = _travel(ours[0], at, arm) if answer.solutions[0].within_limits else math.inf
    told.farther += bool(best_rad > _travel(found, at, arm).min() + NEARER_RAD)
    if robot.closed_form is not None:
        for one in found[_rank(arm, found) > FULL]:
            told.missed += bool(_apart(ours, one).min() > SAME_RAD)


def search(arm: DrawnArm, T: FloatArray, q: FloatArray) -> FloatArray:
    """Configurations within the ranges that reach a pose, from each of some starts, shape (k, n)."""
    low, high = arm.limits_rad.T
    damping, error = np.full(len(q), 1e-2), _error(arm, q, T)
    for _ in range(STEPS):
        J = _jacobian(arm, q)
        JT = J.transpose(0, 2, 1)
        gradient, gram = (JT @ error[..., None])[..., 0], JT @ J
        # What pushes against an end of its range does not count.
        held = ((q <= low) & (gradient < 0.0)) | ((q >= high) & (gradient > 0.0))
        gradient[held] = 0.0
        gram[held[:, :, None] | held[:, None, :]] = 0.0
        gram[:, np.arange(arm.n), np.arange(arm.n)] += damping[:, None] + held
        tried = np.clip(q + np.linalg.solve(gram, gradient[..., None])[..., 0], low, high)
        left = _error(arm, tried, T)
        better = np.linalg.norm(left, axis=1) < np.linalg.norm(error, axis=1)
        q, error = np.where(better[:, None], tried, q), np.where(better[:, None], left, error)
        damping = np.clip(np.where(better, damping * 0.1, damping * 10.0), 1e-12, 1e6)
    return np.asarray(q[np.abs(error).max(axis=1) <= REACHED])


def _error(arm: DrawnArm, q: FloatArray, T: FloatArray) -> FloatArray:
    """What is missing of position [m] and turn [rad], shape (m, 6)."""
    now = arm.tool_pose(q)
    R = T[:3, :3] @ now[:, :3, :3].transpose(0, 2, 1)
    sine = np.stack([R[:, 2, 1] - R[:, 1, 2], R[:, 0, 2] - R[:, 2, 0], R[:, 1, 0] - R[:, 0, 1]], axis=1) / 2.0
    length, cosine = np.linalg.norm(sine, axis=1), (np.trace(R, axis1=1, axis2=2) - 1.0) / 2.0
    angle = np.arctan2(length, cosine)
    return np.hstack([T[:3, 3] - now[:, :3, 3], sine * (angle / np.maximum(length, 1e-12))[:, None]])


def _jacobian(arm: DrawnArm, q: FloatArray) -> FloatArray:
    places, axes = arm.axes(q)
    arms_m = places[:, -1:] - places[:, :-1]
    return np.concatenate([np.cross(axes, arms_m), axes], axis=2).transpose(0, 2, 1)


def _rank(arm: DrawnArm, q: FloatArray) -> FloatArray:
    """Smallest over largest singular value, shape (m,); 0 with more joints than a pose has freedoms."""
    if arm.n > 6:
        return np.zeros(len(q))
    values = np.linalg.svd(_jacobian(arm, q), compute_uv=False)
    return np.asarray(values[:, -1] / values[:, 0])


def _apart(q: FloatArray, other: FloatArray) -> Any:
    return np.abs((q - other + math.pi) % (2.0 * math.pi) - math.pi).max(axis=-1)


def _travel(q: FloatArray, at: FloatArray, arm: DrawnArm) -> Any:
    """The waist counts double; a joint that turns all round goes the short way."""
    way = np.abs(q - at)
    around = np.minimum(way % (2.0 * math.pi), -way % (2.0 * math.pi))
    whole = arm.limits_rad[:, 1] - arm.limits_rad[:, 0] >= 2.0 * math.pi - 1e-9
    return (np.where(whole, around, way) * np.where(np.arange(arm.n) == 0, 1.0, 0.5)).sum(axis=-1)


def _arm(seed: int, name: str | int) -> tuple[Robot, DrawnArm]:
    """An arm by its name, or a drawn one by its number; and the same, multiplied out."""
    if isinstance(name, int):
        arm = drawn(seed, name)
        with tempfile.TemporaryDirectory() as folder:
            return robots.of(load_arm(str(arm.write(Path(folder))))), arm
    robot = robots.get(name) if name in robots.names() else robots.of(load_arm(name))
    return robot, of_chain(robot.chain, robot.limits_rad)


def of_chain(chain: SerialChain, limits_rad: FloatArray) -> DrawnArm:
    """A table as frames and axes."""
    links, after, standard = [], np.eye(4), chain.convention == "standard"
    for dh in chain.rows:
        turn = along_z(math.degrees(dh.offset), 0.0)
        if standard:
            turn[2, 3] = dh.d
            links.append((after @ turn, np.array([0.0, 0.0, 1.0])))
            after = along_x(math.degrees(dh.alpha), dh.a)
        else:
            links.append((after @ _modified(dh) @ turn, np.array([0.0, 0.0, 1.0])))
            after = np.eye(4)
    after = after @ along_x(0.0, chain.tool_m)
    if chain.tool is not None:
        after = after @ _modified(chain.tool) @ along_z(math.degrees(chain.tool.offset), 0.0)
    return DrawnArm("", {}, tuple(links), after, limits_rad)


def _modified(dh: Any) -> FloatArray:
    """All of a modified row but its turn about z."""
    T = along_x(math.degrees(dh.alpha), dh.a)
    T[:3, 3] += T[:3, :3] @ (0.0, dh.b, dh.d)
    return np.asarray(T @ turned(np.array([0.0, 1.0, 0.0]), np.array([dh.beta]))[0])


def _peers(seed: int) -> list[dict[str, Any]]:
    """The time of others for a pose of a PUMA 560, alone, beside ours; who is not installed is told so with -1."""
    from proving.ik_bench import Pinocchio, starts, toolbox

    robot, arm = _arm(seed, "puma560")
    low, high = arm.limits_rad.T
    rng = np.random.default_rng((seed, 43))
    T, at = arm.tool_pose(rng.uniform(low, high, (TIMED, arm.n))), rng.uniform(low, high, (TIMED, arm.n))
    targets = [pose_target(one) for one in T]
    ets, pin, drawn_starts = toolbox(robot.chain).ets(), Pinocchio(robot.chain), starts(seed)
    work: dict[str, Callable[[int], Any]] = {
        "armctl, solve()": lambda k: solve(robot, targets[k], present=at[k], limits=arm.limits_rad),
        "armctl, the closed form alone": lambda k: robot.closed_form and robot.closed_form.pose(T[k].tolist()),
        "roboticstoolbox, ik_LM (C++), tol 1e-14": lambda k: ets.ik_LM(T[k], tol=1e-14),
        "roboticstoolbox, ik_LM (C++), default tol": lambda k: ets.ik_LM(T[k]),
        "pinocchio, CLIK with restarts": lambda k: pin.inverse(T[k : k + 1], drawn_starts),
    }
    taken: dict[str, list[float]] = {who: [] for who in work}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for k in range(TIMED):
            for who, run in work.items():
                if k < TIMED // 10 or "pinocchio" not in who:
                    begin = time.perf_counter()
                    run(k)
                    taken[who].append((time.perf_counter() - begin) * 1e6)
    ours = float(np.median(taken["armctl, solve()"]))
    rows = [
        row("IK of a PUMA 560 pose, alone, median", who, float(np.median(us)), "us", float(np.median(us)) / ours)
        for who, us in taken.items()
    ]
    absent = [who for who in ("eaik", "py_opw_kinematics") if importlib.util.find_spec(who) is None]
    return rows + [row("not installed here", who, -1.0, "us", 0.0) for who in absent]
