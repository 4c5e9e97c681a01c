"""The transfer robot: six joints, a spherical wrist and a tool 100 mm beyond it.

Source: Y. Lu, D. Liu, "Kinematics Analysis and Simulation on Transfer Robot with Six Degrees of Freedom", Table 1
(modified DH). No joint ranges are printed: a whole turn each.
"""

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.spherical_wrist import SphericalWrist

QUARTER = math.pi / 2.0


def _chain(lengths: dict[str, float]) -> SerialChain:
    rows = (
        DHRow(),
        DHRow(a=lengths["a1"], alpha=-QUARTER),
        DHRow(a=lengths["a2"]),
        DHRow(alpha=QUARTER, d=lengths["d4"]),
        DHRow(alpha=-QUARTER),
        DHRow(alpha=QUARTER, d=lengths["d6"]),
    )
    return SerialChain(rows, "modified")


def _closed_form(lengths: dict[str, float]) -> SphericalWrist:
    a1, a2, d4, d6 = (lengths[name] for name in ("a1", "a2", "d4", "d6"))
    return SphericalWrist(a1, a2, a3=0.0, shoulder=0.0, d4=d4, d6=d6, mirrored=True)


LENGTHS_M = {"a1": 0.100, "a2": 0.450, "d4": 0.160, "d6": 0.100}
INITIAL_DEG = (90.0, -90.0, 0.0, 0.0, 0.0, 0.0)

ROBOT = Robot(
    name="transfer-6dof",
    source="Lu, Liu: Kinematics Analysis and Simulation on Transfer Robot with Six Degrees of Freedom, Table 1",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
)
