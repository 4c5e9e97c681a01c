"""A joint's integration, which skips what cannot change, against the plain equations step by step."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.sim import steps
from armctl.sim.drive import Drive
from armctl.sim.joint import Joint
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import ArmSpec
from armctl.sim.steps import STEP_S, hand_torque, output_at, sensed_tick

SPEC = ArmSpec()
VOLTAGE_V = 11.7


@dataclass
class PlainJoint:
    """A joint for the plain equations."""

    direction: int
    coulomb: float
    stiction: float
    half_play: float
    low: float
    high: float
    shaft: float
    motor: float
    stall: float
    omega: float
    load: float
    inertia: float
    dead_motor: bool
    held: float | None

    def as_integrated(self, servo: SimulatedServo, drive: Drive) -> Joint:
        """The same joint in the state of an arm that has no other."""
        servo.state.set_spec(SPEC)
        joint = Joint(
            servo,
            direction=self.direction,
            zero_rad=2.6,
            rest_rad=0.0,
            coulomb=self.coulomb,
            stiction=self.stiction,
            half_play=self.half_play,
            low=self.low,
            high=self.high,
            stall=self.stall,
            brake=self.stall / SPEC.no_load_speed_rad_s,
            shaft=self.shaft,
        )
        joint.state.numbers[steps.VOLTAGE_V] = VOLTAGE_V
        joint.motor, joint.omega = self.motor, self.omega
        joint.load, joint.rate = self.load, STEP_S / self.inertia
        joint.dead_motor = self.dead_motor
        joint.hold(self.held)
        joint.drive_by(drive)
        return joint


joints = st.builds(
    PlainJoint,
    direction=st.sampled_from([1, -1]),
    coulomb=st.just(0.1),
    stiction=st.just(0.12),
    half_play=st.just(0.003),
    low=st.sampled_from([-9.0, 1.0, 2.58]),
    high=st.sampled_from([9.0, 4.0, 2.62]),
    shaft=st.just(2.6),
    motor=st.floats(2.598, 2.602),
    stall=st.just(1.5),
    omega=st.sampled_from([0.0, 0.0, 1.0, -0.05]),
    load=st.floats(-0.6, 0.6),
    inertia=st.floats(0.002, 0.03),
    dead_motor=st.sampled_from([False, False, False, True]),
    held=st.sampled_from([None, None, None, 2.6]),
)
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
pulls = st.none() | st.tuples(st.floats(2.5, 2.7), st.floats(-0.5, 0.5), st.integers(0, 19))


def servo_at(joint: PlainJoint, reference_tick: float, frozen_tick: int | None) -> SimulatedServo:
    servo = SimulatedServo(1, np.random.default_rng(0), position_tick=joint.shaft / TICK_RAD)
    servo.reference_tick, servo.frozen_tick = reference_tick, frozen_tick
    return servo


def output_of(drive: Drive, error_tick: int) -> float:
    return output_at(
        error_tick,
        drive.output_limit,
        drive.punch,
        drive.cw_margin,
        drive.ccw_margin,
        drive.cw_gain,
        drive.ccw_gain,
    )


def plain_step(
    joint: PlainJoint, servo: SimulatedServo, drive: Drive, pull: tuple[float, float, int] | None, step: int
) -> None:
    """One millisecond of the equations in sim/joint.py; the `step`-th since the hand's aim was taken."""
    low, high = (joint.low, joint.high) if joint.held is None else (joint.held, joint.held)
    torque = output = 0.0
    if drive.spin is not None:
        servo.reference_tick = drive.goal_tick
    if drive.enabled:
        way, ramp = drive.goal_tick - servo.reference_tick, drive.ramp_tick_s * STEP_S
        jumps = ramp == 0.0 or abs(way) <= ramp
        servo.reference_tick = drive.goal_tick if jumps else servo.reference_tick + math.copysign(ramp, way)
        sensed = sensed_tick(joint.shaft / TICK_RAD) if servo.frozen_tick is None else servo.frozen_tick
        output = output_of(drive, math.floor(servo.reference_tick + 0.5) - sensed) if drive.spin is None else drive.spin
        if not joint.dead_motor:
            torque = joint.stall * (output * VOLTAGE_V / 12.0 - joint.omega / SPEC.no_load_speed_rad_s)
    external = joint.load
    if pull is not None:
        external += hand_torque(pull[0] + pull[1] * step * STEP_S - joint.shaft, pull[1] - joint.omega)
    torque += external
    moving = joint.omega if joint.omega != 0.0 else torque
    if joint.omega != 0.0 or abs(torque) > joint.stiction:
        faster = joint.omega + (torque - math.copysign(joint.coulomb, moving)) * STEP_S / joint.inertia
        joint.omega = 0.0 if faster * joint.omega < 0.0 else faster
    joint.motor += joint.omega * STEP_S
    if abs(external) > SPEC.shaft_friction_Nm:
        joint.shaft += math.copysign(SPEC.play_speed_rad_s * STEP_S, external)
    joint.shaft = min(max(joint.shaft, joint.motor - joint.half_play), joint.motor + joint.half_play)
    if joint.shaft < low:
        joint.motor, joint.shaft, joint.omega = joint.motor + low - joint.shaft, low, max(joint.omega, 0.0)
    elif joint.shaft > high:
        joint.motor, joint.shaft, joint.omega = joint.motor + high - joint.shaft, high, min(joint.omega, 0.0)
    servo.output = output


