"""The PUMA 560 of the improved genetic algorithm.

Source: a Chinese paper on inverse kinematics of industrial robots by a genetic algorithm with niches, catastrophe
and migration; Table 1 (standard DH). The shoulder offset 0.1491 m stands in row 2, where other models of this robot
have it in row 3: the axes of joints 2 and 3 are parallel, so the tool is in the same place.

No joint ranges are printed: a whole turn each.
"""

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.spherical_wrist import SphericalWrist

QUARTER = math.pi / 2.0


def _chain(lengths: dict[str, float]) -> SerialChain:
    rows = (
        DHRow(alpha=QUARTER),
        DHRow(a=lengths["a2"], d=lengths["d2"]),
        DHRow(a=lengths["a3"], alpha=-QUARTER),
        DHRow(alpha=QUARTER, d=lengths["d4"]),
        DHRow(alpha=-QUARTER),
        DHRow(),
    )
    return SerialChain(rows, "standard")


def _closed_form(lengths: dict[str, float]) -> SphericalWrist:
    return SphericalWrist(a1=0.0, a2=lengths["a2"], a3=lengths["a3"], shoulder=lengths["d2"], d4=lengths["d4"], d6=0.0)


# Table 2: the wanted pose, and those that its improved and its standard genetic algorithm reached [m, rad].
WANTED_XYZ_RPY = (0.0968, -0.7558, 0.0972, -2.7913, 2.1047, -1.6016)
IMPROVED_XYZ_RPY = (0.0922, -0.7533, 0.0963, -2.7902, 2.1027, -1.6005)
STANDARD_XYZ_RPY = (0.07484, -0.3022, 0.05, -2.6551, 2.0468, -1.6058)

ROBOT = Robot(
    name="puma560",
    source="Inverse kinematics of PUMA560 by an improved genetic algorithm (niches, catastrophe, migration), Table 1",
    lengths_m={"a2": 0.4318, "d2": 0.1491, "a3": 0.0203, "d4": 0.4318},
    make_chain=_chain,
    make_closed_form=_closed_form,
)
