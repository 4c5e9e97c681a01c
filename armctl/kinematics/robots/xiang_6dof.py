"""The gripping arm of Xiangtan: a waist, three parallel pitch joints, a hand that turns about its own axis.

Source: Xiang Yao, Ao Jiang, Changqing Su, Haowu Zhao, Ming Cheng, "Kinematics simulation and realization of
manipulator gripping items based on genetic algorithm", Fig. 9 (standard DH, lengths taken as centimetres). The
sixth servo closes the gripper. Eqs. (2) to (17) belong to another arm (no d1, an a4, a fourth turn of 90 deg).
Joint ranges: eq. (18), a whole turn.
"""

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot

QUARTER = math.pi / 2.0


def _chain(lengths: dict[str, float]) -> SerialChain:
    rows = (
        DHRow(alpha=QUARTER, d=lengths["d1"]),
        DHRow(a=lengths["a2"]),
        DHRow(a=lengths["a3"]),
        DHRow(alpha=-QUARTER),
        DHRow(d=lengths["d5"]),
    )
    return SerialChain(rows, "standard")


def _closed_form(lengths: dict[str, float]) -> PlanarArm:
    return PlanarArm((lengths["a2"], lengths["a3"], lengths["d5"]), height=lengths["d1"], roll=True)


LENGTHS_M = {"d1": 0.101, "a2": 0.123, "a3": 0.138, "d5": 0.155}

ROBOT = Robot(
    name="xiang-6dof",
    source="Xiang Yao et al.: Kinematics simulation and realization of manipulator gripping items based on genetic "
    "algorithm, Fig. 9",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
)
