"""A joint's integration, which skips what cannot change, against the plain equations step by step."""

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.files import load_arm
from armctl.sim.build import build
from armctl.sim.drive import Drive
from armctl.sim.hand import hand_torque
from armctl.sim.joint import STEP_S, Joint
from armctl.sim.potentiometer import sensed_tick
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec

SPEC = ArmSpec()
VOLTAGE_V = 11.7
COULOMB_NM, STICTION_NM, HALF_PLAY_RAD, STALL_NM = 0.1, 0.12, 0.003, 1.5


@dataclass
class Plain:
    """What a case begins with, and the plain equations on it, one step at a time."""

    low_rad: float
    high_rad: float
    motor_rad: float
    velocity_rad_s: float
    gravity_Nm: float
    inertia_kg_m2: float
    dead_motor: bool
    blocked_rad: float | None
    reference_tick: float
    frozen_tick: int | None
    drive: Drive
    shaft_rad: float = 2.6
    output: float = 0.0

    def joint(self) -> Joint:
        """The same as a joint of the simulator."""
        servo = SimulatedServo(1, np.random.default_rng(0), position_tick=self.shaft_rad / TICK_RAD)
        servo.shaft_rad, servo.velocity_rad_s, servo.voltage_V = self.shaft_rad, self.velocity_rad_s, VOLTAGE_V
        servo.reference_tick, servo.frozen_tick = self.reference_tick, self.frozen_tick
        stops_rad = self.low_rad, self.high_rad
        joint = Joint(servo, SPEC, 1.0, 2.6, 0.0, COULOMB_NM, STICTION_NM, HALF_PLAY_RAD, stops_rad, STALL_NM)
        joint.motor_rad, joint.gravity_Nm = self.motor_rad, self.gravity_Nm
        joint.step_over_inertia = STEP_S / self.inertia_kg_m2
        joint.dead_motor, joint.blocked_rad, joint.drive = self.dead_motor, self.blocked_rad, self.drive
        return joint

    def step(self, pull: tuple[float, float] | None, age: int) -> None:
        """One millisecond of the equations in sim/joint.py; the `age`-th since the hand's aim was taken."""
        drive, torque, self.output = self.drive, 0.0, 0.0
        if drive.spin is not None:
            self.reference_tick = drive.goal_tick
        if drive.enabled:
            way, ramp = drive.goal_tick - self.reference_tick, drive.ramp_tick_s * STEP_S
            jumps = ramp == 0.0 or abs(way) <= ramp
            self.reference_tick = drive.goal_tick if jumps else self.reference_tick + math.copysign(ramp, way)
            sensed = sensed_tick(self.shaft_rad / TICK_RAD) if self.frozen_tick is None else self.frozen_tick
            error = math.floor(self.reference_tick + 0.5) - sensed
            self.output = drive.output(error) if drive.spin is None else drive.spin
            if not self.dead_motor:
                torque = STALL_NM * (self.output * VOLTAGE_V / 12.0 - self.velocity_rad_s / SPEC.no_load_speed_rad_s)
        external = self.gravity_Nm
        if pull is not None:
            external += hand_torque(pull[0] + pull[1] * age * STEP_S - self.shaft_rad, pull[1] - self.velocity_rad_s)
        torque += external
        before = self.velocity_rad_s
        if before != 0.0 or abs(torque) > STICTION_NM:
            friction = math.copysign(COULOMB_NM, before if before != 0.0 else torque)
            after = before + (torque - friction) * STEP_S / self.inertia_kg_m2
            self.velocity_rad_s = 0.0 if after * before < 0.0 else after
        self.motor_rad += self.velocity_rad_s * STEP_S
        if abs(external) > SPEC.shaft_friction_Nm:
            self.shaft_rad += math.copysign(SPEC.play_speed_rad_s * STEP_S, external)
        self.shaft_rad = min(max(self.shaft_rad, self.motor_rad - HALF_PLAY_RAD), self.motor_rad + HALF_PLAY_RAD)
        low, high = (self.low_rad, self.high_rad) if self.blocked_rad is None else (self.blocked_rad,) * 2
        stop = min(max(self.shaft_rad, low), high)
        if self.shaft_rad != stop:
            bounds = (0.0, math.inf) if self.shaft_rad < stop else (-math.inf, 0.0)
            self.velocity_rad_s = min(max(self.velocity_rad_s, bounds[0]), bounds[1])
            self.motor_rad, self.shaft_rad = self.motor_rad + stop - self.shaft_rad, stop


