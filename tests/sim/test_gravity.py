"""Gravity and inertia of the simulated arm against potential energy, and against MuJoCo, a stranger to this package."""

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import ArmConfig
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, link_frames, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.gravity import GRAVITY_M_S2, PointMasses
from armctl.sim.spec import ArmSpec
from proving.mujoco_arm import mjcf
from tests.sim.conftest import Bench

CHAIN = robots.get("ax12-line").chain


def mass_points(chain: SerialChain, q: FloatArray) -> FloatArray:
    """The points `PointMasses` puts masses on, from the one forward kinematics."""
    frames = link_frames(chain, q)[:, :3, 3]
    axes = frames[:-1] if chain.convention == "standard" else frames[1:]
    return np.vstack([axes, (axes[-1] + frames[-1]) / 2.0, frames[-1]])


@pytest.mark.parametrize("convention", ["standard", "modified"])
@settings(max_examples=30)
@given(st.lists(st.floats(-2.5, 2.5), min_size=5, max_size=5))
def test_gravity_is_the_slope_of_potential_energy(convention: str, q: list[float]) -> None:
    chain = SerialChain(CHAIN.rows, "standard" if convention == "standard" else "modified")
    kg = (0.07, 0.08, 0.09, 0.1, 0.11, 0.12, 0.13)
    step = 1e-5
    for i, (torque, inertia) in enumerate(PointMasses(chain, kg).loads(q)):
        ahead, behind = np.array(q), np.array(q)
        ahead[i] += step
        behind[i] -= step
        slope = (mass_points(chain, ahead) - mass_points(chain, behind)) / (2.0 * step)
        assert torque == pytest.approx(-GRAVITY_M_S2 * float(slope[:, 2] @ kg), abs=1e-6)
        assert inertia == pytest.approx(float((slope**2).sum(axis=1) @ kg), abs=1e-8)


class Peer:
    """The arm in MuJoCo."""

    def __init__(self, arm: SimulatedArm) -> None:
        self.model = mujoco.MjModel.from_xml_string(mjcf(arm.chain.rows, arm.points_kg))
        self.data = mujoco.MjData(self.model)

    def torque(self, q: FloatArray, acceleration: FloatArray) -> FloatArray:
        """Torque [N m] the joints need for an acceleration [rad/s^2] from rest: inverse dynamics."""
        self.data.qpos[:] = q
        self.data.qvel[:] = 0.0
        self.data.qacc[:] = acceleration
        mujoco.mj_inverse(self.model, self.data)
        return np.array(self.data.qfrc_inverse)

    def tool_position(self, q: FloatArray) -> FloatArray:
        """Where the last body, the tool point, is [m]."""
        self.torque(q, np.zeros(q.size))
        return np.array(self.data.xpos[-1])


@pytest.fixture(scope="module")
def simulated(arm: ArmConfig) -> SimulatedArm:
    return SimulatedArm(arm, seed=11, spec=ArmSpec(length_error_m=0.003))


@pytest.fixture(scope="module")
def peer(simulated: SimulatedArm) -> Peer:
    return Peer(simulated)


@settings(max_examples=100)
@given(st.lists(st.floats(-2.6, 2.6), min_size=5, max_size=5))
def test_gravity_and_inertia_are_mujocos(simulated: SimulatedArm, peer: Peer, pose: list[float]) -> None:
    q = np.array(pose)
    assert peer.tool_position(q) == pytest.approx(tool_position(simulated.chain, q), abs=1e-9)
    hold = peer.torque(q, np.zeros(5))
    for i, (torque, inertia) in enumerate(PointMasses(simulated.chain, simulated.points_kg).loads(pose)):
        assert torque == pytest.approx(-hold[i], abs=1e-7)
        assert inertia == pytest.approx((peer.torque(q, np.eye(5)[i]) - hold)[i], abs=1e-8)


def test_motors_at_rest_hold_what_mujoco_says_within_friction(arm: ArmConfig) -> None:
    """Through registers and physics: the load each servo reports carries gravity, give or take its stiction."""
    bench = Bench(arm, seed=2)
    bench.goto(np.radians([20.0, 75.0, -60.0, -45.0, -45.0, 0.0]), wait_s=7.0)
    held = bench.arm
    hold = Peer(held).torque(held.true_positions()[:5], np.zeros(5))
    spec = held.spec
    for i, servo in enumerate(held.servos[:5]):
        assert servo.velocity_rad_s == 0.0
        motor = servo.output * spec.stall_torque_Nm * servo.voltage_V / 12.0
        assert abs(motor - arm.joints[i].direction * hold[i]) <= spec.stiction_ratio * spec.friction_Nm[1] + 1e-6
    assert abs(hold[1]) > 0.3
