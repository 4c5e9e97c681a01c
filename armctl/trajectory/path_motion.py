"""The motion of the joints that leads the tool along an outline: which posture, and when it is where.

Rules.
1. Postures that reach the first point are followed along the path, from station to station, by the least change of the
   joints: so none changes its branch. Those that break off are dropped. The rest are ordered as on a line: a joint's
   error should move the tool little off the path, and no joint should turn around. Those to whose begin a joint has to
   turn by `FARTHER_RAD` more than it need come last: an arm that faces its path does not reach for it over its back.
2. Beside the joint limits `line_path.MARGIN_RAD` are kept free, for corrections.
3. The tool goes at one speed. Where a joint would be too fast, as in a tight corner, it goes slower, and gets there
   gently. It sets off and arrives by `time_law`.
4. What runs taught of it (`relearnt`) is added to the joints on the way, and to the same way of the joints alone. At
   its ends, where the arm comes to rest and the control step corrects it there, nothing is.
"""

import math
from collections.abc import Iterator, Sequence
from itertools import islice
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics.chain import jacobian, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import LONGEST_S, JointTrajectory
from armctl.trajectory import line_path
from armctl.trajectory.course import ticks_of
from armctl.trajectory.interpolate import PEAK_SPEED, columns_at, joint_path, time_law
from armctl.trajectory.plan import Motion, against, led_in
from armctl.trajectory.preflight import Driven
from armctl.trajectory.reference import ReferencePath
from armctl.trajectory.refinement import Measured, smoothed, surprise
from armctl.trajectory.tool_path import DECIMALS, MOST_SHIFTS, Learnt, Outline, PathRequest

# Of the tool where nothing else is asked for.
SPEED_M_S = 0.03
SHORTEST_S = 2.0
# Between two places at which a posture is followed, and between two rows of the way that is kept.
STATION_M, ROW_M = 0.01, 0.001
FEWEST_ROWS, MOST_ROWS = 200, 4000
# No joint turns by more from station to station.
LARGEST_STEP_RAD = 0.3
TRIED_WAYS = 6
FARTHER_RAD = math.pi / 2.0
# So much before and after a place where the tool goes slower it does so, too.
GENTLE_M = 0.008
# What a duration is multiplied by while accelerations are too large, and how often.
LONGER, TIMES_LONGER = 1.25, 8
# Between two rows of what runs taught; and for how long it grows from nothing.
SHIFT_S, GROWS_S = 0.2, 0.6
# Points of the path that is told, and at which of them it is said how far rounding leads off it.
TOLD_ROWS, TOLD_EACH = 2000, 5


class PathMotion(NamedTuple):
    """A motion of the joints along a path, from where the arm is."""

    trajectory: JointTrajectory
    # The path as it was asked for, corners and all, by the share of the motion's time.
    reference: ReferencePath
    # How far rounding leads from it [m], at even times, shape (m,).
    rounding_m: FloatArray


def path_motion(request: PathRequest, q_now: Sequence[float], on: Driven) -> PathMotion:
    """The whole motion from where the arm is.

    Args:
        q_now: Where the joints are wanted [rad], shape (joints,).
    Raises:
        RequestRefused: code PATH, the tool cannot follow it; code PREFLIGHT, every reason against the best way, and
            what duration would do.
    """
    outline, arm, robot, learnt = Outline(request), on.arm, on.robot, request.learnt
    refused: tuple[str, ...] = ()
    mine = arm.arm_id, arm.calibration_hash, robot.chain.n
    if learnt and (learnt.arm_id, learnt.calibration_hash, len(learnt.begin_rad)) != mine:
        raise RequestRefused("FOREIGN_PATH", f"it was refined on arm {learnt.arm_id}, or before a calibration")
    begin_rad, farther_rad = (learnt.begin_rad, 0.0) if learnt else (q_now, FARTHER_RAD)
    for way in islice(joint_ways(outline, begin_rad, on, farther_rad), 1 if learnt else None):
        pace_s = _slowest_pace_s(way, outline, arm)
        duration_s, least_s = _duration_s(request.duration_s, pace_s, outline.length_m)
        if request.duration_s is not None and least_s > request.duration_s:
            refused = refused or (f"{request.duration_s:g} s are too short for it; give {least_s:.1f} s or more",)
            continue
        for _ in range(TIMES_LONGER):
            progress = _progress(pace_s, duration_s)
            motion = _motion(way, progress, duration_s, q_now[robot.chain.n :], learnt)
            reasons = against(motion, duration_s, on, q_now)
            if not reasons:
                return PathMotion(led_in(motion, duration_s, on, q_now, "path"), *_told(outline, progress))
            if request.duration_s is not None or not all("give it a duration" in reason for reason in reasons):
                break
            duration_s = min(LONGER * duration_s, LONGEST_S)
        refused = refused or reasons
    raise RequestRefused("PREFLIGHT", refused)


