"""What tests of kinematics share: every robot in turn, and what it means to be at a pose."""

import numpy as np
import pytest
from hypothesis import strategies as st

from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, forward_kinematics
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray

seeds = st.integers(0, 2**32 - 1)
rngs = seeds.map(np.random.default_rng)
X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)


@pytest.fixture(params=robots.names(), scope="session")
def robot(request: pytest.FixtureRequest) -> Robot:
    return robots.get(request.param)


def screw(axis: tuple[float, float, float], angle: float, along_m: float = 0.0) -> FloatArray:
    """Turn about an axis through the origin, a unit vector (Rodrigues), and shift along it, shape (4, 4)."""
    x, y, z = axis
    K = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    T = np.eye(4)
    T[:3, :3] += np.sin(angle) * K + (1.0 - np.cos(angle)) * K @ K
    T[:3, 3] = along_m * np.array(axis)
    return T


def turned(a: FloatArray, b: FloatArray) -> FloatArray:
    """Largest difference of two configurations' angles, whole turns left out."""
    return np.asarray(np.abs((a - b + np.pi) % (2.0 * np.pi) - np.pi).max(axis=-1))


def assert_at(chain: SerialChain, q: FloatArray, T: FloatArray) -> None:
    """Every configuration, shape (k, n), has its tool at the pose T, shape (4, 4), to 1e-9."""
    np.testing.assert_allclose(forward_kinematics(chain, q), np.broadcast_to(T, (len(q), 4, 4)), atol=1e-9)


def some_q(chain: SerialChain, seed: int, *shape: int) -> FloatArray:
    return np.random.default_rng(seed).uniform(-np.pi, np.pi, (*shape, chain.n))
