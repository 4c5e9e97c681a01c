"""Slow motions from rest to rest: how a plan's start, a rest pose or a single target is approached.

How long a quintic takes that keeps every joint's speed and acceleration and the tool's speed within their limits
follows from its peaks; a solver of time-optimal laws (toppra, ruckig) is of no use for a motion meant to be slow.
"""

import math
from collections.abc import Sequence

import numpy as np

from armctl.kinematics.chain import link_frames, tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory
from armctl.trajectory.interpolate import QUINTIC_PEAK_ACCELERATION, QUINTIC_PEAK_SPEED, rest_to_rest
from armctl.trajectory.preflight import Driven

APPROACH_SPEED_RAD_S = math.radians(20.0)
SHORTEST_APPROACH_S = 0.5


def approach_duration_s(q0: FloatArray, q1: FloatArray, on: Driven) -> float:
    """Time of a synchronised quintic of at most 20 deg/s, slower where a joint's or the tool's limit is lower.

    Args:
        q0, q1: Start and end [rad], shape (joints,).
    """
    distance, arm, robot = np.abs(q1 - q0), on.arm, on.robot
    if not distance.any():
        return 0.0
    speed = np.minimum([joint.speed_limit_rad_s for joint in arm.joints], APPROACH_SPEED_RAD_S)
    acceleration = np.array([joint.acceleration_limit_rad_s2 for joint in arm.joints])
    by_speed = float((QUINTIC_PEAK_SPEED * distance / speed).max())
    by_acceleration = math.sqrt(float((QUINTIC_PEAK_ACCELERATION * distance / acceleration).max()))
    duration_s = max(SHORTEST_APPROACH_S, by_speed, by_acceleration)
    points = tool_position(robot.chain, rest_to_rest(q0, q1, np.linspace(0.0, 1.0, 201))[:, : robot.chain.n])
    peak_m_s = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max()) * 200.0 / duration_s
    # The margin covers what 200 chords miss of the true peak.
    return duration_s * max(1.0, 1.02 * peak_m_s / arm.tool_speed_limit_m_s)


def approach_trajectory(
    q0: Sequence[float], q1: Sequence[float], on: Driven, label: str, duration_s: float | None = None
) -> JointTrajectory:
    """The slow motion from q0 to q1 [rad] on the grid of the arm's period; all joints arrive at once.

    Args:
        duration_s: How long it takes; None: as `approach_duration_s` says.
    """
    start, end = np.asarray(q0, dtype=np.float64), np.asarray(q1, dtype=np.float64)
    if duration_s is None:
        duration_s = approach_duration_s(start, end, on)
    rows = max(1, math.ceil(duration_s / on.period_s - 1e-9))
    positions = rest_to_rest(start, end, np.arange(rows + 1) / rows)
    return JointTrajectory(on.period_s, tuple(map(tuple, positions.tolist())), label=label)


def lowest_link_m(trajectory: JointTrajectory, robot: Robot) -> float:
    """Height [m] of the lowest joint axis or tool point beyond the shoulder during the motion."""
    q = np.array(trajectory.positions_rad)[:, : robot.chain.n]
    return float(link_frames(robot.chain, q)[..., min(2, robot.chain.n) :, 2, 3].min())
