"""The robots of the papers: each one's table, with lengths by the names that its paper gives them.

A row is (a, alpha [deg], d); "" is a length of 0. How a robot's inverse kinematics is closed, its axes tell
(`kinematics/structure.py`). What is wrong in print stands beside each robot; where a paper prints no joint ranges, they
are a whole turn each.
"""

import math
from typing import Literal

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot

Rows = tuple[tuple[str, float, str], ...]


def _robot(
    name: str,
    source: str,
    convention: Literal["standard", "modified"],
    rows: Rows,
    lengths_m: dict[str, float],
    *,
    tool: str = "",
    ranges_deg: tuple[tuple[float, float], ...] = (),
) -> Robot:
    def chain(lengths: dict[str, float]) -> SerialChain:
        at = {"": 0.0, **lengths}
        links = tuple(DHRow(at[a], math.radians(alpha), at[d]) for a, alpha, d in rows)
        return SerialChain(links, convention, tool_m=at[tool])

    return Robot(name, source, lengths_m, chain, ranges_deg)


# The gripping arm of Xiangtan: a waist, three parallel pitch joints, a hand that turns about its own axis. Lengths are
# taken as centimetres. The sixth servo closes the gripper. Eqs. (2) to (17) belong to another arm (no d1, an a4, a
# fourth turn of 90 deg). Joint ranges: eq. (18), a whole turn.
XIANG = _robot(
    "xiang-6dof",
    "Xiang Yao et al.: Kinematics simulation and realization of manipulator gripping items based on genetic "
    "algorithm, Fig. 9",
    "standard",
    (("", 90, "d1"), ("a2", 0, ""), ("a3", 0, ""), ("", -90, ""), ("", 0, "d5")),
    {"d1": 0.101, "a2": 0.123, "a3": 0.138, "d5": 0.155},
)

# The shoulder offset 0.1491 m stands in row 2, where other models of this robot have it in row 3: the axes of joints 2
# and 3 are parallel, so the tool is in the same place.
PUMA = _robot(
    "puma560",
    "Inverse kinematics of PUMA560 by an improved genetic algorithm (niches, catastrophe, migration), Table 1",
    "standard",
    (("", 90, ""), ("a2", 0, "d2"), ("a3", -90, ""), ("", 90, "d4"), ("", -90, ""), ("", 0, "")),
    {"a2": 0.4318, "d2": 0.1491, "a3": 0.0203, "d4": 0.4318},
)
# Table 2: the wanted pose, and those that its improved and its standard genetic algorithm reached [m, rad].
WANTED_XYZ_RPY = (0.0968, -0.7558, 0.0972, -2.7913, 2.1047, -1.6016)
IMPROVED_XYZ_RPY = (0.0922, -0.7533, 0.0963, -2.7902, 2.1027, -1.6005)
STANDARD_XYZ_RPY = (0.07484, -0.3022, 0.05, -2.6551, 2.0468, -1.6058)

# The arm of the straight line, Table I: a base yaw and four parallel pitch joints. A sixth servo rolls the tool about
# its own axis and does not move the tool point. The paper prints no lengths; chosen here: a reach of 0.38 m from the
# shoulder (a56: a5 + a6). No joint ranges either: those of an AX-12A about its middle.
AX12_LINE = _robot(
    "ax12-line",
    "Raharjo, Wahyunggoro, Priyatmadi: Optimization of Straight Movement 6 DOF Robot Arm with Genetic Algorithm",
    "standard",
    (("", 90, "d1"), ("a2", 0, ""), ("a3", 0, ""), ("a4", 0, ""), ("a56", 0, "")),
    {"d1": 0.10, "a2": 0.105, "a3": 0.105, "a4": 0.07, "a56": 0.10},
    ranges_deg=((-150.0, 150.0),) * 5,
)

# A waist, three parallel joints beside its axis, a tool in their plane: row 5 of the table, whose angle is always zero.
# Lengths as in eq. (2); d1, zero in the table, is the height of the shoulder. With alpha_1 = -90 deg a positive pitch
# turns the arm down, so within its ranges this arm works mostly below its shoulder.
LANZHOU_RANGES_DEG = ((-90.0, 90.0), (7.0, 131.0), (-90.0, 123.0), (-90.0, 82.0))
LANZHOU = _robot(
    "lanzhou-4dof",
    "Bao, Liu, Zhao: Kinematics Simulation of 4-DOF Manipulator, Table 1",
    "modified",
    (("", 0, "d1"), ("a2", -90, "d2"), ("a3", 0, ""), ("a4", 0, "")),
    {"d1": 0.0, "a2": 0.009, "d2": 0.042, "a3": 0.077, "a4": 0.097, "a5": 0.133},
    tool="a5",
    ranges_deg=LANZHOU_RANGES_DEG,
)
FIG_5_DEG = (0.0, 0.0, -90.0, 90.0)
QZ_DEG = (60.0, 45.0, -90.0, 90.0)

# The transfer robot: six joints, a spherical wrist and a tool 100 mm beyond it.
TRANSFER = _robot(
    "transfer-6dof",
    "Lu, Liu: Kinematics Analysis and Simulation on Transfer Robot with Six Degrees of Freedom, Table 1",
    "modified",
    (("", 0, ""), ("a1", -90, ""), ("a2", 0, ""), ("", 90, "d4"), ("", -90, ""), ("", 90, "d6")),
    {"a1": 0.100, "a2": 0.450, "d4": 0.160, "d6": 0.100},
)
INITIAL_DEG = (90.0, -90.0, 0.0, 0.0, 0.0, 0.0)
