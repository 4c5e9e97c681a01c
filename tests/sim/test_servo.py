"""The simulated servo's table and instructions, packet by packet."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import TICK_RAD, ErrorBit, Register
from armctl.dynamixel.packet import Decoder, Instruction, Packet
from armctl.sim.servo import ServoVariants, SimulatedServo


def servo(variants: ServoVariants = ServoVariants(), *, noise_tick: float = 0.0) -> SimulatedServo:  # noqa: B008
    return SimulatedServo(5, np.random.default_rng(0), position_tick=400.0, noise_tick=noise_tick, variants=variants)


@pytest.fixture
def one() -> SimulatedServo:
    return servo()


def ask(one: SimulatedServo, instruction: int, parameters: bytes = b"") -> Packet:
    (reply,) = Decoder().feed(one.handle(Packet(5, instruction, parameters)) or b"")
    assert isinstance(reply, Packet)
    return reply


def write(one: SimulatedServo, register: Register, value: int, instruction: int = Instruction.WRITE) -> int:
    return ask(one, instruction, bytes((register.address,)) + value.to_bytes(register.size, "little")).code


def read(one: SimulatedServo, register: Register) -> int:
    reply = ask(one, Instruction.READ, bytes((register.address, register.size)))
    assert reply.code == 0
    return int.from_bytes(reply.parameters, "little")


def test_powered_up_servo_holds_the_factory_table_and_is_limp(one: SimulatedServo) -> None:
    for register in ax12a.REGISTERS:
        expected = {ax12a.ID: 5, ax12a.GOAL: 400, ax12a.PRESENT_POSITION: 400}.get(register, register.default)
        assert read(one, register) == expected, register.name
    assert not one.torque_enabled


@given(st.sampled_from(ax12a.REGISTERS), st.integers(0, 0xFFFF))
def test_every_register_keeps_its_access_and_range(register: Register, value: int) -> None:
    one = servo()
    value &= 0xFF if register.size == 1 else 0xFFFF
    before = one.get(register)
    highest = 1023 if register is ax12a.MOVING_SPEED else register.maximum
    accepted = register.writable and register.minimum <= value <= highest
    code = write(one, register, value)
    alarms = ErrorBit.VOLTAGE | ErrorBit.OVERHEAT  # the write may move a limit over the measured value
    assert code & ~alarms == (0 if accepted else ErrorBit.RANGE)
    assert one.get(register) == (value if accepted else before)


@given(st.integers(0, 255), st.integers(0, 255))
def test_a_read_beyond_the_table_is_a_range_error(begin: int, size: int) -> None:
    reply = ask(servo(), Instruction.READ, bytes((begin, size)))
    if 0 < size <= ax12a.TABLE_SIZE - begin:
        assert (reply.code, len(reply.parameters)) == (0, size)
    else:
        assert reply == Packet(5, ErrorBit.RANGE)


@pytest.mark.parametrize(
    ("register", "field"), [(ax12a.GOAL, "goal_write_energises"), (ax12a.MOVING_SPEED, "speed_write_energises")]
)
@pytest.mark.parametrize("does", [False, True])
def test_variant_writing_goal_or_speed_energises(register: Register, field: str, does: bool) -> None:
    one = servo(ServoVariants(**{field: does}))
    assert write(one, register, 410) == 0
    assert one.torque_enabled is does


@pytest.mark.parametrize("follows", [False, True])
def test_variant_goal_follows_position_while_limp(follows: bool) -> None:
    one = servo(ServoVariants(goal_follows_when_limp=follows))
    one.shaft_rad = 450.0 * TICK_RAD
    assert read(one, ax12a.GOAL) == (450 if follows else 400)
    write(one, ax12a.TORQUE_ENABLE, 1)
    one.shaft_rad = 470.0 * TICK_RAD
    assert one.drive.goal_tick == (450 if follows else 400)
    assert one.reference_tick == 450


@pytest.mark.parametrize("continues", [False, True])
def test_variant_ramp_restarts_at_the_reference_or_at_the_position(continues: bool) -> None:
    one = servo(ServoVariants(ramp_from_reference=continues))
    write(one, ax12a.GOAL, 500)
    one.reference_tick, one.shaft_rad = 440.0, 431.2 * TICK_RAD
    write(one, ax12a.GOAL, 510)
    assert one.ramp_restarts is not continues  # at the position, once the joint takes it over


def test_explicit_torque_off_in_a_goal_write_wins(one: SimulatedServo) -> None:
    ask(one, Instruction.WRITE, bytes((24, 0, 0, 1, 1, 32, 32, 88, 2)))
    assert not one.torque_enabled


def test_trip_drops_torque_and_needs_limit_and_enable_to_recover(one: SimulatedServo) -> None:
    write(one, ax12a.GOAL, 600)
    one.protect(overloaded=True)
    assert (one.torque_enabled, one.get(ax12a.TORQUE_LIMIT)) == (False, 0)
    assert write(one, ax12a.TORQUE_ENABLE, 1) == ErrorBit.OVERLOAD
    one.protect()
    assert not one.torque_enabled
    assert write(one, ax12a.TORQUE_LIMIT, 500) == ErrorBit.OVERLOAD
    assert write(one, ax12a.TORQUE_ENABLE, 1) == 0
    one.protect()
    assert one.torque_enabled


def test_heat_and_voltage_stand_in_every_reply_while_they_last(one: SimulatedServo) -> None:
    one.temperature_degC = 71.0
    one.voltage_V = 5.9
    assert ask(one, Instruction.PING) == Packet(5, ErrorBit.OVERHEAT | ErrorBit.VOLTAGE)
    assert ask(one, Instruction.READ, bytes((42, 2))).parameters == bytes((59, 71))
    write(one, ax12a.TORQUE_ENABLE, 1)
    one.protect()
    assert not one.torque_enabled
    one.temperature_degC, one.voltage_V = 40.0, 12.0
    assert ask(one, Instruction.PING) == Packet(5, 0)


def test_measured_registers_are_signed_magnitude_and_clamped(one: SimulatedServo) -> None:
    write(one, ax12a.GOAL, 500)
    one.velocity_rad_s, one.output, one.shaft_rad = -1.0, -0.5, -3.0 * TICK_RAD
    assert ax12a.signed_magnitude(read(one, ax12a.PRESENT_SPEED)) == -round(1.0 / ax12a.SPEED_UNIT_RAD_S)
    assert ax12a.load_ratio(read(one, ax12a.PRESENT_LOAD)) == pytest.approx(-0.5, abs=1e-3)
    assert read(one, ax12a.PRESENT_POSITION) == 0
    assert read(one, ax12a.MOVING) == 1


@given(
    measured=st.fixed_dictionaries(
        {
            "shaft_rad": st.floats(-0.5, 6.8),
            "velocity_rad_s": st.floats(-13.0, 13.0),
            "output": st.floats(-1.0, 1.0),
            "voltage_V": st.floats(-1.0, 30.0),
            "temperature_degC": st.floats(-20.0, 300.0),
            "frozen_tick": st.sampled_from([None, 0, 700]),
        }
    )
)
def test_whatever_is_measured_stays_in_its_registers_and_their_ranges(measured: dict[str, float]) -> None:
    one = servo()
    before = {register: one.get(register) for register in ax12a.REGISTERS}
    vars(one).update(measured)
    for register in ax12a.REGISTERS:
        assert register.minimum <= one.get(register) <= register.maximum
        if register is not ax12a.GOAL and register is not ax12a.MOVING and not register.name.startswith("present_"):
            assert one.get(register) == before[register]


def test_reported_position_has_the_noise_asked_for() -> None:
    one = servo(noise_tick=0.5)
    ticks = [read(one, ax12a.PRESENT_POSITION) for _ in range(2000)]
    assert np.mean(ticks) == pytest.approx(400.0, abs=0.05)
    assert np.std(ticks) == pytest.approx(np.sqrt(0.25 + 1.0 / 12.0), abs=0.05)


@pytest.mark.parametrize(
    ("speed", "limit", "spin"),
    [(0, 1023, 0.0), (512, 1023, 512 / 1023), (1536, 1023, -512 / 1023), (2047, 1023, -1.0), (1023, 200, 200 / 1023)],
)
def test_wheel_mode_turns_by_speed_with_bit_10_for_the_direction(
    one: SimulatedServo, speed: int, limit: int, spin: float
) -> None:
    write(one, ax12a.CCW_LIMIT, 0)
    assert one.drive.spin is not None
    assert write(one, ax12a.TORQUE_LIMIT, limit) == 0
    assert write(one, ax12a.MOVING_SPEED, speed) == 0
    assert one.torque_enabled
    assert one.drive.spin == pytest.approx(spin)


def test_baud_register_means_2_mbps_over_one_more(one: SimulatedServo) -> None:
    for value in range(255):
        assert write(one, ax12a.BAUD, value) == 0
        assert one.baud == pytest.approx(2_000_000 / (value + 1))


@pytest.mark.parametrize(
    ("cause", "bit"),
    [
        ((Instruction.WRITE, bytes((36, 0, 0))), ErrorBit.RANGE),
        ((Instruction.WRITE, bytes((30, 254, 3))), ErrorBit.ANGLE_LIMIT),
        ((Instruction.ACTION, b""), ErrorBit.INSTRUCTION),
        ({"voltage_V": 5.0}, ErrorBit.VOLTAGE),
        ({"temperature_degC": 80.0}, ErrorBit.OVERHEAT),
        ({"overloaded": True}, ErrorBit.OVERLOAD),
    ],
)
@pytest.mark.parametrize("masked", [False, True])
def test_any_error_trips_and_blinks_if_and_only_if_its_mask_says_so(
    one: SimulatedServo, cause: dict[str, float] | tuple[Instruction, bytes], bit: ErrorBit, masked: bool
) -> None:
    write(one, ax12a.CCW_LIMIT, 1000)
    write(one, ax12a.SHUTDOWN, bit if masked else 127 - bit)
    write(one, ax12a.ALARM_LED, bit if masked else 127 - bit)
    write(one, ax12a.GOAL, 400)
    if isinstance(cause, dict):
        vars(one).update(cause)
        one.protect()
    else:
        assert ask(one, *cause) == Packet(5, bit)
    told = one.torque_enabled, one.get(ax12a.TORQUE_LIMIT), one.led
    assert told == ((False, 0, "blinking") if masked else (True, 1023, "off"))


def test_led_follows_its_register_while_nothing_alarms(one: SimulatedServo) -> None:
    shown = [one.led]
    write(one, ax12a.LED, 1)
    assert [*shown, one.led] == ["off", "on"]


def test_reboot_forgets_the_ram_and_keeps_the_eeprom(one: SimulatedServo) -> None:
    write(one, ax12a.MAX_TORQUE, 700)
    write(one, ax12a.CW_LIMIT, 100)
    write(one, ax12a.GOAL, 600)
    write(one, ax12a.PUNCH, 50)
    write(one, ax12a.LED, 1, Instruction.REG_WRITE)
    write(one, ax12a.LOCK, 1)
    one.protect(overloaded=True)
    one.reboot()
    kept = {ax12a.ID: 5, ax12a.MAX_TORQUE: 700, ax12a.CW_LIMIT: 100}
    begun = {ax12a.GOAL: 400, ax12a.PRESENT_POSITION: 400, ax12a.TORQUE_LIMIT: 700}
    for register in ax12a.REGISTERS:
        assert read(one, register) == {**kept, **begun}.get(register, register.default), register.name
    assert (one.torque_enabled, one.overloaded) == (False, False)
    assert write(one, ax12a.PUNCH, 40) == 0


def test_moving_is_a_goal_not_reached_or_a_shaft_that_turns(one: SimulatedServo) -> None:
    write(one, ax12a.TORQUE_ENABLE, 1)
    assert read(one, ax12a.MOVING) == 0
    write(one, ax12a.GOAL, 500)
    assert read(one, ax12a.MOVING) == 1
    one.reference_tick = 500.0
    assert read(one, ax12a.MOVING) == 0
    one.velocity_rad_s = 0.5
    assert read(one, ax12a.MOVING) == 1
    write(one, ax12a.TORQUE_ENABLE, 0)
    assert read(one, ax12a.MOVING) == 0
