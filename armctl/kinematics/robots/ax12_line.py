"""The AX-12A arm of the straight-line experiment.

Source: R. S. Edy Raharjo, O. Wahyunggoro, Priyatmadi, "Optimization of Straight Movement 6 DOF Robot Arm with
Genetic Algorithm", Table I (standard DH): a base yaw and four parallel pitch joints. A sixth servo rolls the
tool about its own axis and does not move the tool point.

The paper prints no lengths. Chosen here: d1 0.10, a2 0.105, a3 0.105, a4 0.07, a5 + a6 0.10 m, a reach of 0.38 m
from the shoulder. No joint ranges either: those of an AX-12A about its middle.
"""

import math

import numpy as np

from armctl.kinematics.chain import DHRow, SerialChain, tool_position
from armctl.kinematics.errata import Residuals, off
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


def _position_equations() -> tuple[tuple[float, float], tuple[float, float]]:
    """How far eqs. (10) and (14) are off, each as (printed, corrected) [m]."""
    x, y, _ = tool_position(_chain(LENGTHS_M), np.array([0.5, 0.7, -0.4, 0.3, 0.2])).tolist()
    a2, a3, a4, a56 = (LENGTHS_M[name] for name in ("a2", "a3", "a4", "a56"))
    C1, S1, C2, C23, S23 = math.cos(0.5), math.sin(0.5), math.cos(0.7), math.cos(0.3), math.sin(0.3)
    along, across = a4 * math.cos(0.3) + a56 * math.cos(0.5), a4 * math.sin(0.3) + a56 * math.sin(0.5)
    p_x = C1 * (a2 * C2 + a3 * C23) + C1 * C23 * along  # (eq. 10)
    p_y = S1 * (a2 * C2 - a3 * C23) + S1 * C23 * along - S1 * S23 * across  # (eq. 14)
    return off(x, p_x, p_x - C1 * S23 * across), off(y, p_y, p_y + 2.0 * S1 * a3 * C23)


# What is proven: `armctl/papers/printed/002.yaml`.
PROOFS: dict[str, Residuals] = {"P_x": lambda: _position_equations()[0], "P_y": lambda: _position_equations()[1]}

ROBOT = Robot(
    name="ax12-line",
    source="Raharjo, Wahyunggoro, Priyatmadi: Optimization of Straight Movement 6 DOF Robot Arm with Genetic Algorithm",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    ranges_deg=((-150.0, 150.0),) * 5,
    proofs=PROOFS,
)
