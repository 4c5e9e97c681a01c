"""The gripping arm of Xiangtan: a waist, three parallel pitch joints, a hand that turns about its own axis.

Source: Xiang Yao, Ao Jiang, Changqing Su, Haowu Zhao, Ming Cheng, "Kinematics simulation and realization of
manipulator gripping items based on genetic algorithm", Fig. 9 (standard DH, lengths taken as centimetres). The
sixth servo closes the gripper. Eqs. (2) to (17) belong to another arm (no d1, an a4, a fourth turn of 90 deg);
the errata below hold for the equations as such, with the lengths of Fig. 9. Joint ranges: eq. (18), a whole turn.
"""

import math

import numpy as np

from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics
from armctl.kinematics.errata import Residuals, off
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray

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

_A2, _A3, _A4 = 0.123, 0.138, 0.155
# The arm of eqs. (2) to (7).
_EQUATIONS = SerialChain(
    (DHRow(alpha=QUARTER), DHRow(a=_A2), DHRow(a=_A3), DHRow(a=_A4, alpha=-QUARTER), DHRow(alpha=QUARTER), DHRow()),
    "standard",
)
_Q = (0.4, 0.7, -0.5, 0.9, 1.1, -0.6)
_T = forward_kinematics(_EQUATIONS, np.array(_Q))
_C1, _C2, _C3, _C4, _C5, _C6 = (math.cos(t) for t in _Q)
_S1, _S2, _S3, _S4, _S5, _S6 = (math.sin(t) for t in _Q)
_C23, _S23 = math.cos(_Q[1] + _Q[2]), math.sin(_Q[1] + _Q[2])
_C34, _S34 = math.cos(_Q[2] + _Q[3]), math.sin(_Q[2] + _Q[3])
_C234, _S234 = math.cos(sum(_Q[1:4])), math.sin(sum(_Q[1:4]))
# The bracket of o_x and o_y in eq. (9), and row 1, column 2 of eq. (11): printed and corrected.
_O_PRINTED, _O_TRUE = -_C234 * _C5 * _C6 - _S234 * _C6, -_C234 * _C5 * _S6 - _S234 * _C6
_N, _O, _A, _P = (_T[:3, i].tolist() for i in range(4))


def _fig_9(q: tuple[float, ...]) -> FloatArray:
    return forward_kinematics(_chain(LENGTHS_M), np.array(q[:5]))


def _without_d1() -> tuple[float, float]:
    """Height of the arm of Fig. 9 by A1 to A5, A1 as printed and with d1."""
    z = float(_fig_9(_Q)[2, 3])
    no_base = forward_kinematics(_chain({**LENGTHS_M, "d1": 0.0}), np.array(_Q[:5]))
    return off(z, float(no_base[2, 3]), float(no_base[2, 3]) + 0.101)


def _reach_of_fig_9() -> tuple[float, float]:
    """Distance of the tool from the shoulder with every joint stretched [m]."""
    hand_up = _fig_9((0.0, 0.0, 0.0, -QUARTER, 0.0))[:3, 3]
    return off(float(np.linalg.norm(hand_up - [0.0, 0.0, 0.101])), 0.123 + 0.138, 0.123 + 0.138 + 0.155)


def _base_turned() -> FloatArray:
    """A1^-1 T of the equations' arm: the left side of eq. (11)."""
    first = forward_kinematics(SerialChain(_EQUATIONS.rows[:1], "standard"), np.array(_Q[:1]))
    return np.asarray(first[:3, :3].T @ _T[:3])


def _waist() -> tuple[float, float]:
    """theta1 of a tool behind the base [rad]."""
    T = forward_kinematics(_EQUATIONS, np.array([2.5, *_Q[1:]]))
    side = 1.0 if _C234 * _A4 + _C23 * _A3 + _C2 * _A2 > 0.0 else -1.0
    return off(2.5, math.atan(T[1, 3] / T[0, 3]), math.atan2(side * T[1, 3], side * T[0, 3]))


_FORWARD = _C234 * (_C1 * _A[0] + _S1 * _A[1])
_STRETCH = _C234 * (_C1 * _P[0] + _S1 * _P[1]) + _S234 * _P[2]
# What is proven: `armctl/papers/printed/000.yaml`.
PROOFS: dict[str, Residuals] = {
    "d1": _without_d1,
    "hand": _reach_of_fig_9,
    "o_x": lambda: off(_O[0], _C1 * _O_PRINTED + _S1 * _S5 * _S6, _C1 * _O_TRUE + _S1 * _S5 * _S6),
    "o_y": lambda: off(_O[1], _S1 * _O_PRINTED - _C1 * _S5 * _S6, _S1 * _O_TRUE - _C1 * _S5 * _S6),
    "n_z": lambda: off(_N[2], _S234 * _C5 * _C6, _S234 * _C5 * _C6 + _C234 * _S6),
    "o_z": lambda: off(_O[2], -_S234 * _C5 * _C6 + _C234 * _C6, -_S234 * _C5 * _S6 + _C234 * _C6),
    "a_x": lambda: off(_A[0], _C1 * _C234 * _S5 + _S1 * _S5, _C1 * _C234 * _S5 + _S1 * _C5),
    "a_y": lambda: off(_A[1], _S1 * _C234 * _S5 + _C1 * _C5, _S1 * _C234 * _S5 - _C1 * _C5),
    "left_row_3": lambda: off(float(_base_turned()[2, 0]), _N[0] * _S1 + _N[1] * _C1, _N[0] * _S1 - _N[1] * _C1),
    "right_row_1": lambda: off(float(_base_turned()[0, 1]), _O_PRINTED, _O_TRUE),
    "right_row_2": lambda: off(
        float(_base_turned()[1, 0]), _S1 * (_C234 * _C5 * _C6 - _S234 * _S6), _S234 * _C5 * _C6 + _C234 * _S6
    ),
    "waist": _waist,
    "addition": lambda: off(_C3, _S2 * _S23 + _C2 * _C34, _S2 * _S23 + _C2 * _C23),
    "sine": lambda: off(_S3, *(sign * math.sqrt(1.0 - math.cos(_Q[2]) * math.cos(_Q[2])) for sign in (1.0, -1.0))),
    "S5": lambda: off(_S5, _FORWARD + _S234 * _A[0], _FORWARD + _S234 * _A[2]),
    "stretch": lambda: off(0.0, _STRETCH - _C34 * _A2 + _C4 * _A3 - _A4, _STRETCH - _C34 * _A2 - _C4 * _A3 - _A4),
}

ROBOT = Robot(
    name="xiang-6dof",
    source="Xiang Yao et al.: Kinematics simulation and realization of manipulator gripping items based on genetic "
    "algorithm, Fig. 9",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    proofs=PROOFS,
)
