"""A robot made of the table in an arm's file, and its lengths by name.

Every length of the table that is not 0 has a name by its column and row: `a2`, `d1`; the tool's are `tool_x`, `tool_y`,
`tool_z`. By these names `lengths_m` of the file and `calibrate --points` correct them.
"""

import math
from dataclasses import replace
from itertools import chain

import numpy as np

from armctl.config import ChainTable
from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, matrix_from_rpy


def robot_of(table: ChainTable, name: str, ranges_deg: tuple[tuple[float, float], ...] = ()) -> Robot:
    """The robot of a table.

    Args:
        ranges_deg: Of each of its joints; none given: a whole turn each.
    """
    numbered = [(f"{key}{i}", getattr(row, f"{key}_m")) for i, row in enumerate(table.dh, 1) for key in "abd"]
    tool = zip(("tool_x", "tool_y", "tool_z"), table.tool_m, strict=True)
    lengths_m = {key: float(length) for key, length in chain(numbered, tool) if length}
    told = [(row.alpha_deg, row.theta_deg, row.beta_deg, row.bend_deg_m, *row.waves_deg) for row in table.dh]
    angles = [tuple(map(math.radians, row)) for row in told]
    tool_bend = math.radians(table.tool_bend_deg_m)
    R = matrix_from_rpy(*map(math.radians, table.tool_rpy_deg))

    def made(lengths: dict[str, float]) -> SerialChain:
        rows = []
        for i, (alpha, theta, beta, bend, *waves) in enumerate(angles, 1):
            a, b, d = (lengths.get(f"{key}{i}", 0.0) for key in "abd")
            rows.append(DHRow(a, alpha, d, theta, b, beta, tuple(waves), bend))
        p = np.array([lengths.get(f"tool_{axis}", 0.0) for axis in "xyz"])
        return SerialChain(
            tuple(rows), table.convention, tool=replace(row_of(R, p), bend=tool_bend), base_m=table.base_m
        )

    return Robot(name, table.urdf or "a table in the arm's file", lengths_m, made, ranges_deg)


def row_of(R: FloatArray, p: FloatArray) -> DHRow:
    """The modified row that is a fixed rotation R, shape (3, 3), and place p [m], shape (3,).

    R = Rx(alpha) Ry(beta) Rz(theta); alpha is 0 where beta is +-90 deg, since only one angle about z is left then.
    """
    sine = max(-1.0, min(1.0, float(R[0, 2])))
    if math.hypot(R[0, 0], R[0, 1]) < 1e-12:
        alpha, beta, theta = 0.0, math.copysign(math.pi / 2.0, sine), math.atan2(R[1, 0], R[1, 1])
    else:
        alpha, theta = math.atan2(-R[1, 2], R[2, 2]), math.atan2(-R[0, 1], R[0, 0])
        beta = math.atan2(sine, math.hypot(R[0, 0], R[0, 1]))
    x, y, z = p.tolist()
    c, s = math.cos(alpha), math.sin(alpha)
    return DHRow(a=x, alpha=alpha, d=c * z - s * y, offset=theta, b=c * y + s * z, beta=beta)
