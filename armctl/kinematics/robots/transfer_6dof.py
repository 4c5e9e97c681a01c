"""The transfer robot: six joints, a spherical wrist and a tool 100 mm beyond it.

Source: Y. Lu, D. Liu, "Kinematics Analysis and Simulation on Transfer Robot with Six Degrees of Freedom", Table 1
(modified DH). No joint ranges are printed: a whole turn each.
"""

import math
from collections.abc import Sequence

import numpy as np

from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, tool_position
from armctl.kinematics.errata import Residuals, off
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.spherical_wrist import SphericalWrist
from armctl.kinematics.transform import FloatArray

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
PRINTED_INITIAL = ((0.0, 0.0, 0.0, 0.660), (0.0, -1.0, 0.0, 0.0), (1.0, 0.0, 0.0, 0.640), (0.0, 0.0, 0.0, 1.0))
FIG_3_START_M = (-0.500, 0.610, 1.300)


_INITIAL = forward_kinematics(_chain(LENGTHS_M), np.radians(INITIAL_DEG))
_PRINTED = np.array(PRINTED_INITIAL)


def _sign_of_d() -> tuple[float, float]:
    q, alpha, a, d = 0.4, 0.7, 0.1, 0.2
    A = forward_kinematics(SerialChain((DHRow(a, alpha, d),), "modified"), np.array([q]))
    turned = np.array([0.0, -d * math.sin(alpha), d * math.cos(alpha)])  # Rx(alpha) (0, 0, d)
    return off(A[1, 3], d * math.sin(alpha), turned[1])


def _off_rotation(T: FloatArray) -> float:
    """How far R R^T is from 1."""
    R = T[:3, :3]
    return float(np.abs(R @ R.T - np.eye(3)).max())


def _from_initial(point: Sequence[float] | FloatArray) -> float:
    return float(np.linalg.norm(_INITIAL[:3, 3] - point))


def _beyond_reach(target: FloatArray) -> float:
    """How far the target is outside the sphere about the shoulder's nearest place that holds every tool position."""
    distance = math.hypot(math.hypot(target[0], target[1]) - LENGTHS_M["a1"], target[2])
    return distance - (LENGTHS_M["a2"] + LENGTHS_M["d4"] + LENGTHS_M["d6"])


def _branches_of_theta2() -> tuple[float, float]:
    """Distinct theta2 for one theta1 and theta3 that put the wrist on one place: print says two."""
    q = np.array([0.3, -1.0, 0.5, 0.2, 0.7, 0.1])
    chain = _chain({**LENGTHS_M, "d6": 0.0})
    wrist = tool_position(chain, q)
    turns = np.linspace(-math.pi, math.pi, 7201)[:-1] + (q[1] + math.pi) % math.radians(0.05)
    others = np.repeat(q[None], len(turns), axis=0)
    others[:, 1] = turns
    hits = np.linalg.norm(tool_position(chain, others) - wrist, axis=1) < 1e-6
    return off(float(hits.sum()), 2.0, 1.0)


# What is proven: `armctl/papers/printed/004.yaml`.
PROOFS: dict[str, Residuals] = {
    "sign_of_d": _sign_of_d,
    "initial_rotation": lambda: (_off_rotation(_PRINTED), _off_rotation(_INITIAL)),
    "initial_position": lambda: (_from_initial(_PRINTED[:3, 3]), _from_initial((0.0, -0.160, 0.450))),
    "initial_reach": lambda: (_beyond_reach(_PRINTED[:3, 3]), max(0.0, _beyond_reach(_INITIAL[:3, 3]))),
    "fig_3": lambda: (_beyond_reach(np.array(FIG_3_START_M)), max(0.0, _beyond_reach(_INITIAL[:3, 3]))),
    "theta2": _branches_of_theta2,
}

ROBOT = Robot(
    name="transfer-6dof",
    source="Lu, Liu: Kinematics Analysis and Simulation on Transfer Robot with Six Degrees of Freedom, Table 1",
    lengths_m=LENGTHS_M,
    make_chain=_chain,
    make_closed_form=_closed_form,
    proofs=PROOFS,
)
