"""The four-joint manipulator of Lanzhou: a waist, three parallel joints beside its axis, a tool in their plane.

Source: G. Bao, S. Liu, H. Zhao, "Kinematics Simulation of 4-DOF Manipulator", Table 1 (modified DH). Row 5 of the
table, whose angle is always zero, is the tool. Lengths are named as in eq. (2); d1, zero in the table, is the height
of the shoulder. With alpha_1 = -90 deg a positive pitch turns the arm down, so within its ranges this arm works mostly
below its shoulder.
"""

import math

import numpy as np

from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, tool_position
from armctl.kinematics.errata import Residuals, off
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
# In range, with a tool that points backwards (cos theta_234 < 0).
SOME_Q = np.radians([20.0, 60.0, 70.0, 40.0])
_T = forward_kinematics(_chain(LENGTHS_M), SOME_Q)
_FIG_5_M = tool_position(_chain(LENGTHS_M), np.radians(FIG_5_DEG)).tolist()
_THETA_1, _THETA_234 = float(SOME_Q[0]), float(SOME_Q[1:].sum())


def _eq_1_order() -> tuple[float, float]:
    """Trans_z(d) Rot_z(theta) Trans_x(a) Rot_x(alpha), as printed, beside the printed matrix."""
    row = DHRow(a=0.009, alpha=-math.pi / 2.0, d=0.042)
    q = np.array([0.5])
    ct, st, ca, sa = math.cos(0.5), math.sin(0.5), 0.0, -1.0
    second, third = [st * ca, ct * ca, -sa, -sa * row.d], [st * sa, ct * sa, ca, ca * row.d]
    matrix = np.array([[ct, -st, 0.0, row.a], second, third, [0.0, 0.0, 0.0, 1.0]])
    printed = forward_kinematics(SerialChain((row,), "standard"), q)
    true = forward_kinematics(SerialChain((row,), "modified"), q)
    return float(np.abs(printed - matrix).max()), float(np.abs(true - matrix).max())


def _subscripts() -> tuple[float, float]:
    """a_2 = 77 mm as the table's a_{i-1} of row 3 says, put into eq. (2), against a_2 = 9 mm."""
    c = [math.cos(float(angle)) for angle in np.cumsum(SOME_Q[1:])]
    c1, s1 = math.cos(SOME_Q[0]), math.sin(SOME_Q[0])
    x = float(tool_position(_chain(LENGTHS_M), SOME_Q)[0])

    def eq_2(a: tuple[float, float, float, float]) -> float:
        return (a[0] + a[1] * c[0] + a[2] * c[1] + a[3] * c[2]) * c1 - 0.042 * s1

    return off(x, eq_2((0.077, 0.097, 0.133, 0.0)), eq_2((0.009, 0.077, 0.097, 0.133)))


def _turn(angle: float) -> float:
    """Size of an angle, whole turns left out."""
    return abs((angle + math.pi) % (2.0 * math.pi) - math.pi)


def _solutions() -> tuple[float, float]:
    """Joint positions of one pose, counted: theta1 and theta234 are fixed by the rotation, the elbow has two."""
    T, chain = _T, _chain(LENGTHS_M)
    q1, total = _THETA_1, _THETA_234
    c1, s1 = math.cos(q1), math.sin(q1)
    u = c1 * T[0, 3] + s1 * T[1, 3] - 0.009 - 0.133 * math.cos(total)
    v = -T[2, 3] - 0.133 * math.sin(total)
    cosine = (u * u + v * v - 0.077**2 - 0.097**2) / (2.0 * 0.077 * 0.097)  # (eq. 5)
    found = 0
    for waist in (q1, q1 + math.pi):
        for q3 in (math.acos(cosine), -math.acos(cosine)):
            for pitch in (total, math.pi - total):
                q2 = math.atan2(v, u) - math.atan2(0.097 * math.sin(q3), 0.077 + 0.097 * math.cos(q3))
                q = np.array([waist, q2, q3, pitch - q2 - q3])
                found += bool(np.abs(forward_kinematics(chain, q) - T).max() < 1e-9)
    return off(found, 4.0, 2.0)


def _standard_link() -> tuple[float, float]:
    """The table given to a standard link() puts Fig. 5's x elsewhere than the printed and computed 219 mm."""
    q, rows = np.radians(FIG_5_DEG), _chain(LENGTHS_M).rows
    standard = SerialChain((*rows, DHRow(a=0.133)), "standard")
    x = float(tool_position(standard, np.append(q, 0.0))[0])
    return off(0.219, x, _FIG_5_M[0])


def _out_of_range(q_deg: tuple[float, ...]) -> float:
    """The largest amount by which a joint lies outside Table 1 [deg]."""
    return max(max(low - q, q - high, 0.0) for q, (low, high) in zip(q_deg, RANGES_DEG, strict=True))


def _eq_11() -> tuple[float, float]:
    """Angles of eq. (11) and of eq. (12) for random numbers 0 and 1, against the ranges of Table 1 [deg]."""
    spans = tuple(high - low for low, high in RANGES_DEG)
    highs = tuple(low + (high - low) for low, high in RANGES_DEG)
    return _out_of_range(spans), _out_of_range(highs)


# What is proven: `armctl/papers/printed/003.yaml`.
PROOFS: dict[str, Residuals] = {
    "eq_1": _eq_1_order,
    "subscripts": _subscripts,
    "theta1": lambda: (
        _turn(math.atan2(_T[1, 0], _T[0, 0]) - _THETA_1),
        _turn(math.atan2(-_T[0, 2], _T[1, 2]) - _THETA_1),
    ),
    "theta234": lambda: (
        _turn(math.atan2(_T[2, 0], _T[2, 1]) - _THETA_234),
        _turn(math.atan2(-_T[2, 0], -_T[2, 1]) - _THETA_234),
    ),
    "solutions": _solutions,
    "link": _standard_link,
    "fig_5_z": lambda: off(_FIG_5_M[2], 0.139, 0.097),
    "fig_5_range": lambda: (_out_of_range(FIG_5_DEG), _out_of_range((0.0, 7.0, -90.0, 82.0))),
    "qz_range": lambda: (_out_of_range(QZ_DEG), _out_of_range((*QZ_DEG[:3], 82.0))),
    "eq_11": _eq_11,
}

ROBOT = Robot(
    name="lanzhou-4dof",
    source="Bao, Liu, Zhao: Kinematics Simulation of 4-DOF Manipulator, Table 1",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    ranges_deg=RANGES_DEG,
    proofs=PROOFS,
)