def turn(joint: Joint, count: int, pull: tuple[float, float, int] | None) -> bool:
    """Integrate `count` steps; whether anything about the joint changed.

    Args:
        pull: Where the hand wants the shaft [rad] and how fast [rad/s], so many steps ago; None: no hand.
    """
    numbers, counts = joint.state.numbers, joint.state.counts
    counts[steps.PULLS], counts[steps.STIRRED], joint.ahead = pull is not None, 0, 0
    if pull is not None:
        numbers[joint.at + steps.AIM], numbers[joint.at + steps.AIM_SPEED], counts[steps.STEP] = pull
    joint.state.turn(0, count)
    return bool(counts[steps.STIRRED])


@settings(deadline=None, max_examples=400)
@given(
    plain=joints,
    drive=drives,
    pull=pulls,
    reference_tick=st.floats(490.0, 530.0),
    frozen_tick=st.sampled_from([None, None, None, 500]),
    counts=st.lists(st.integers(1, 20), min_size=1, max_size=10),
)
def test_skipping_what_cannot_change_gives_what_every_step_gives(
    plain: PlainJoint,
    drive: Drive,
    pull: tuple[float, float, int] | None,
    reference_tick: float,
    frozen_tick: int | None,
    counts: list[int],
) -> None:
    servo, plain_servo = (servo_at(plain, reference_tick, frozen_tick) for _ in range(2))
    joint = plain.as_integrated(servo, drive)
    for count in counts:
        before = (joint.shaft, joint.omega, servo.reference_tick)
        moved = turn(joint, count, pull)
        first = 0 if pull is None else pull[2]
        for step in range(first, first + count):
            plain_step(plain, plain_servo, drive, pull, step)
        assert (joint.shaft, joint.motor) == pytest.approx((plain.shaft, plain.motor), abs=1e-9)
        assert joint.omega == pytest.approx(plain.omega, abs=1e-7)
        assert servo.reference_tick == pytest.approx(plain_servo.reference_tick, abs=1e-9)
        assert servo.output == plain_servo.output
        assert servo.position_tick == joint.shaft / TICK_RAD
        assert moved or (joint.shaft, joint.omega, servo.reference_tick) == before or drive.spin is not None


def test_drive_is_read_off_the_table() -> None:
    servo = SimulatedServo(1, np.random.default_rng(0))
    for register, value in (
        (ax12a.TORQUE_ENABLE, 1),
        (ax12a.GOAL, 700),
        (ax12a.MOVING_SPEED, 100),
        (ax12a.TORQUE_LIMIT, 900),
        (ax12a.MAX_TORQUE, 800),
        (ax12a.PUNCH, 50),
        (ax12a.CW_MARGIN, 2),
        (ax12a.CCW_MARGIN, 3),
        (ax12a.CW_SLOPE, 16),
        (ax12a.CCW_SLOPE, 64),
    ):
        servo.set(register, value)
    drive = servo.drive
    assert (drive.enabled, drive.goal_tick, drive.cw_margin, drive.ccw_margin, drive.spin) == (True, 700, 2, 3, None)
    assert drive.ramp_tick_s == pytest.approx(100 * ax12a.SPEED_UNIT_RAD_S / TICK_RAD)
    assert (drive.output_limit, drive.punch) == pytest.approx((800 / 1023, 50 / 1023))
    assert output_of(drive, 3) == 0.0 == output_of(drive, -2)
    assert output_of(drive, -3) == pytest.approx(-50 / 1023 - (1.0 - 50 / 1023) / 16)
    assert output_of(drive, 4) == pytest.approx(50 / 1023 + (1.0 - 50 / 1023) / 64)
    assert output_of(drive, 500) == 800 / 1023
    servo.set(ax12a.CW_LIMIT, 0)
    servo.set(ax12a.CCW_LIMIT, 0)
    assert servo.drive.spin == pytest.approx(100 / 1023)