def joint_ways(outline: Outline, q_now: Sequence[float], on: Driven, farther_rad: float) -> Iterator[FloatArray]:
    """Ways of the joints along the path, at most `TRIED_WAYS`, the most promising first.

    Yields:
        Joint positions of the chain [rad], each of shape (m, n), at m even places along the path.
    Raises:
        RequestRefused: code PATH, there is none; says where the path leaves what the arm reaches.
    """
    arm, chain = on.arm, on.robot.chain
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
    limits = limits + np.array([line_path.MARGIN_RAD, -line_path.MARGIN_RAD])
    stations = np.linspace(0.0, outline.length_m, max(5, math.ceil(outline.length_m / STATION_M)) + 1)
    points = outline.rounded(stations)
    rng = np.random.default_rng(0)
    q, _ = line_path.near_point(chain, points[0], limits, rng)
    q = np.vstack([np.array(q_now[: chain.n]), q])
    followed, alive = [], np.ones(len(q), dtype=bool)
    for index, point in enumerate(points):
        before = q
        q, missed = line_path.onto(chain, np.broadcast_to(point, (len(q), 3)), q, limits, 60 if index == 0 else 8)
        alive &= missed < line_path.REACHED_M
        if index > 0:
            alive &= (np.abs(q - before) < LARGEST_STEP_RAD).all(axis=1)
        if not alive.any():
            far = line_path.out_of_reach(chain, point, limits, arm.floor_m, rng)
            why = f"is {far}" if far else "cannot be reached in one go from where the path begins; begin elsewhere"
            gone = f"the point {line_path.point_text(point)} m, {stations[index] * 1e3:.0f} mm along the path,"
            raise RequestRefused("PATH", f"{gone} {why}")
        followed.append(q)
    ways = line_path.above_floor(chain, np.stack(followed, axis=1)[alive], arm, "path")
    along = np.gradient(points, axis=0)
    along /= np.maximum(np.linalg.norm(along, axis=1, keepdims=True), 1e-12)
    J = jacobian(chain, ways)[..., :3, :]
    lever = np.linalg.norm(J - along[:, :, None] * (along[:, None, :] @ J), axis=-2)
    turn = np.abs(ways[:, 0] - np.array(q_now[: chain.n])).max(axis=1)
    rows = int(np.clip(math.ceil(outline.length_m / ROW_M), FEWEST_ROWS, MOST_ROWS)) + 1
    place = np.linspace(0.0, 1.0, rows)
    fine = outline.rounded(place * outline.length_m)
    knots = np.linspace(0.0, 1.0, len(stations))
    for i in np.lexsort((line_path.turning_too(lever, ways), turn > turn.min() + farther_rad))[:TRIED_WAYS]:
        yield line_path.onto(chain, fine, joint_path(ways[i], knots, place, "cubic"), limits, 12)[0]


def _slowest_pace_s(way: FloatArray, outline: Outline, arm: ArmConfig) -> FloatArray:
    """Time for the whole path [s] at each of the rows' greatest speed, neighbours considered, shape (m,)."""
    m, n = way.shape
    apart = 1.0 / (m - 1)
    speed = np.array([joint.speed_limit_rad_s for joint in arm.joints[:n]]) * line_path.SPEED_SHARE
    acceleration = np.array([joint.acceleration_limit_rad_s2 for joint in arm.joints[:n]]) * line_path.SPEED_SHARE
    first = np.abs(np.gradient(way, apart, axis=0))
    second = np.abs(np.gradient(np.gradient(way, apart, axis=0), apart, axis=0))
    tool = np.linalg.norm(np.gradient(outline.rounded(np.linspace(0.0, outline.length_m, m)), apart, axis=0), axis=1)
    pace_s = np.maximum((first / speed).max(axis=1), np.sqrt((second / acceleration).max(axis=1)))
    pace_s = np.maximum(pace_s, tool / (line_path.SPEED_SHARE * arm.tool_speed_limit_m_s))
    reach = max(1, round(GENTLE_M / outline.length_m * (m - 1)))
    padded = np.pad(pace_s, 2 * reach, mode="edge")
    highest = np.lib.stride_tricks.sliding_window_view(padded, 2 * reach + 1).max(axis=1)
    # The mean of the greatest around is nowhere less than what it is the mean for.
    return np.asarray(np.lib.stride_tricks.sliding_window_view(highest, 2 * reach + 1).mean(axis=1))


def _duration_s(wanted_s: float | None, pace_s: FloatArray, length_m: float) -> tuple[float, float]:
    """How long the motion is to take, and the least that the joints' speeds allow [s]."""
    least_s = PEAK_SPEED * float(pace_s.mean())
    if wanted_s is not None:
        return wanted_s, least_s
    even_s = np.maximum(pace_s, length_m / SPEED_M_S)
    return min(max(PEAK_SPEED * float(even_s.mean()), SHORTEST_S), LONGEST_S), least_s


