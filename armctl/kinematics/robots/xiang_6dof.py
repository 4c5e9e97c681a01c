"""The gripping arm of Xiangtan: a waist, three parallel pitch joints, a hand that turns about its own axis.

Source: Xiang Yao, Ao Jiang, Changqing Su, Haowu Zhao, Ming Cheng, "Kinematics simulation and realization of
manipulator gripping items based on genetic algorithm", Fig. 9 (standard DH, lengths taken as centimetres). The
sixth servo closes the gripper. Eqs. (2) to (17) belong to another arm (no d1, an a4, a fourth turn of 90 deg);
the errata below hold for the equations as such, with the lengths of Fig. 9. Joint ranges: eq. (18), a whole turn.
"""

import math

import numpy as np

from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics
from armctl.kinematics.errata import errata, off
from armctl.kinematics.planar_arm import PlanarArm
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray

QUARTER = math.pi / 2.0


def _chain(lengths: dict[str, float]) -> SerialChain:
    return SerialChain(
        (
            DHRow(alpha=QUARTER, d=lengths["d1"]),
            DHRow(a=lengths["a2"]),
            DHRow(a=lengths["a3"]),
            DHRow(alpha=-QUARTER),
            DHRow(d=lengths["d5"]),
        ),
        "standard",
    )


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
ERRATA = errata(
    "000",
    (
        "eqs. (2), (9), (14)",
        "A1 and p_z without d1",
        "d1 = 10.1 (Fig. 9) in A1 and p_z",
        "height of the tool of Fig. 9 [m]",
        _without_d1,
    ),
    (
        "eqs. (5), (6) and Fig. 9",
        "Fig. 9: a4 = 0, so the hand of eqs. (9) to (17) has no length",
        "the hand's length is d5 = 15.5 of Fig. 9",
        "reach of the stretched arm of Fig. 9 with a4 = 0, and with d5 [m]",
        _reach_of_fig_9,
    ),
    (
        "eq. (9), o_x",
        "C1 (-C234 C5 C6 - S234 C6) + S1 S5 S6",
        "C1 (-C234 C5 S6 - S234 C6) + S1 S5 S6",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_O[0], _C1 * _O_PRINTED + _S1 * _S5 * _S6, _C1 * _O_TRUE + _S1 * _S5 * _S6),
    ),
    (
        "eq. (9), o_y",
        "S1 (-C234 C5 C6 - S234 C6) - C1 S5 S6",
        "S1 (-C234 C5 S6 - S234 C6) - C1 S5 S6",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_O[1], _S1 * _O_PRINTED - _C1 * _S5 * _S6, _S1 * _O_TRUE - _C1 * _S5 * _S6),
    ),
    (
        "eq. (9), n_z",
        "S234 C5 C6",
        "S234 C5 C6 + C234 S6",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_N[2], _S234 * _C5 * _C6, _S234 * _C5 * _C6 + _C234 * _S6),
    ),
    (
        "eq. (9), o_z",
        "-S234 C5 C6 + C234 C6",
        "-S234 C5 S6 + C234 C6",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_O[2], -_S234 * _C5 * _C6 + _C234 * _C6, -_S234 * _C5 * _S6 + _C234 * _C6),
    ),
    (
        "eq. (9), a_x",
        "C1 C234 S5 + S1 S5",
        "C1 C234 S5 + S1 C5",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_A[0], _C1 * _C234 * _S5 + _S1 * _S5, _C1 * _C234 * _S5 + _S1 * _C5),
    ),
    (
        "eq. (9), a_y",
        "S1 C234 S5 + C1 C5",
        "S1 C234 S5 - C1 C5",
        "A1 to A6 multiplied at one configuration",
        lambda: off(_A[1], _S1 * _C234 * _S5 + _C1 * _C5, _S1 * _C234 * _S5 - _C1 * _C5),
    ),
    (
        "eq. (11), left, row 3",
        "n_x S1 + n_y C1 (and so o, a, p)",
        "n_x S1 - n_y C1",
        "A1^-1 T at one configuration",
        lambda: off(float(_base_turned()[2, 0]), _N[0] * _S1 + _N[1] * _C1, _N[0] * _S1 - _N[1] * _C1),
    ),
    (
        "eq. (11), right, row 1, column 2",
        "-C234 C5 C6 - S234 C6",
        "-C234 C5 S6 - S234 C6",
        "A1^-1 T at one configuration",
        lambda: off(float(_base_turned()[0, 1]), _O_PRINTED, _O_TRUE),
    ),
    (
        "eq. (11), right, row 2",
        "S1 (C234 C5 C6 - S234 S6), S1 (...), S1 C234 S5",
        "S234 C5 C6 + C234 S6, -S234 C5 S6 + C234 C6, S234 S5",
        "A1^-1 T at one configuration, column 1",
        lambda: off(
            float(_base_turned()[1, 0]), _S1 * (_C234 * _C5 * _C6 - _S234 * _S6), _S234 * _C5 * _C6 + _C234 * _S6
        ),
    ),
    (
        "eq. (12)",
        "theta1 = arctan(p_y / p_x)",
        "theta1 = atan2(+-p_y, +-p_x): print is off by pi behind the base, and the second solution is missing",
        "theta1 of a pose with theta1 = 2.5 rad [rad]",
        _waist,
    ),
    (
        "eq. (15)",
        "S2 S23 + C2 C34 = cos(theta3)",
        "S2 S23 + C2 C23 = cos(theta3)",
        "both sides at one configuration",
        lambda: off(_C3, _S2 * _S23 + _C2 * _C34, _S2 * _S23 + _C2 * _C23),
    ),
    (
        "after eq. (16)",
        "S3 = sqrt(1 - C3^2)",
        "S3 = +-sqrt(1 - C3^2)",
        "S3 of a pose with theta3 = -0.5 rad",
        lambda: off(_S3, *(sign * math.sqrt(1.0 - math.cos(_Q[2]) * math.cos(_Q[2])) for sign in (1.0, -1.0))),
    ),
    (
        "eq. (17), left, row 1, column 3",
        "C234 (C1 a_x + S1 a_y) + S234 a_x",
        "C234 (C1 a_x + S1 a_y) + S234 a_z",
        "S5 of the right side at one configuration",
        lambda: off(_S5, _FORWARD + _S234 * _A[0], _FORWARD + _S234 * _A[2]),
    ),
    (
        "eq. (17), left, column 4",
        "-C34 a2 + C4 a3 - a4 (in row 2)",
        "-C34 a2 - C4 a3 - a4 (in row 1)",
        "row 1 of column 4, zero on the right side [m]",
        lambda: off(0.0, _STRETCH - _C34 * _A2 + _C4 * _A3 - _A4, _STRETCH - _C34 * _A2 - _C4 * _A3 - _A4),
    ),
)

ROBOT = Robot(
    name="xiang-6dof",
    source="Xiang Yao et al.: Kinematics simulation and realization of manipulator gripping items based on genetic "
    "algorithm, Fig. 9",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    errata=ERRATA,
)
