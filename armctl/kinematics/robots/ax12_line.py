"""The AX-12A arm of the straight-line experiment.

Source: R. S. Edy Raharjo, O. Wahyunggoro, Priyatmadi, "Optimization of Straight Movement 6 DOF Robot Arm with
Genetic Algorithm", Table I (standard DH): a base yaw and four parallel pitch joints. A sixth servo rolls the
tool about its own axis and does not move the tool point.

The paper prints no lengths. Chosen here: d1 0.10, a2 0.105, a3 0.105, a4 0.07, a5 + a6 0.10 m, a reach of 0.38 m
from the shoulder.

Wrong in print, by multiplying out eqs. (1)-(5):
- eq. (10), P_x: the term -C1 S23 (a4 S4 + (a5 + a6) S45) is missing.
- eq. (14), P_y: a2 C2 - a3 C23 must be a2 C2 + a3 C23.
"""

from __future__ import annotations

import math

from armctl.kinematics.chain import DHRow, SerialChain
from armctl.kinematics.robots.robot import Robot


def _chain(lengths: dict[str, float]) -> SerialChain:
    return SerialChain(
        (
            DHRow(a=0.0, alpha=math.pi / 2.0, d=lengths["d1"]),
            DHRow(a=lengths["a2"]),
            DHRow(a=lengths["a3"]),
            DHRow(a=lengths["a4"]),
            DHRow(a=lengths["a56"]),
        ),
        "standard",
    )


ROBOT = Robot(
    name="ax12-line",
    source="Raharjo, Wahyunggoro, Priyatmadi: Optimization of Straight Movement 6 DOF Robot Arm with Genetic Algorithm",
    lengths_m={"d1": 0.10, "a2": 0.105, "a3": 0.105, "a4": 0.07, "a56": 0.10},
    make_chain=_chain,
)