def _progress(slowest_s: FloatArray, duration_s: float) -> tuple[FloatArray, FloatArray]:
    """Share of the cruise at which each row is passed, from 0 to 1, and the rows' progress; both of shape (m,)."""
    low_s, high_s = 0.0, duration_s
    for _ in range(60):
        even_s = (low_s + high_s) / 2.0
        if PEAK_SPEED * float(np.maximum(slowest_s, even_s).mean()) > duration_s:
            high_s = even_s
        else:
            low_s = even_s
    pace_s = np.maximum(slowest_s, low_s)
    gone = np.concatenate([[0.0], np.cumsum((pace_s[1:] + pace_s[:-1]) / 2.0)])
    return gone / gone[-1], np.linspace(0.0, 1.0, len(slowest_s))


def _motion(
    way: FloatArray, progress: tuple[FloatArray, FloatArray], lasts_s: float, others: Sequence[float], by: Learnt | None
) -> Motion:
    """Joint positions [rad], shape (m, joints), by the time since the begin; joints beyond the chain stay."""
    share, place = progress

    def positions(time_s: FloatArray) -> FloatArray:
        q = columns_at(np.interp(time_law(time_s / lasts_s), share, place), place, way)
        q += _shift(by, time_s / lasts_s)
        return np.concatenate([q, np.tile(np.asarray(others, dtype=np.float64), (len(q), 1))], axis=1)

    return positions


def _shift(learnt: Learnt | None, u: FloatArray) -> FloatArray:
    """What is added to the joints [rad] at shares of the time, shape (m, n); shape (1, 1) where nothing is."""
    if learnt is None:
        return np.zeros((1, 1))
    return columns_at(u, np.linspace(0.0, 1.0, len(learnt.shift_rad)), np.array(learnt.shift_rad))


class PathSeen(NamedTuple):
    """What a run of a path showed, at every tick of it, shape (m, n)."""

    # Where the joints were to be, and how far they stayed behind their goals, what was learnt included [rad].
    wanted_rad: FloatArray
    lag_rad: FloatArray
    # Root mean square of the smoothed readings' distances from the path.
    off_mm: float


def path_seen(request: PathRequest, motion: PathMotion, run: Measured, on: Driven) -> PathSeen:
    """What a run of a motion along a path showed."""
    way, n = motion.trajectory, on.robot.chain.n
    lasts_s = way.end_s - way.begin_s
    time_s = np.linspace(0.0, lasts_s, ticks_of(lasts_s, on.period_s))
    due_s = np.arange(len(way.positions_rad)) * np.float64(way.period_s) - way.begin_s
    goals = columns_at(time_s, due_s, np.array(way.positions_rad)[:, :n])
    wanted = goals - _shift(request.learnt, time_s / lasts_s)
    lag = goals - columns_at(time_s, run.time_s, run.positions_rad[:, :n])
    tool_m = tool_position(on.robot.chain, wanted + smoothed(goals - lag - wanted, on.period_s))
    off_m = motion.reference.off_m(tool_m, np.linspace(0.0, 1.0, len(tool_m)))
    return PathSeen(wanted, lag, float(np.sqrt(np.square(off_m).mean())) * 1e3)


def relearnt(last: PathRequest, motion: PathMotion, runs: Sequence[PathSeen], on: Driven, gain: float) -> PathRequest:
    """The path with a share of the lag that all its runs showed on the average added to its joints."""
    lasts_s, wanted = motion.trajectory.end_s - motion.trajectory.begin_s, runs[0].wanted_rad
    rows = min(math.ceil(lasts_s / SHIFT_S) + 1, MOST_SHIFTS // wanted.shape[1])
    u: FloatArray = np.linspace(0.0, 1.0, rows)
    grown = np.minimum(1.0, lasts_s * np.minimum(u, 1.0 - u) / GROWS_S)[:, None]
    lag = surprise(np.mean([run.lag_rad for run in runs], axis=0), wanted, on.period_s, gain)
    shift = (grown * columns_at(u, np.linspace(0.0, 1.0, len(lag)), lag)).round(DECIMALS).tolist()
    begin_rad, of = tuple(wanted[0].tolist()), {"arm_id": on.arm.arm_id, "calibration_hash": on.arm.calibration_hash}
    learnt = Learnt(begin_rad=begin_rad, shift_rad=tuple(map(tuple, shift)), **of)
    return last.model_copy(update={"learnt": learnt, "duration_s": lasts_s})


def _told(outline: Outline, progress: tuple[FloatArray, FloatArray]) -> tuple[ReferencePath, FloatArray]:
    u = np.linspace(0.0, 1.0, TOLD_ROWS + 1)
    way_m = np.interp(time_law(u), *progress) * outline.length_m
    reference = ReferencePath(u, outline.sharp(way_m))
    return reference, reference.off_m(outline.rounded(way_m)[::TOLD_EACH], u[::TOLD_EACH])
