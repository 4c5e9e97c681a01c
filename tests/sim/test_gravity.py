"""Gravity and inertia of the simulated arm against MuJoCo, which knows nothing of this package."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.gravity import gravity_loads
from armctl.sim.spec import ArmSpec
from proving.mujoco_arm import mjcf
from tests.sim.conftest import sync_write


@dataclass
class Peer:
    """The arm in MuJoCo."""

    model: Any
    data: Any

    @classmethod
    def of(cls, arm: SimulatedArm) -> Peer:
        model = mujoco.MjModel.from_xml_string(mjcf(arm.chain.rows, arm.points_kg))
        return cls(model, mujoco.MjData(model))

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
    return Peer.of(simulated)


@settings(deadline=None, max_examples=100)
@given(st.lists(st.floats(-2.6, 2.6), min_size=5, max_size=5))
def test_gravity_and_inertia_are_mujocos(simulated: SimulatedArm, peer: Peer, pose: list[float]) -> None:
    q = np.array(pose)
    assert peer.tool_position(q) == pytest.approx(tool_position(simulated.chain, q), abs=1e-9)
    hold = peer.torque(q, np.zeros(5))
    loads = gravity_loads(simulated._links, simulated.points_kg, pose)
    for i, (torque, inertia) in enumerate(loads):
        assert torque == pytest.approx(-hold[i], abs=1e-7)
        assert inertia == pytest.approx((peer.torque(q, np.eye(5)[i]) - hold)[i], abs=1e-8)


def test_motors_at_rest_hold_what_mujoco_says_within_friction(arm: ArmConfig) -> None:
    """Through registers and physics: the load each servo reports carries gravity, give or take its stiction."""
    held = SimulatedArm(arm, seed=2)
    bus = SimulatedBus(held)
    held.advance(NS_PER_S)
    bus.receive(sync_write(arm, np.radians([20.0, 75.0, -60.0, -45.0, -45.0, 0.0]).tolist(), [100] * 6), NS_PER_S)
    held.advance(8 * NS_PER_S)
    hold = Peer.of(held).torque(held.true_positions()[:5], np.zeros(5))
    spec = held.spec
    for i, servo in enumerate(held.servos[:5]):
        assert servo.velocity_rad_s == 0.0
        motor = servo.output * spec.stall_torque_Nm * servo.voltage_V / 12.0
        assert abs(motor - arm.joints[i].direction * hold[i]) <= spec.stiction_ratio * spec.friction_Nm[1] + 1e-6
    assert abs(hold[1]) > 0.3
