"""Forward kinematics and Jacobian beside two third-party libraries, roboticstoolbox and pinocchio.

Both build the robots from the Denavit-Hartenberg tables alone, as for the bench beside them.
"""

import warnings

import numpy as np
import pytest

from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, forward_kinematics, jacobian
from armctl.kinematics.differential import tool_acceleration
from proving.ik_bench import Pinocchio, toolbox

with warnings.catch_warnings():
    warnings.simplefilter("ignore")
    import pinocchio

SKEW = SerialChain(
    tuple(DHRow(a=0.1 * i, alpha=0.4 - 0.3 * i, d=0.05 + 0.02 * i, offset=0.2 * i) for i in range(5)), "modified", 0.07
)
CHAINS = {**{name: robots.get(name).chain for name in robots.names()}, "skew, with offsets": SKEW}


@pytest.mark.parametrize("name", CHAINS)
def test_forward_kinematics_and_jacobian_equal_roboticstoolbox_and_pinocchio(name: str) -> None:
    chain = CHAINS[name]
    q = np.random.default_rng(3).uniform(-np.pi, np.pi, (1000, chain.n))
    T, J = forward_kinematics(chain, q), jacobian(chain, q)
    ours, other = toolbox(chain), Pinocchio(chain)
    for q_i, T_i, J_i in zip(q, T, J, strict=True):
        np.testing.assert_allclose(ours.fkine(q_i).A, T_i, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(ours.jacob0(q_i), J_i, rtol=0.0, atol=1e-12)
        np.testing.assert_allclose(other.forward(q_i).homogeneous, T_i, rtol=0.0, atol=1e-12)
        found = pinocchio.computeFrameJacobian(other.model, other.data, q_i, other.tool, pinocchio.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(found, J_i, rtol=0.0, atol=1e-12)


@pytest.mark.parametrize("name", CHAINS)
def test_tool_acceleration_equals_pinocchio(name: str) -> None:
    chain = CHAINS[name]
    q, rate, rate2 = np.random.default_rng(4).uniform(-2.0, 2.0, (3, 100, chain.n))
    other = Pinocchio(chain)
    for i, expected in enumerate(tool_acceleration(chain, q, rate, rate2)):
        pinocchio.forwardKinematics(other.model, other.data, q[i], rate[i], rate2[i])
        pinocchio.updateFramePlacements(other.model, other.data)
        # Of the tool point, in the base frame: linear and angular.
        found = pinocchio.getFrameClassicalAcceleration(
            other.model, other.data, other.tool, pinocchio.LOCAL_WORLD_ALIGNED
        )
        np.testing.assert_allclose(found.vector, expected, rtol=0.0, atol=1e-11)
