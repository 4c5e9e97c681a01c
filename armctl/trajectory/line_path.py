"""Ways for the joints along a straight line: which posture to hold the arm in while the tool goes from A to B.

Rules.
1. A redundant arm has many ways along one line, each exact as long as servos are. On real ones they differ: a joint's
   error reaches the tool over its lever across the line, and a joint that turns around on the way crosses its play and
   turns its friction around there.
2. So ways are drawn at random (a posture at A, a posture at B, every point between projected onto the line), those that
   break limits are dropped, and the rest are ordered by levers and turning points.
3. A line that has no way is refused with what is wrong, and with the nearest line that has one.
"""

import math
from collections.abc import Sequence

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics.chain import SerialChain, jacobian, link_frames, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.course import Line
from armctl.trajectory.interpolate import PEAK_SPEED
from armctl.trajectory.preflight import Driven

STATIONS = 41
# How many postures are drawn at each end, and how many pairs of them are tried.
POSTURES, PAIRS = 150, 1500
# This much is kept free before each joint limit: corrections for sag need room.
MARGIN_RAD = math.radians(6.0)
# Share of each joint's speed limit that is used: corrections need room here too.
SPEED_SHARE = 0.8
# No joint but the first differs by more between the postures at A and B.
FARTHEST_RAD = 1.2
# Largest second difference between stations: a way that folds over on itself is none.
SMOOTH_RAD = 0.02
# A joint that goes back by this much turns around for good; by less, in proportion.
TURN_RAD = 0.03
REACHED_M = 1e-6
DAMPING_M2 = 1e-6
FLOOR_MARGIN_M = 0.003


def line_paths(on: Driven, line: Line, rng: np.random.Generator, *, most: int) -> FloatArray:
    """Ways of the joints along a line at `STATIONS` even stations, the most promising first.

    Args:
        most: How many at most.
    Returns:
        Joint positions [rad], shape (ways, STATIONS, n) of the robot's n joints.
    Raises:
        RequestRefused: code LINE, there is none; the reasons say why and what would do.
    """
    A, B, duration_s = np.asarray(line.A, dtype=np.float64), np.asarray(line.B, dtype=np.float64), line.duration_s
    check_line(A, B, duration_s)
    arm, chain = on.arm, on.robot.chain
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]]) + np.array([MARGIN_RAD, -MARGIN_RAD])
    progress = np.linspace(0.0, 1.0, STATIONS)
    on_line = A + progress[:, None] * (B - A)
    ends = [q[missed < REACHED_M] for q, missed in (near_point(chain, X, limits, rng) for X in (A, B))]
    if min(map(len, ends)) == 0:
        raise RequestRefused("LINE", _out_of_reach(chain, limits, A, B, arm.floor_m, rng))
    first, last = (end[rng.integers(0, len(end), PAIRS)] for end in ends)
    near = (np.abs(last - first)[:, 1:] < FARTHEST_RAD).all(axis=1) & (np.abs(last - first)[:, 0] < math.pi)
    first, last = first[near], last[near]
    ways = first[:, None] + (last - first)[:, None] * progress[:, None]
    ways, missed = onto(chain, np.broadcast_to(on_line, (*ways.shape[:2], 3)), ways, limits, 12)
    ways = ways[(missed < REACHED_M).all(axis=1) & (np.abs(np.diff(ways, 2, axis=1)) < SMOOTH_RAD).all(axis=(1, 2))]
    if not len(ways):
        raise RequestRefused("LINE", _out_of_reach(chain, limits, A, B, arm.floor_m, rng))
    ways = above_floor(chain, ways, arm, "line")
    speed_limits = np.array([joint.speed_limit_rad_s for joint in arm.joints[: chain.n]])
    speeds = np.abs(np.diff(ways, axis=1)).max(axis=1) * (STATIONS - 1) * PEAK_SPEED / duration_s
    load = (speeds / (SPEED_SHARE * speed_limits)).max(axis=1)
    load = np.maximum(load, np.linalg.norm(B - A) * PEAK_SPEED / duration_s / arm.tool_speed_limit_m_s)
    if load.min() > 1.0:
        enough = f"give {duration_s * load.min():.1f} s or more"
        raise RequestRefused("LINE", f"no way along the line is slow enough in {duration_s:g} s; {enough}")
    ways = ways[load <= 1.0]
    return np.asarray(ways[np.argsort(sensitivity_m(chain, ways, A, B), kind="stable")[:most]])


def above_floor(chain: SerialChain, ways: FloatArray, arm: ArmConfig, what: str) -> FloatArray:
    """Those of some ways [rad], shape (ways, m, n), that lead no link below the floor.

    Raises:
        RequestRefused: code LINE or PATH, whichever the ways lead along: there is none.
    """
    high = link_frames(chain, ways)[..., 1:, 2, 3].min(axis=(1, 2)) >= arm.floor_m + FLOOR_MARGIN_M
    if not high.any():
        text = f"every way along the {what} leads a link below the floor at {arm.floor_m:.3f} m; raise the {what}"
        raise RequestRefused(what.upper(), text)
    return np.asarray(ways[high])


def check_line(A: FloatArray, B: FloatArray, duration_s: float) -> None:
    """
    Raises:
        RequestRefused: code LINE, A and B make no line, or the duration is none.
    """
    ends = f"A {A.tolist()} and B {B.tolist()}"
    if not (np.isfinite(A).all() and np.isfinite(B).all() and A.shape == B.shape == (3,)):
        raise RequestRefused("LINE", f"{ends} must be three finite numbers each, in metres")
    if float(np.linalg.norm(B - A)) < 0.01:
        raise RequestRefused("LINE", f"{ends} are nearly the same point; give ends at least 0.01 m apart")
    if not (math.isfinite(duration_s) and duration_s > 0.0):
        raise RequestRefused("LINE", f"duration {duration_s} s; give more than 0 s")


