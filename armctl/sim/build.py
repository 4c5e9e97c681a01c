"""Draws one arm of a batch: its geometry, masses, motors, friction, play and zero offsets, all by one seed."""

import math
from dataclasses import replace
from typing import Any

import numpy as np

from armctl.config import ArmConfig, JointConfig, Servo
from armctl.dynamixel import ax12a
from armctl.dynamixel.servos import DEFAULT, MODELS, ServoModel
from armctl.json_text import named
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain
from armctl.sim.geometry import PERFECT, Draws
from armctl.sim.gravity import PointMasses
from armctl.sim.joint import STEP_S, Joint
from armctl.sim.pair import paired
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import ArmSpec
from armctl.sim.twin import TwinJoint


def build(arm: ArmConfig, spec: ArmSpec, seed: int) -> tuple[SerialChain, list[Joint], PointMasses]:
    """The true chain, the joints in the rest pose with servos just powered up, and the masses.

    The order of the draws is part of the result: another order makes every seed another arm.

    Raises:
        ConfigError: no such robot or link length.
    """
    rng = np.random.default_rng(seed)
    robot = robots.get(arm.robot, arm.lengths_m)
    lengths_m = {
        name: length + spec.length_error_m * float(rng.standard_normal()) for name, length in robot.lengths_m.items()
    }
    chain = robot.with_lengths(lengths_m).chain
    tool_kg = float(rng.uniform(*spec.tool_kg))
    joints = [
        _joint(config, _of_model(spec, MODELS[config.model]), rng, own_rng)
        for config, own_rng in zip(arm.joints, rng.spawn(len(arm.joints)), strict=True)
    ]
    draws = Draws(spec.geometry, seed)
    if spec.geometry != PERFECT:
        chain = draws.chain(robot.with_lengths(draws.lengths_m(lengths_m)).chain)
        for joint in joints:
            joint.zero_rad += draws.zero_rad()  # the horn is turned on its shaft, which stays where it is
            joint.deviation = draws.deviation(spec.shaft_friction_Nm)
    for joint in joints:
        joint.stall_Nm = joint.spec.stall_torque_Nm * (1.0 + spec.stall_spread * float(rng.uniform(-1.0, 1.0)))
        _make_its_own(joint, draws)
    twins = () if spec.twin is None else spec.twin.joints.values()
    for joint, twin, config in zip(joints, twins, arm.joints, strict=False):
        _become(joint, twin, config)
    servo_kg = spec.servo_kg + spec.bracket_kg
    servos_kg = [servo_kg * (1.0 + spec.mass_spread * float(rng.uniform(-1.0, 1.0))) for _ in joints]
    for servo in arm.servos[len(joints) :]:
        second, offset_tick = _second(servo, _of_model(spec, MODELS[servo.model]), seed)
        _make_its_own(second, draws)
        assert servo.linkage is not None
        joints[servo.of], second = paired(joints[servo.of], second, servo.linkage, offset_tick)
        joints.append(second)
        servos_kg[servo.of] += servo_kg
    # Servos beyond the chain sit midway between its last axis and the tool.
    points_kg = (*servos_kg[: chain.n], sum(servos_kg[chain.n :]), tool_kg)
    return chain, joints, PointMasses(chain, points_kg if spec.twin is None else spec.twin.points_kg)


def _become(joint: Joint, twin: TwinJoint, config: JointConfig) -> None:
    """Be as another arm's joint was found; what was not found stays as it was drawn."""
    servo, slope_tick = joint.servo, ax12a.compliance_slope(config.compliance.slope)
    drawn = {
        **named(joint, "coulomb_Nm", "stall_Nm", "load_friction"),
        "stiction_ratio": joint.stiction_Nm / joint.coulomb_Nm,
        "slope_tick": servo.slope_share * slope_tick,
        "play_deg": math.degrees(2.0 * joint.half_play_rad),
        "delay_ms": 1e3 * joint.dead_steps * STEP_S,
        "no_load_rad_s": joint.spec.no_load_speed_rad_s,
        "noise_tick": servo.noise_tick,
    }
    now = drawn | twin.model_dump(exclude_none=True)
    joint.coulomb_Nm, joint.stiction_Nm = now["coulomb_Nm"], now["coulomb_Nm"] * now["stiction_ratio"]
    joint.stall_Nm, joint.load_friction = now["stall_Nm"], now["load_friction"]
    joint.half_play_rad, joint.dead_steps = math.radians(now["play_deg"]) / 2.0, round(1e-3 * now["delay_ms"] / STEP_S)
    joint.spec = replace(joint.spec, no_load_speed_rad_s=now["no_load_rad_s"])
    joint.zero_rad -= joint.direction * math.radians(twin.zero_deg or 0.0)
    servo.noise_tick, servo.slope_share = now["noise_tick"], now["slope_tick"] / slope_tick


