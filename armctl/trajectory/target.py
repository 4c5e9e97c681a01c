"""Where the joints have to be for the tool to be somewhere: the choice nearest to where they are.

The search begins at the present pose, and again at `STARTS` poses drawn within the limits, always the same ones;
of the solutions the one is taken whose farthest joint travels least.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from pydantic import Field, model_validator

from armctl.config import ArmConfig, Frozen
from armctl.errors import UnreachableTarget
from armctl.kinematics.inverse import pose_errors, refine_poses
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, pose_from_xyz_rpy
from armctl.trajectory.bounds import Joints, Point, Pose

STARTS = 12
POSITION_TOLERANCE_M = 1e-6
ORIENTATION_TOLERANCE_RAD = 1e-5
LIMIT_TOLERANCE_RAD = 1e-9


class MoveRequest(Frozen):
    """Where to go: just one of `joints_rad`, `point_m` and `pose`."""

    joints_rad: Joints | None = None
    point_m: Point | None = None
    pose: Pose | None = None
    # How long the motion takes; None: as long as it needs at a slow speed.
    duration_s: float | None = Field(None, gt=0.0, le=600.0)

    @model_validator(mode="after")
    def _one_target(self) -> MoveRequest:
        if sum(target is not None for target in (self.joints_rad, self.point_m, self.pose)) != 1:
            raise ValueError("joints_rad, point_m, pose: give just one of them")
        return self


def joints_at_point(point_m: Sequence[float], q_now: Sequence[float], arm: ArmConfig, robot: Robot) -> list[float]:
    """Joint positions [rad] inside the limits that put the tool point there; joints beyond the chain stay.

    Args:
        point_m: Tool point in the base frame, shape (3,).
        q_now: Present joint positions [rad], shape (joints,).
    Raises:
        UnreachableTarget: there are none; carries the nearest distance found.
    """
    x, y, z = point_m
    return _nearest(pose_from_xyz_rpy(x, y, z, 0.0, 0.0, 0.0), False, q_now, arm, robot)


def joints_at_pose(pose: Sequence[float], q_now: Sequence[float], arm: ArmConfig, robot: Robot) -> list[float]:
    """Joint positions [rad] inside the limits that give the tool that pose; joints beyond the chain stay.

    Args:
        pose: x, y, z [m], roll, pitch, yaw [rad] in the base frame, R = Rz(yaw) Ry(pitch) Rx(roll).
        q_now: Present joint positions [rad], shape (joints,).
    Raises:
        UnreachableTarget: there are none; carries the nearest distance found.
    """
    return _nearest(pose_from_xyz_rpy(*pose), True, q_now, arm, robot)


def _nearest(T: FloatArray, turned: bool, q_now: Sequence[float], arm: ArmConfig, robot: Robot) -> list[float]:
    chain = robot.chain
    limits = np.array([joint.limits_rad for joint in arm.joints[: chain.n]])
    here = np.array(q_now[: chain.n])
    others = np.random.default_rng(0).uniform(limits[:, 0], limits[:, 1], (STARTS, chain.n))
    targets = np.broadcast_to(T, (STARTS + 1, 4, 4))
    q = refine_poses(chain, targets, np.vstack([here, others]), limits, turned=turned)
    away_m, turned_rad = pose_errors(chain, q, targets)
    turned_rad = turned_rad * turned
    inside = ((q >= limits[:, 0] - LIMIT_TOLERANCE_RAD) & (q <= limits[:, 1] + LIMIT_TOLERANCE_RAD)).all(axis=1)
    reached = inside & (away_m <= POSITION_TOLERANCE_M) & (turned_rad <= ORIENTATION_TOLERANCE_RAD)
    if not reached.any():
        raise _unreachable(T, turned, away_m, turned_rad)
    found = np.clip(q[reached], limits[:, 0], limits[:, 1])
    best = found[np.abs(found - here).max(axis=1).argmin()]
    return [*best.tolist(), *q_now[chain.n :]]


def _unreachable(T: FloatArray, turned: bool, away_m: FloatArray, turned_rad: FloatArray) -> UnreachableTarget:
    """How near the best of the searches came; a pose is judged by both, a decimetre against a radian."""
    best = int((away_m + 0.1 * turned_rad).argmin())
    near_m = float(away_m[best])
    x, y, z = T[:3, 3]
    turn = f" and {math.degrees(turned_rad[best]):.1f} deg" if turned else ""
    return UnreachableTarget(
        f"target ({x:.4f}, {y:.4f}, {z:.4f}) m: the tool comes no nearer than {near_m * 1000.0:.1f} mm{turn} within "
        "the joint limits",
        near_m,
    )