def levers_m(chain: SerialChain, q: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """How far a radian of each joint moves the tool across AB [m/rad], shape (..., n), at q [rad], shape (..., n)."""
    along = (B - A) / np.linalg.norm(B - A)
    J = jacobian(chain, q)[..., :3, :]
    return np.asarray(np.linalg.norm(J - along[:, None] * (along @ J)[..., None, :], axis=-2))


def sensitivity_m(chain: SerialChain, ways: FloatArray, A: FloatArray, B: FloatArray) -> FloatArray:
    """What one radian of error at every joint, independent ones, costs at the tool across AB, turning points added.

    Args:
        ways: Joint positions [rad], shape (..., m, n).
    Returns:
        [m/rad], shape (...).
    """
    return turning_too(levers_m(chain, ways, A, B), ways)


def turning_too(lever: FloatArray, ways: FloatArray) -> FloatArray:
    """The same of ways [rad], shape (..., m, n), from how far a radian of each joint moves the tool off [m/rad]."""
    steps = np.diff(ways, axis=-2)
    back = np.minimum(np.maximum(steps, 0.0).sum(axis=-2), np.maximum(-steps, 0.0).sum(axis=-2))
    turning = np.minimum(back / TURN_RAD, 1.0) * lever.mean(axis=-2)
    return np.asarray(np.sqrt((lever**2).sum(axis=-1).mean(axis=-1)) + turning.sum(axis=-1))


def onto(
    chain: SerialChain, points: FloatArray, q: FloatArray, limits: FloatArray, iterations: int
) -> tuple[FloatArray, FloatArray]:
    """Joint positions near `q` with the tool on `points`, by damped least squares on all of them at once.

    Args:
        points: [m], shape (..., 3).
        q: [rad], shape (..., n).
        limits: [rad], shape (n, 2).
    Returns:
        q, shape (..., n), within limits, and the distances left [m], shape (...).
    """
    for _ in range(iterations):
        q = np.clip(q + np.clip(step_towards(chain, points, q), -0.3, 0.3), limits[:, 0], limits[:, 1])
    return q, np.linalg.norm(points - tool_position(chain, q), axis=-1)


def step_towards(chain: SerialChain, points: FloatArray, q: FloatArray) -> FloatArray:
    """The damped least squares step of the joints [rad], shape (..., n), that brings the tool towards `points`."""
    J = jacobian(chain, q)[..., :3, :]
    gram = J @ np.swapaxes(J, -1, -2) + DAMPING_M2 * np.eye(3)
    wanted = np.linalg.solve(gram, (points - tool_position(chain, q))[..., None])
    return np.asarray((np.swapaxes(J, -1, -2) @ wanted)[..., 0])


def near_point(
    chain: SerialChain, point: FloatArray, limits: FloatArray, rng: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """`POSTURES` random postures brought as near to a point as they go [rad], and the distances left [m]."""
    q = rng.uniform(limits[:, 0], limits[:, 1], (POSTURES, chain.n))
    return onto(chain, np.broadcast_to(point, (POSTURES, 3)), q, limits, 60)


def _out_of_reach(
    chain: SerialChain, limits: FloatArray, A: FloatArray, B: FloatArray, floor_m: float, rng: np.random.Generator
) -> Sequence[str]:
    """Why there is no way, and the nearest line that can be reached."""
    far = [(name, X, out_of_reach(chain, X, limits, floor_m, rng)) for name, X in (("A", A), ("B", B))]
    if reasons := [f"{name} ({point_text(X)}) m is {missing}" for name, X, missing in far if missing]:
        return reasons
    middle = (A + B) / 2.0
    for share in np.arange(0.95, 0.05, -0.05):
        a, b = middle + share * (A - middle), middle + share * (B - middle)
        if _followed(chain, limits, a, b, rng):
            nearest = f"the line from {point_text(a)} to {point_text(b)} can be followed"
            return [f"both ends can be reached, but not every point between them in one go; {nearest}"]
    return ["both ends can be reached, but not every point between them in one go; move the line away from the base"]


def out_of_reach(
    chain: SerialChain, point: FloatArray, limits: FloatArray, floor_m: float, rng: np.random.Generator
) -> str:
    """How far a point is out of reach, and the nearest one that is not; empty: some posture reaches it."""
    q, missed = near_point(chain, point, limits, rng)
    if missed.min() < REACHED_M:
        return ""
    nearest = point_text(tool_position(chain, q[missed.argmin()]), floor_m)
    return f"{missed.min() * 1e3:.0f} mm out of reach; the nearest point within the joint limits is {nearest}"


def _followed(chain: SerialChain, limits: FloatArray, a: FloatArray, b: FloatArray, rng: np.random.Generator) -> bool:
    """Whether some posture at `a` leads along the line to `b`."""
    q, missed = near_point(chain, a, limits, rng)
    q = q[missed < REACHED_M]
    alive = np.ones(len(q), dtype=bool)
    for point in a + np.linspace(0.0, 1.0, STATIONS)[:, None] * (b - a):
        q, missed = onto(chain, np.broadcast_to(point, (len(q), 3)), q, limits, 8)
        alive &= missed < REACHED_M
    return bool(alive.any())


def point_text(point: FloatArray, floor_m: float = -math.inf) -> str:
    """x,y,z [m] as somebody would type it, not below the floor."""
    x, y, z = point.tolist()
    return f"{x:.3f},{y:.3f},{max(z, floor_m):.3f}"
