"""The AX-12A arm of the straight-line experiment.

Source: R. S. Edy Raharjo, O. Wahyunggoro, Priyatmadi, "Optimization of Straight Movement 6 DOF Robot Arm with
Genetic Algorithm", Table I (standard DH): a base yaw and four parallel pitch joints. A sixth servo rolls the
tool about its own axis and does not move the tool point.

The paper prints no lengths. Chosen here: d1 0.10, a2 0.105, a3 0.105, a4 0.07, a5 + a6 0.10 m, a reach of 0.38 m
from the shoulder. No joint ranges either: those of an AX-12A about its middle.
"""

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot


def _chain(lengths: dict[str, float]) -> SerialChain:
    rows = (
        DHRow(a=0.0, alpha=math.pi / 2.0, d=lengths["d1"]),
        DHRow(a=lengths["a2"]),
        DHRow(a=lengths["a3"]),
        DHRow(a=lengths["a4"]),
        DHRow(a=lengths["a56"]),
    )
    return SerialChain(rows, "standard")


def _closed_form(lengths: dict[str, float]) -> PlanarArm:
    return PlanarArm(tuple(lengths[name] for name in ("a2", "a3", "a4", "a56")), height=lengths["d1"])


LENGTHS_M = {"d1": 0.10, "a2": 0.105, "a3": 0.105, "a4": 0.07, "a56": 0.10}

ROBOT = Robot(
    name="ax12-line",
    source="Raharjo, Wahyunggoro, Priyatmadi: Optimization of Straight Movement 6 DOF Robot Arm with Genetic Algorithm",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    ranges_deg=((-150.0, 150.0),) * 5,
)
