"""URDF of an arm, and its frames.

Rules.
1. Every row i of the Denavit-Hartenberg table is A_i = G_i Rz(q_i) F_i with constant G_i and F_i. URDF puts a
   joint's axis at the origin of its child, so a row becomes two links: horn_i, which turns, and link_i, fixed to
   it, which is the Denavit-Hartenberg frame i.
2. Joints beyond the chain (a wrist roll) turn about the x axis of the frame before them and move no tool point.
3. `tool` is the chain's tool frame: what forward kinematics gives.
4. Shapes are primitive: what matters is where the frames are.
5. No name has a character that XML escapes (`NAME_PATTERN` of an arm's file).
"""

import math
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel.servos import MODELS
from armctl.kinematics.chain import DHRow, SerialChain, link_frames
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, cos_sin, inverted, rpy_from_matrix

BASE = "base_link"
TOOL = "tool"
RADIUS_M = 0.014


def moving_links(arm: ArmConfig) -> tuple[str, ...]:
    """Name of the link each joint moves, in joint order."""
    return tuple(f"link_{i}" for i in range(1, len(arm.joints) + 1))


def moving_frames(arm: ArmConfig, robot: Robot, q: FloatArray) -> FloatArray:
    """Pose of every moving link in the base frame.

    Args:
        q: Joint positions [rad], shape (joints,).
    Returns:
        T_base_link, shape (joints, 4, 4).
    """
    n = robot.chain.n
    frames = list(link_frames(robot.chain, q[:n])[1 : n + 1])
    for position in q[n : len(arm.joints)].tolist():
        frames.append(_turned_about_x(frames[-1], position))
    return np.array(frames)


def fixed_frames(arm: ArmConfig, robot: Robot) -> tuple[tuple[str, str, FloatArray], ...]:
    """The frames that never move against a moving link: (parent, child, T_parent_child)."""
    chain, links = robot.chain, moving_links(arm)
    rows = zip(links, chain.rows, strict=False)
    horns = ((link, _horn(link), inverted(_row_parts(chain, row)[1])) for link, row in rows)
    return (*horns, (links[chain.n - 1], TOOL, _tool_offset(chain)))


def urdf(arm: ArmConfig, robot: Robot) -> str:
    """The arm as URDF; joint names and limits from the calibration, frames from the robot's chain."""
    chain, links = robot.chain, moving_links(arm)
    lines = ['<?xml version="1.0"?>', f'<robot name="{arm.arm_id}">', *_link(BASE)]
    for index, (parent, link) in enumerate(pairwise((BASE, *links))):
        joint = arm.joints[index]
        if index < chain.n:
            G, F = _row_parts(chain, chain.rows[index])
            axis, child = "0 0 1", _horn(link)
        else:
            G, axis, child = np.eye(4), "1 0 0", link
        low, high = joint.limits_rad
        effort, velocity = MODELS[joint.model].stall_torque_Nm, joint.speed_limit_rad_s
        limit = f'<limit lower="{low!r}" upper="{high!r}" effort="{effort}" velocity="{velocity!r}"/>'
        lines += _joint(joint.name, "revolute", parent, child, f'{_frame(G)}<axis xyz="{axis}"/>', limit)
        if index < chain.n:
            lines += _link(child, F[:3, 3])
            lines += _joint(f"{link}:offset", "fixed", child, link, _frame(F))
        lines += _link(link)
    lines += _joint(f"{TOOL}:offset", "fixed", links[chain.n - 1], TOOL, _frame(_tool_offset(chain)))
    return "\n".join([*lines, f'  <link name="{TOOL}"/>', "</robot>", ""])


def _horn(link: str) -> str:
    return link.replace("link", "horn")


def _row_parts(chain: SerialChain, row: DHRow) -> tuple[FloatArray, FloatArray]:
    """(G, F) of one row: its transform is G Rz(q) F."""
    A0 = link_frames(SerialChain((row,), chain.convention), np.zeros(1))[1]
    # Standard: Rz(q) comes first. Modified: it stands before Tz(d), with which it commutes.
    return (np.eye(4), A0) if chain.convention == "standard" else (A0, np.eye(4))


def _tool_offset(chain: SerialChain) -> FloatArray:
    return np.asarray(link_frames(SerialChain((DHRow(),), "modified", chain.tool_m, chain.tool), np.zeros(1))[-1])


def _turned_about_x(T: FloatArray, angle: float) -> FloatArray:
    """Written out: a linear algebra library may round differently on another machine, and logs are replayed there."""
    c, s = cos_sin(angle)
    turned = T.copy()
    turned[:, 1], turned[:, 2] = c * T[:, 1] + s * T[:, 2], c * T[:, 2] - s * T[:, 1]
    return turned


def _origin(xyz: FloatArray, rpy: Sequence[float]) -> str:
    place, turn = (" ".join(repr(float(value)) for value in values) for values in (xyz, rpy))
    return f'<origin xyz="{place}" rpy="{turn}"/>'


def _frame(T: FloatArray) -> str:
    return _origin(T[:3, 3], rpy_from_matrix(T[:3, :3]))


def _joint(name: str, kind: str, parent: str, child: str, *lines: str) -> list[str]:
    inside = [f"    {line}" for line in (f'<parent link="{parent}"/><child link="{child}"/>', *lines)]
    return [f'  <joint name="{name}" type="{kind}">', *inside, "  </joint>"]


def _link(name: str, end: FloatArray | None = None) -> list[str]:
    """A link with a ball at its origin and, where it has a length, a rod from there to `end`."""
    shapes = [(np.zeros(3), (0.0, 0.0, 0.0), f'<sphere radius="{RADIUS_M * 1.4}"/>')]
    if end is not None and (length := float(np.linalg.norm(end))) > 0.0:
        x, y, z = (end / length).tolist()
        rpy = (0.0, math.acos(max(-1.0, min(1.0, z))), math.atan2(y, x))
        shapes.append((end / 2.0, rpy, f'<cylinder radius="{RADIUS_M}" length="{length!r}"/>'))
    seen = (f"    <visual>{_origin(centre, rpy)}<geometry>{shape}</geometry></visual>" for centre, rpy, shape in shapes)
    return [f'  <link name="{name}">', *seen, "  </link>"]
