"""The whole range that an arm's servos may be in: drawn by streams of its own, and each effect as it is said to be."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit
from armctl.dynamixel.packet import BROADCAST_ID, BadChecksum, Instruction, Packet, encode_instruction
from armctl.sim.arm import SimulatedArm
from armctl.sim.build import build
from armctl.sim.joint import STEP_S, Joint
from armctl.sim.servo import ServoVariants
from armctl.sim.spec import AGES, DEFAULT_SPEC, RANDOM_SPEC, RANGE_SPEC, ArmSpec, put_together
from tests.sim.conftest import WORKING_RAD, Bench, read, turned, write

WORN = put_together(RANDOM_SPEC, "perfect", "worn")
QUIET = ArmSpec(noise_tick=0.0, zero_offset_tick=0.0)


def joints(arm: ArmConfig, spec: ArmSpec, seeds: range = range(100)) -> list[Joint]:
    return [joint for seed in seeds for joint in build(arm, spec, seed)[1]]


@pytest.mark.parametrize("spec", [DEFAULT_SPEC, RANDOM_SPEC])
def test_new_servos_in_a_perfect_arm_are_the_arm_as_it_was_given(spec: ArmSpec) -> None:
    assert put_together(spec, "perfect", "new") == spec


def test_default_arms_have_none_of_the_published_effects(arm: ArmConfig) -> None:
    for joint in joints(arm, RANDOM_SPEC, range(3)):
        assert (joint.load_friction, joint.dead_steps, joint.servo.slope_share) == (0.0, 0, 1.0)
        assert joint.stiction_Nm == joint.coulomb_Nm * RANDOM_SPEC.stiction_ratio
        assert joint.servo.noise_tick == RANDOM_SPEC.noise_tick
        assert joint.spec.no_load_speed_rad_s == RANDOM_SPEC.no_load_speed_rad_s


def test_a_seed_draws_the_same_arm_at_every_age_in_other_sizes(arm: ArmConfig) -> None:
    for seed in range(5):
        young, old = (SimulatedArm(arm, seed=seed, spec=spec) for spec in (RANDOM_SPEC, WORN))
        assert young.points_kg == old.points_kg
        for one, other in zip(young._joints, old._joints, strict=True):
            assert (one.stall_Nm, one.zero_rad) == (other.stall_Nm, other.zero_rad)
            shares = [
                (joint.coulomb_Nm - spec.friction_Nm[0]) / (spec.friction_Nm[1] - spec.friction_Nm[0])
                for joint, spec in ((one, RANDOM_SPEC), (other, WORN))
            ]
            assert shares[0] == pytest.approx(shares[1])


def test_a_kind_that_is_left_out_leaves_what_is_drawn_of_the_others(arm: ArmConfig) -> None:
    whole, less = (joints(arm, spec, range(3)) for spec in (RANGE_SPEC, replace(RANGE_SPEC, load_friction=(0.0, 0.0))))
    for one, other in zip(whole, less, strict=True):
        assert one.load_friction > 0.0 == other.load_friction
        assert (one.dead_steps, one.servo.slope_share, one.stiction_Nm, one.servo.noise_tick) == (
            other.dead_steps,
            other.servo.slope_share,
            other.stiction_Nm,
            other.servo.noise_tick,
        )


@pytest.mark.parametrize("spec", [RANGE_SPEC, WORN], ids=["new", "worn"])
def test_every_figure_comes_from_all_of_its_range_and_from_nowhere_else(arm: ArmConfig, spec: ArmSpec) -> None:
    drawn = joints(arm, spec)
    ratio, ratios = spec.stiction_ratio, [joint.stiction_Nm / joint.coulomb_Nm for joint in drawn]
    speeds = [joint.spec.no_load_speed_rad_s / spec.no_load_speed_rad_s for joint in drawn]
    noises = [joint.servo.noise_tick for joint in drawn]
    for found, low, high in (
        ([joint.load_friction for joint in drawn], *spec.load_friction),
        ([joint.dead_steps * STEP_S for joint in drawn], *spec.dead_time_s),
        ([joint.servo.slope_share for joint in drawn], *spec.slope_share),
        (ratios, ratio * (1.0 - spec.stiction_spread), ratio * (1.0 + spec.stiction_spread)),
        (speeds, 1.0 - spec.no_load_spread, 1.0 + spec.no_load_spread),
        (noises, spec.noise_tick * (1.0 - spec.noise_spread), spec.noise_tick * (1.0 + spec.noise_spread)),
    ):
        width = high - low
        assert low - STEP_S / 2.0 <= min(found) <= low + 0.05 * width + STEP_S
        assert high - 0.05 * width - STEP_S <= max(found) <= high + STEP_S / 2.0


def test_every_age_is_made_of_an_arms_own_figures() -> None:
    known = {one.name for one in fields(ArmSpec)}
    assert all(set(told) <= known for told in AGES.values())


# --------------------------------------------------------------------------------------------- each effect


def breakaway_Nm(bench: Bench, gravity_Nm: float) -> float:
    """The torque at which a joint under a load begins to turn, on top of what carries the load."""
    joint = bench.arm._joints[0]
    joint.gravity_Nm, joint.step = gravity_Nm, 0
    for output in np.arange(-gravity_Nm / joint.stall_Nm, 1.0, 0.001):
        joint.drive = joint.drive._replace(enabled=True, spin=float(output), output_limit=1.0)
        joint.servo.velocity_rad_s = 0.0
        before = joint.servo.shaft_rad
        joint.advance(joint.step + 50, None)
        if joint.servo.shaft_rad > before:
            return float(output * joint.stall_Nm + gravity_Nm)
    raise AssertionError("it does not turn")


def test_friction_grows_by_its_share_of_the_load(arm: ArmConfig) -> None:
    spec = replace(QUIET, load_friction=(0.1, 0.1), friction_Nm=(0.1, 0.1), stiction_ratio=1.2, play_deg=(0.0, 0.0))
    for load_Nm in (0.0, -0.3, -0.6):
        found = breakaway_Nm(Bench(arm, spec=spec), load_Nm)
        assert found == pytest.approx(1.2 * (0.1 + 0.1 * abs(load_Nm)), abs=0.003)


def test_a_warm_joint_has_less_friction(arm: ArmConfig) -> None:
    bench = Bench(arm, spec=replace(QUIET, friction_per_degC=0.004))
    bench.hold()
    bench.arm.servos[1].temperature_degC = 55.0
    bench.goto(turned(0.2), wait_s=1.0)
    assert bench.arm._joints[1].warmth == pytest.approx(math.exp(-0.004 * 25.0), abs=0.002)
    assert bench.arm._joints[5].warmth == pytest.approx(1.0, abs=0.002)


@pytest.mark.parametrize("continues", [True, False])
def test_a_servo_follows_a_new_goal_after_its_dead_time_and_shows_it_at_once(arm: ArmConfig, continues: bool) -> None:
    variants = ServoVariants(ramp_from_reference=continues)
    bench = Bench(arm, spec=replace(QUIET, dead_time_s=(0.03, 0.03), variants=variants))
    bench.hold()
    yaw = bench.arm.servos[0]
    before = yaw.reference_tick
    bench.bus.receive(write(yaw.servo_id, ax12a.GOAL, yaw.get(ax12a.GOAL) + 40), bench.now_ns)
    bench.wait(0.02)
    assert yaw.get(ax12a.GOAL) == before + 40
    assert yaw.reference_tick == before
    bench.wait(0.02)
    assert before < yaw.reference_tick < before + 40


def test_a_second_goal_in_the_dead_time_is_followed_in_its_turn(arm: ArmConfig) -> None:
    bench = Bench(arm, spec=replace(QUIET, dead_time_s=(0.03, 0.03)))
    bench.hold()
    yaw = bench.arm.servos[0]
    home = yaw.reference_tick
    for way, wait_s in ((200, 0.02), (-200, 0.025)):
        bench.bus.receive(write(yaw.servo_id, ax12a.GOAL, round(home) + way), bench.now_ns)
        bench.wait(wait_s)
    assert yaw.reference_tick > home
    bench.wait(0.1)
    assert yaw.reference_tick < home


def test_torque_goes_off_without_a_dead_time(arm: ArmConfig) -> None:
    bench = Bench(arm, spec=replace(QUIET, dead_time_s=(0.05, 0.05)))
    bench.hold()
    assert bench.arm.servos[1].output != 0.0
    bench.bus.receive(write(2, ax12a.TORQUE_ENABLE, 0), bench.now_ns)
    bench.wait(0.003)
    assert not bench.arm._joints[1].drive.enabled
    assert bench.arm.servos[1].output == 0.0


def test_a_slope_that_is_shorter_than_asked_holds_stiffer(arm: ArmConfig) -> None:
    sags = []
    for share in (1.0, 0.5):
        bench = Bench(arm, spec=replace(QUIET, slope_share=(share, share)))
        bench.hold()
        sags.append(WORKING_RAD[1] - bench.arm.true_positions()[1])
    assert 0.4 * sags[0] < sags[1] < 0.75 * sags[0]


def test_supply_falls_from_servo_to_servo(arm: ArmConfig) -> None:
    bench = Bench(arm, spec=replace(QUIET, cable_ohm=0.1))
    bench.hold()
    voltages_V = [servo.voltage_V for servo in bench.arm.servos]
    assert voltages_V == sorted(voltages_V, reverse=True)
    assert voltages_V[0] - voltages_V[-1] > 0.005
    bench.limp()
    bench.wait(5.0)
    assert {servo.voltage_V for servo in bench.arm.servos} == {12.0}


PING = encode_instruction(1, Instruction.PING)


@pytest.mark.parametrize(
    ("request_", "firmware_us"),
    [(PING, 18), (read(1), 22), (write(1, ax12a.LED, 1), 30), (write(1, ax12a.PUNCH, 40), 36)],
    ids=["ping", "read", "a byte", "a word"],
)
def test_a_reply_takes_the_firmware_its_time(arm: ArmConfig, request_: bytes, firmware_us: int) -> None:
    plain, timed = (Bench(arm, spec=replace(QUIET, firmware_takes_time=asked)) for asked in (False, True))
    late_ns = timed.ask(request_)[0][0] - plain.ask(request_)[0][0]
    assert late_ns == firmware_us * 1000


@pytest.mark.parametrize(
    ("register", "mute_s"), [(ax12a.LED, 0.0), (ax12a.RETURN_DELAY, 0.006), (ax12a.CW_LIMIT, 0.012)]
)
def test_a_servo_is_deaf_while_its_eeprom_is_written(arm: ArmConfig, register: ax12a.Register, mute_s: float) -> None:
    for since_s, heard in ((mute_s - 0.001, False), (mute_s + 0.001, True))[mute_s == 0.0 :]:
        bench = Bench(arm, spec=replace(QUIET, firmware_takes_time=True))
        begin_ns = bench.now_ns
        assert bench.packets(write(1, register, 1))[0].servo_id == 1
        bench.bus._last_byte_ns = None
        bench.now_ns = begin_ns + round((since_s + 0.0001) * 1e9)
        bench.bus.receive(read(1), bench.now_ns)
        assert (bench.bus.arrival_ns() is not None) is heard


# ---------------------------------------------------------------------------------- what the manuals leave open


def varied(arm: ArmConfig, **switches: bool | float) -> Bench:
    return Bench(arm, spec=replace(QUIET, variants=ServoVariants(**switches)))  # type: ignore[arg-type]


def test_a_broadcast_ping_is_met_with_silence_or_by_all_at_once(arm: ArmConfig) -> None:
    everybody = encode_instruction(BROADCAST_ID, Instruction.PING)
    assert varied(arm).hear(everybody) == b""
    heard = varied(arm, broadcast_ping_answered=True).hear(everybody)
    assert len(heard) == 6  # of replies on top of one another, the bitwise AND
    assert heard[:2] == b"\xff\xff"
    assert heard[2] == 1 & 2 & 3 & 4 & 5 & 6


def test_an_undefined_instruction_is_met_with_silence_or_with_its_error_bit(arm: ArmConfig) -> None:
    unknown = encode_instruction(1, 0x92)  # BULK_READ
    assert varied(arm).hear(unknown) == b""
    assert varied(arm, unknown_instruction_answered=True).packets(unknown) == [Packet(1, ErrorBit.INSTRUCTION)]


def test_a_goal_in_wheel_mode_means_nothing_or_is_an_angle_limit_error(arm: ArmConfig) -> None:
    for refused in (False, True):
        bench = varied(arm, wheel_goal_refused=refused)
        for limit in (ax12a.CW_LIMIT, ax12a.CCW_LIMIT):
            bench.arm.servos[0].set(limit, 0)
        (reply,) = bench.packets(write(1, ax12a.GOAL, 700))
        assert not isinstance(reply, BadChecksum)
        assert reply.code == (ErrorBit.ANGLE_LIMIT if refused else 0)


def test_the_led_blinks_on_for_a_while_after_an_alarm(arm: ArmConfig) -> None:
    for lingers_s, shown in ((0.0, ["off", "off"]), (2.0, ["blinking", "off"])):
        bench = varied(arm, led_lingers_s=lingers_s)
        bench.hold()
        bench.begin("hot", 1, 75.0)
        bench.wait(0.1)
        assert bench.arm.servos[0].led == "blinking"
        bench.arm.servos[0].temperature_degC = 40.0
        found = []
        for wait_s in (1.5, 1.0):
            bench.wait(wait_s)
            bench.packets(PING)
            found.append(bench.arm.servos[0].led)
        assert found == shown
