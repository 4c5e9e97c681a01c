"""What must hold before any motion may run; all reasons against it are told at once.

Rules.
1. A motion is rows of joint positions on a time grid, straight joint lines between them, at rest before and after.
2. Nothing is clipped or repaired; a reason names the part, the value, the bound and what to do.
3. Speeds and accelerations are those of the rows; acceleration is the change of speed over 0.1 s, so that a corner is
   judged as a servo sees it. Contact is checked at every degree of joint motion.
4. The arm may leave a pose that is forbidden by the thickness of its links alone: capsules are fatter than it is, and
   it already stands there. Links that overlap at the start may only come apart, what lies too low only rise.
"""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armctl.config import ArmConfig, JointConfig
from armctl.dynamixel.ax12a import TICK_MAX, TICK_RAD
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.trajectory.collision import floor_clearance, judged_pairs, link_clearance, link_points
from armctl.trajectory.interpolate import columns_at

START_TOLERANCE_RAD = math.radians(2.0)
# How far outside its limits a joint that was moved by hand may be found; it counts as at the limit.
EDGE_TICKS = 2
ACCELERATION_WINDOW_S = 0.1
# Rounding may make a motion that holds a limit exactly seem this much faster, at most.
ROUNDING = 1.001
LOOK_RAD = math.radians(1.0)
BLOCK_ROWS = 4096
SAME_M = 1e-6


class Driven(Protocol):
    """An arm, and how often it gets a goal."""

    arm: ArmConfig
    robot: Robot
    period_s: float


@dataclass
class DrivenArm:
    """The same, and nothing else."""

    arm: ArmConfig
    robot: Robot
    period_s: float


def preflight_motion(
    positions_rad: FloatArray, on: Driven, *, start_rad: Sequence[float] | None = None, duration_s: float | None = None
) -> tuple[str, ...]:
    """Every reason why this motion must not run on this arm; empty: it may.

    Args:
        positions_rad: Joint positions [rad], one row a period, shape (m, joints), in the calibration file's order.
        start_rad: Where the arm is commanded to be [rad], shape (joints,); None: the motion begins there.
        duration_s: The duration its maker can change, for the advice how to slow it down; None: the whole.
    """
    arm, robot, period_s = on.arm, on.robot, on.period_s
    q = np.asarray(positions_rad, dtype=np.float64)
    joints = len(arm.joints)
    if q.ndim != 2 or q.shape[0] < 2 or q.shape[1] != joints:
        return (f"the motion has shape {q.shape}; it needs two rows or more of {joints} joint positions",)
    if not np.isfinite(q).all():
        row, joint = np.argwhere(~np.isfinite(q))[0]
        return (f"{arm.joints[joint].name} is sent to {q[row, joint]} in row {row}; every position must be finite",)
    if not 0.0 < period_s < math.inf:
        return (f"the motion has a row every {period_s} s; the period must be above 0",)
    if duration_s is None:
        duration_s = period_s * (len(q) - 1)
    tool_m = tool_position(robot.chain, q[:, : robot.chain.n])
    tool_m_s, bound_m_s = peak_tool_speed(tool_m, period_s), arm.tool_speed_limit_m_s
    return (
        *_against_start(q[0], start_rad, arm),
        *_against_joints(q, period_s, arm, duration_s),
        *_too_fast("the tool", tool_m_s, bound_m_s, "m/s", 1.0, duration_s, digits=3),
        *_against_contact(_every_degree(q, period_s, arm), arm, robot),
    )


def peak_rates(q: FloatArray, period_s: float) -> tuple[FloatArray, FloatArray]:
    """Greatest speed and acceleration of columns sampled every `period_s`, at rest before and after.

    Args:
        q: Samples, shape (m, n), m >= 2.
    Returns:
        Speeds and accelerations over `ACCELERATION_WINDOW_S`, shape (n,), in the samples' unit a second.
    """
    window = max(1, round(ACCELERATION_WINDOW_S / period_s))
    padded = np.concatenate([np.repeat(q[:1], window, axis=0), q, np.repeat(q[-1:], window, axis=0)])
    bend = padded[2 * window :] - 2.0 * padded[window:-window] + padded[: -2 * window]
    return np.abs(np.diff(q, axis=0)).max(axis=0) / period_s, np.abs(bend).max(axis=0) / (window * period_s) ** 2


def times_too_fast(q: FloatArray, period_s: float, joints: Sequence[JointConfig]) -> float:
    """How many times slower columns of joint positions, as in `peak_rates`, have to be for the joints' limits."""
    speed, acceleration = peak_rates(q, period_s)
    by_speed = float((speed / [joint.speed_limit_rad_s for joint in joints]).max())
    return max(by_speed, math.sqrt(float((acceleration / [joint.acceleration_limit_rad_s2 for joint in joints]).max())))


def peak_tool_speed(tool_m: FloatArray, period_s: float) -> float:
    """Greatest speed [m/s] of tool points [m] sampled every `period_s`, shape (m, 3), m >= 2."""
    return float(np.linalg.norm(np.diff(tool_m, axis=0), axis=1).max()) / period_s


