"""Forward kinematics and Jacobian beside two third-party libraries, roboticstoolbox and pinocchio.

Both build the robots from the Denavit-Hartenberg tables alone.
"""

import math
import warnings
from typing import Any

import numpy as np
import pytest

from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, jacobian
from armctl.kinematics.differential import tool_acceleration

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pinocchio
    import roboticstoolbox
    import spatialmath

SKEW = SerialChain(
    tuple(DHRow(a=0.1 * i, alpha=0.4 - 0.3 * i, d=0.05 + 0.02 * i, offset=0.2 * i) for i in range(5)), "modified", 0.07
)
CHAINS = {**{name: robots.get(name).chain for name in robots.names()}, "skew, with offsets": SKEW}


def toolbox(chain: SerialChain) -> Any:
    link = roboticstoolbox.RevoluteDH if chain.convention == "standard" else roboticstoolbox.RevoluteMDH
    rows = [link(d=row.d, a=row.a, alpha=row.alpha, offset=row.offset) for row in chain.rows]
    return roboticstoolbox.DHRobot(rows, tool=spatialmath.SE3(chain.tool_m, 0.0, 0.0))


class Pinocchio:
    """The chain as a pinocchio model: one revolute joint a row, one frame for the tool."""

    def __init__(self, chain: SerialChain) -> None:
        self._model = pinocchio.Model()
        place, parent = pinocchio.SE3.Identity(), 0
        for i, row in enumerate(chain.rows):
            twist = _shift(row.a, 0.0) * _turn_x(row.alpha)
            if chain.convention == "modified":
                place = place * twist
            parent = self._model.addJoint(
                parent, pinocchio.JointModelRZ(), place * _turn_z(row.offset), f"joint {i + 1}"
            )
            place = _shift(0.0, row.d)
            if chain.convention == "standard":
                place = place * twist
        tool = pinocchio.Frame("tool", parent, 0, place * _shift(chain.tool_m, 0.0), pinocchio.FrameType.OP_FRAME)
        self._tool = self._model.addFrame(tool)
        self._data = self._model.createData()

    def forward(self, q: Any) -> Any:
        pinocchio.framesForwardKinematics(self._model, self._data, q)
        return self._data.oMf[self._tool].homogeneous

    def jacobian(self, q: Any) -> Any:
        return pinocchio.computeFrameJacobian(self._model, self._data, q, self._tool, pinocchio.LOCAL_WORLD_ALIGNED)

    def acceleration(self, q: Any, rate: Any, rate2: Any) -> Any:
        """Of the tool point, in the base frame: linear and angular."""
        pinocchio.forwardKinematics(self._model, self._data, q, rate, rate2)
        pinocchio.updateFramePlacements(self._model, self._data)
        return pinocchio.getFrameClassicalAcceleration(
            self._model, self._data, self._tool, pinocchio.LOCAL_WORLD_ALIGNED
        ).vector


def _shift(x: float, z: float) -> Any:
    return pinocchio.SE3(np.eye(3), np.array([x, 0.0, z]))


def _turn_x(angle: float) -> Any:
    c, s = math.cos(angle), math.sin(angle)
    return pinocchio.SE3(np.array([[1.0, 0.0, 0.0], [0.0, c, -s], [0.0, s, c]]), np.zeros(3))


def _turn_z(angle: float) -> Any:
    c, s = math.cos(angle), math.sin(angle)
    return pinocchio.SE3(np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.zeros(3))


@pytest.mark.parametrize("name", CHAINS)
def test_forward_kinematics_and_jacobian_equal_roboticstoolbox_and_pinocchio(name: str) -> None:
    chain = CHAINS[name]
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (1000, chain.n))
    T, J = forward_kinematics(chain, q), jacobian(chain, q)
    ours, other = toolbox(chain), Pinocchio(chain)
    for q_i, T_i, J_i in zip(q, T, J, strict=True):
        np.testing.assert_allclose(ours.fkine(q_i).A, T_i, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(ours.jacob0(q_i), J_i, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(other.forward(q_i), T_i, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(other.jacobian(q_i), J_i, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", CHAINS)
def test_tool_acceleration_equals_pinocchio(name: str) -> None:
    chain = CHAINS[name]
    q, rate, rate2 = np.random.default_rng(4).uniform(-2.0, 2.0, (3, 100, chain.n))
    other = Pinocchio(chain)
    for i, found in enumerate(tool_acceleration(chain, q, rate, rate2)):
        np.testing.assert_allclose(found, other.acceleration(q[i], rate[i], rate2[i]), rtol=0.0, atol=1e-11)
