"""The four-joint manipulator of Lanzhou: a waist, three parallel joints beside its axis, a tool in their plane.

Source: G. Bao, S. Liu, H. Zhao, "Kinematics Simulation of 4-DOF Manipulator", Table 1 (modified DH). Row 5 of the
table, whose angle is always zero, is the tool. Lengths are named as in eq. (2); d1, zero in the table, is the height
of the shoulder. With alpha_1 = -90 deg a positive pitch turns the arm down, so within its ranges this arm works mostly
below its shoulder.
"""

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot


def _chain(lengths: dict[str, float]) -> SerialChain:
    rows = (
        DHRow(d=lengths["d1"]),
        DHRow(a=lengths["a2"], alpha=-math.pi / 2.0, d=lengths["d2"]),
        DHRow(a=lengths["a3"]),
        DHRow(a=lengths["a4"]),
    )
    return SerialChain(rows, "modified", tool_m=lengths["a5"])


def _closed_form(lengths: dict[str, float]) -> PlanarArm:
    links_m = (lengths["a3"], lengths["a4"], lengths["a5"])
    return PlanarArm(links_m, height=lengths["d1"], a1=lengths["a2"], shoulder=lengths["d2"], up=-1.0)


LENGTHS_M = {"d1": 0.0, "a2": 0.009, "d2": 0.042, "a3": 0.077, "a4": 0.097, "a5": 0.133}
RANGES_DEG = ((-90.0, 90.0), (7.0, 131.0), (-90.0, 123.0), (-90.0, 82.0))
FIG_5_DEG = (0.0, 0.0, -90.0, 90.0)
QZ_DEG = (60.0, 45.0, -90.0, 90.0)

ROBOT = Robot(
    name="lanzhou-4dof",
    source="Bao, Liu, Zhao: Kinematics Simulation of 4-DOF Manipulator, Table 1",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    ranges_deg=RANGES_DEG,
)