def _against_start(begin: FloatArray, start_rad: Sequence[float] | None, arm: ArmConfig) -> Iterator[str]:
    if start_rad is None:
        return
    if len(start_rad) != len(arm.joints) or not all(map(math.isfinite, start_rad)):
        yield f"the arm stands at {list(start_rad)}, not {len(arm.joints)} known joint angles; connect it first"
        return
    for joint, here, there in zip(arm.joints, start_rad, begin.tolist(), strict=True):
        if abs(there - here) > START_TOLERANCE_RAD:
            away_deg, bound_deg = math.degrees(abs(there - here)), math.degrees(START_TOLERANCE_RAD)
            away = f"the motion starts {away_deg:.1f} deg from where the arm is (bound {bound_deg:g})"
            yield f"joint {joint.name}: {away}; move it there slowly first"


def _against_joints(q: FloatArray, period_s: float, arm: ArmConfig, duration_s: float) -> Iterator[str]:
    speeds, accelerations = np.degrees(peak_rates(q, period_s)).tolist()
    for joint, column, fast, sudden in zip(arm.joints, q.T, speeds, accelerations, strict=True):
        yield from _against_limits(joint, column)
        yield from _too_fast(joint.name, fast, joint.speed_limit_deg_s, "deg/s", 1.0, duration_s)
        yield from _too_fast(joint.name, sudden, joint.acceleration_limit_deg_s2, "deg/s2", 0.5, duration_s)


def _too_fast(
    who: str, value: float, bound: float, unit: str, power: float, duration_s: float, *, digits: int = 1
) -> Iterator[str]:
    """What is against a speed, or an acceleration, which falls with the square of the duration (`power` 0.5)."""
    if value > bound * ROUNDING:
        reached = f"{who} would reach {value:.{digits}f} {unit}, at most {bound:.{digits}f} {unit}"
        yield f"{reached}; give it a duration of {duration_s * (value / bound) ** power:.1f} s or more"


def _against_limits(joint: JointConfig, column: FloatArray) -> Iterator[str]:
    (low_rad, high_rad), (low_deg, high_deg), slack_rad = joint.limits_rad, joint.limits_deg, TICK_RAD / 2.0
    lowest_rad, highest_rad = float(column.min()), float(column.max())
    outside = [lowest_rad] if lowest_rad < low_rad - slack_rad else []
    outside += [highest_rad] if highest_rad > high_rad + slack_rad else []
    for position_rad in outside:
        tick, verb = joint.tick(position_rad), "stands at" if position_rad == column[0] else "would go to"
        within = -0.5 <= tick <= TICK_MAX + 0.5
        dead = "" if within else f"; tick {tick:.0f} lies in the servo's dead zone (0 to {TICK_MAX})"
        limits = f"outside its limits {low_deg:.1f} to {high_deg:.1f} deg"
        yield f"{joint.name} {verb} {math.degrees(position_rad):.1f} deg, {limits}{dead}"


def _every_degree(q: FloatArray, period_s: float, arm: ArmConfig) -> FloatArray:
    """The path of the rows, at least one pose for every `LOOK_RAD` that any joint turns, both ends included."""
    step = np.abs(np.diff(q, axis=0))
    # A step beyond its speed limit is refused already: it need not be looked at any closer than a permitted one.
    step = np.minimum(step, [joint.speed_limit_rad_s * period_s for joint in arm.joints]).max(axis=1)
    turned = np.concatenate([[0.0], np.cumsum(step)])
    return columns_at(np.linspace(0.0, turned[-1], math.ceil(turned[-1] / LOOK_RAD) + 1), turned, q)


def _against_contact(q: FloatArray, arm: ArmConfig, robot: Robot) -> Iterator[str]:
    n, radius_m = robot.chain.n, arm.link_radius_m
    begin = link_points(robot.chain, q[0, :n])
    pairs = judged_pairs(begin, radius_m)
    gap_m, height_m = link_clearance(begin, pairs, radius_m), floor_clearance(begin, arm.floor_m, radius_m)
    gap_bound_m = np.minimum(gap_m, 0.0)
    # The links' thickness is forgiven where the arm stands; their middle, and the tool, stay above the floor.
    height_bound_m = np.clip(height_m, floor_clearance(np.zeros_like(begin), 0.0, radius_m), 0.0)
    for row in range(0, len(q), BLOCK_ROWS):
        points = link_points(robot.chain, q[row : row + BLOCK_ROWS, :n])
        gap_m = np.minimum(gap_m, link_clearance(points, pairs, radius_m).min(axis=0))
        height_m = np.minimum(height_m, floor_clearance(points, arm.floor_m, radius_m).min(axis=0))
    for pair in np.flatnonzero(gap_m < gap_bound_m - SAME_M):
        first, second = (int(link) for link in pairs[pair])
        apart_m = float(gap_m[pair]) + 2.0 * radius_m
        touched = "the base column" if first == 0 else f"link {first + 1}"
        apart = f"their middles come within {apart_m:.3f} m, at least {2.0 * radius_m:.3f} m"
        yield f"link {second + 1} would touch {touched}: {apart}; go by another pose"
    too_low_m = height_m - height_bound_m
    if len(too_low_m) and too_low_m.min() < -SAME_M:
        worst = int(too_low_m.argmin())
        part = "the tool" if worst == n - 2 else f"the end of link {worst + 2}"
        low = f"{arm.floor_m + height_m[worst]:.3f} m, below the floor at {arm.floor_m:.3f} m"
        yield f"{part} would come down to {low}; raise the motion, or begin it elsewhere"