def _make_its_own(joint: Joint, draws: Draws) -> None:
    """What else makes a servo differ from the next one."""
    spec, servo = joint.spec, joint.servo
    joint.stiction_Nm *= draws.share("stiction", spec.stiction_spread)
    joint.load_friction = draws.within("load", *spec.load_friction)
    joint.dead_steps = round(draws.within("dead time", *spec.dead_time_s) / STEP_S)
    joint.spec = replace(spec, no_load_speed_rad_s=spec.no_load_speed_rad_s * draws.share("speed", spec.no_load_spread))
    servo.slope_share = draws.within("slope", *spec.slope_share)
    servo.noise_tick *= draws.share("noise", spec.noise_spread)


def _of_model(spec: ArmSpec, model: ServoModel) -> ArmSpec:
    """The same arm with the motor of another model."""
    usual = MODELS[DEFAULT]
    return replace(
        spec,
        stall_torque_Nm=spec.stall_torque_Nm * (model.stall_torque_Nm / usual.stall_torque_Nm),
        no_load_speed_rad_s=spec.no_load_speed_rad_s * (model.no_load_rpm / usual.no_load_rpm),
    )


def _second(servo: Servo, spec: ArmSpec, seed: int) -> tuple[Joint, float]:
    """The second servo of a joint, and by how many ticks it is off what the arm's file says of it."""
    joint, rng = servo.joint, np.random.default_rng((seed, 0x2ED, servo.servo_id))
    assert servo.linkage is not None
    turned: dict[str, Any] = {"servo_id": servo.servo_id, "direction": joint.direction * servo.linkage.sense}
    turned |= {"zero_tick": servo.linkage.second(joint.zero_tick), "pair": None}
    second = _joint(JointConfig.model_construct(**dict(joint) | turned), spec, rng, rng.spawn(1)[0])
    for register, limit_tick in zip((ax12a.CW_LIMIT, ax12a.CCW_LIMIT), servo.limits_tick, strict=True):
        second.servo.set(register, limit_tick)
    return second, (spec.zero_offset_tick if servo.measured else spec.pair_offset_tick) * float(rng.uniform(-1.0, 1.0))


def _joint(config: JointConfig, spec: ArmSpec, rng: np.random.Generator, servo_rng: np.random.Generator) -> Joint:
    if spec.zero_offset_within_tick is None:
        zero_offset_tick = spec.zero_offset_tick * float(rng.standard_normal())
    else:
        zero_offset_tick = spec.zero_offset_within_tick * float(rng.uniform(-1.0, 1.0))
    zero_rad = (config.zero_tick + zero_offset_tick) * ax12a.TICK_RAD
    rest_rad = zero_rad + config.direction * config.rest_rad
    # The calibration's id and angle limits; the rest of the EEPROM is the factory's.
    rest_tick = rest_rad / ax12a.TICK_RAD
    servo = SimulatedServo(
        config.servo_id, servo_rng, position_tick=rest_tick, noise_tick=spec.noise_tick, variants=spec.variants
    )
    servo.shaft_rad, servo.voltage_V, servo.temperature_degC = rest_rad, spec.supply_V, spec.idle_degC
    if config.model != DEFAULT:
        servo.set(ax12a.MODEL, MODELS[config.model].model_number)
    for register, limit_tick in zip((ax12a.CW_LIMIT, ax12a.CCW_LIMIT), config.limits_tick, strict=True):
        servo.set(register, limit_tick)
    coulomb_Nm = float(rng.uniform(*spec.friction_Nm))
    low_rad, high_rad = sorted(zero_rad + config.direction * limit for limit in config.limits_rad)
    beyond_rad = math.radians(spec.stop_deg)
    return Joint(
        servo=servo,
        spec=spec,
        direction=config.direction,
        zero_rad=zero_rad,
        rest_rad=config.rest_rad,
        coulomb_Nm=coulomb_Nm,
        stiction_Nm=coulomb_Nm * spec.stiction_ratio,
        half_play_rad=math.radians(float(rng.uniform(*spec.play_deg))) / 2.0,
        stops_rad=(low_rad - beyond_rad, high_rad + beyond_rad),
        stall_Nm=spec.stall_torque_Nm,
    )