drives = st.builds(
    Drive,
    enabled=st.sampled_from([True, True, True, False]),
    goal_tick=st.integers(480, 540),
    ramp_tick_s=st.sampled_from([0.0, 36.3, 68.13, 227.1, 2000.0]),
    output_limit=st.sampled_from([1.0, 0.2]),
    punch=st.just(32 / 1023),
    cw_margin=st.integers(0, 3),
    ccw_margin=st.integers(0, 3),
    cw_gain=st.just(0.03),
    ccw_gain=st.just(0.06),
    spin=st.sampled_from([None, None, None, 0.3, -0.3]),
)
cases = st.builds(
    Plain,
    low_rad=st.sampled_from([-9.0, 1.0, 2.58]),
    high_rad=st.sampled_from([9.0, 4.0, 2.62]),
    motor_rad=st.floats(2.598, 2.602),
    velocity_rad_s=st.sampled_from([0.0, 0.0, 1.0, -0.05]),
    gravity_Nm=st.floats(-0.6, 0.6),
    inertia_kg_m2=st.floats(0.002, 0.03),
    dead_motor=st.sampled_from([False, False, False, True]),
    blocked_rad=st.sampled_from([None, None, None, 2.6]),
    reference_tick=st.floats(490.0, 530.0),
    frozen_tick=st.sampled_from([None, None, None, 500]),
    drive=drives,
)
pulls = st.none() | st.tuples(st.floats(2.5, 2.7), st.floats(-0.5, 0.5), st.integers(0, 19))


@settings(max_examples=400)
@given(case=cases, pull=pulls, counts=st.lists(st.integers(1, 20), min_size=1, max_size=10))
def test_skipping_what_cannot_change_gives_what_every_step_gives(
    case: Plain, pull: tuple[float, float, int] | None, counts: list[int]
) -> None:
    plain, joint = case, case.joint()
    servo = joint.servo
    for count in counts:
        before = servo.shaft_rad, servo.velocity_rad_s, servo.reference_tick
        age = 0
        if pull is not None:
            joint.aim_rad, joint.aim_rad_s, age = pull
        changes = joint.advance(joint.step + count, None if pull is None else joint.step - age)
        for k in range(age, age + count):
            plain.step(None if pull is None else pull[:2], k)
        assert (servo.shaft_rad, joint.motor_rad) == pytest.approx((plain.shaft_rad, plain.motor_rad), abs=1e-9)
        assert servo.velocity_rad_s == pytest.approx(plain.velocity_rad_s, abs=1e-7)
        assert servo.reference_tick == pytest.approx(plain.reference_tick, abs=1e-9)
        assert servo.output == plain.output
        assert servo.position_tick == servo.shaft_rad / TICK_RAD
        unchanged = (servo.shaft_rad, servo.velocity_rad_s, servo.reference_tick) == before
        assert changes or unchanged or plain.drive.spin is not None


def test_a_joint_has_the_motor_of_its_servos_model() -> None:
    """An AX-18A is stronger and faster than the AX-12A beside it; the arm draws nothing else anew for it."""
    plain = load_arm("ax12-line")
    joints = [joint.model_copy(update={"model": "ax-18a"} if joint.name == "elbow" else {}) for joint in plain.joints]
    mixed = build(plain.model_copy(update={"joints": tuple(joints)}), DEFAULT_SPEC, 4)[1]
    same = build(plain, DEFAULT_SPEC, 4)[1]
    for index, (one, other) in enumerate(zip(mixed, same, strict=True)):
        stronger = 1.8 / 1.5 if index == 2 else 1.0
        assert one.stall_Nm == pytest.approx(stronger * other.stall_Nm)
        faster = one.spec.no_load_speed_rad_s / other.spec.no_load_speed_rad_s
        assert faster == pytest.approx(97.0 / 59.0 if index == 2 else 1.0)
        assert (one.coulomb_Nm, one.zero_rad) == (other.coulomb_Nm, other.zero_rad)
        assert one.servo.get(ax12a.MODEL) == (18 if index == 2 else 12)
