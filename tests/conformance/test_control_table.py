"""The AX-12A's control table over the wire: access, ranges, whole writes, and what torque and LOCK forbid."""

import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit, Register
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, encode_instruction
from tests.conformance.conftest import Wire

# Writable without moving anything, heating alarms or losing contact; slopes are left out, being quantised.
HARMLESS = (ax12a.RETURN_DELAY, ax12a.ALARM_LED, ax12a.LED, ax12a.CW_MARGIN, ax12a.CCW_MARGIN, ax12a.PUNCH)
# Registers that can hold more than they may.
BOUNDED = (
    ax12a.RETURN_DELAY, ax12a.TEMPERATURE_LIMIT, ax12a.MAX_TORQUE, ax12a.RETURN_LEVEL, ax12a.ALARM_LED, ax12a.LED,
    ax12a.CW_MARGIN, ax12a.CCW_SLOPE, ax12a.PUNCH,
)  # fmt: skip


def name(register: Register) -> str:
    return register.name


def test_every_servo_knows_its_model_and_its_id(wire: Wire) -> None:
    for servo_id in wire.servo_ids:
        table = wire.read(servo_id, 0, 4)
        assert ax12a.register_value(ax12a.MODEL, table, 0) == wire.model_number
        assert table[ax12a.ID.address] == servo_id


def test_every_register_lies_within_the_table_bounds(wire: Wire) -> None:
    for servo_id in wire.servo_ids:
        table = wire.read(servo_id, 0, ax12a.TABLE_SIZE)
        for register in ax12a.REGISTERS:
            found = ax12a.register_value(register, table, 0)
            assert register.minimum <= found <= register.maximum, (servo_id, register.name, found)


def test_a_table_read_in_parts_is_the_table(wire: Wire, servo: int) -> None:
    whole = wire.read(servo, 0, 30)
    assert b"".join(wire.read(servo, begin, size) for begin, size in ((0, 7), (7, 1), (8, 15), (23, 7))) == whole


@pytest.mark.parametrize("register", ax12a.REGISTERS, ids=name)
def test_every_register_can_be_read_alone(wire: Wire, servo: int, register: Register) -> None:
    assert len(wire.read(servo, register.address, register.size)) == register.size


@pytest.mark.parametrize(("begin", "size"), [(49, 2), (50, 1), (0, 51), (255, 255), (24, 0)])
def test_a_read_beyond_the_table_is_a_range_error(wire: Wire, servo: int, begin: int, size: int) -> None:
    status = wire.ask(servo, Instruction.READ, bytes((begin, size)))
    assert (status.code, status.parameters) == (ErrorBit.RANGE, b"")


@pytest.mark.parametrize("register", HARMLESS, ids=name)
def test_a_write_reads_back_at_both_bounds(wire: Wire, servo: int, register: Register) -> None:
    for value in (register.minimum, register.maximum):
        assert wire.put(servo, register, value) == 0
        assert wire.value(servo, register) == value


def test_words_are_little_endian(wire: Wire, servo: int) -> None:
    assert wire.write(servo, ax12a.PUNCH.address, b"\x02\x01") == 0
    assert wire.value(servo, ax12a.PUNCH) == 0x0102


@pytest.mark.parametrize("register", BOUNDED, ids=name)
def test_a_value_out_of_range_is_refused_and_changes_nothing(wire: Wire, servo: int, register: Register) -> None:
    before = wire.value(servo, register)
    assert wire.put(servo, register, register.maximum + 1) == ErrorBit.RANGE
    assert wire.value(servo, register) == before


@pytest.mark.parametrize("register", [r for r in ax12a.REGISTERS if not r.writable], ids=name)
def test_a_measured_register_cannot_be_written(wire: Wire, servo: int, register: Register) -> None:
    assert wire.put(servo, register, 1) == ErrorBit.RANGE


def test_a_write_counts_as_a_whole_or_not_at_all(wire: Wire, servo: int) -> None:
    before = wire.read(servo, 26, 2)
    assert wire.write(servo, 26, bytes((5, 255))) == ErrorBit.RANGE
    assert wire.read(servo, 26, 2) == before
    assert wire.write(servo, 26, bytes((5, 6))) == 0
    assert wire.read(servo, 26, 2) == bytes((5, 6))


def test_a_write_beyond_the_table_is_a_range_error(wire: Wire, servo: int) -> None:
    assert wire.write(servo, 49, b"\x00\x00") == ErrorBit.RANGE


@pytest.mark.usefixtures("may_move")
def test_eeprom_is_refused_while_torque_is_on_and_ram_is_not(wire: Wire, servo: int) -> None:
    before = wire.value(servo, ax12a.RETURN_DELAY)
    assert wire.put(servo, ax12a.TORQUE_LIMIT, 100) == 0
    assert wire.put(servo, ax12a.TORQUE_ENABLE, 1) == 0
    assert wire.put(servo, ax12a.RETURN_DELAY, before - 1) == ErrorBit.RANGE
    assert wire.value(servo, ax12a.RETURN_DELAY) == before
    assert wire.put(servo, ax12a.CW_MARGIN, 3) == 0
    assert wire.put(servo, ax12a.TORQUE_ENABLE, 0) == 0
    assert wire.put(servo, ax12a.RETURN_DELAY, before - 1) == 0
    assert wire.value(servo, ax12a.RETURN_DELAY) == before - 1


@pytest.mark.usefixtures("may_move")
def test_a_goal_outside_the_angle_limits_is_refused_and_the_limit_itself_is_not(wire: Wire, servo: int) -> None:
    position = wire.value(servo, ax12a.PRESENT_POSITION)
    for register, limit in ((ax12a.CW_LIMIT, position - 20), (ax12a.CCW_LIMIT, position + 20)):
        assert wire.put(servo, register, limit) == 0
    assert wire.put(servo, ax12a.TORQUE_LIMIT, 0) == 0  # the goal counts, the servo stays limp
    for goal, error in ((position + 21, ErrorBit.ANGLE_LIMIT), (position - 21, ErrorBit.ANGLE_LIMIT)):
        assert wire.put(servo, ax12a.GOAL, goal) == error
        assert not wire.value(servo, ax12a.TORQUE_ENABLE)
    for goal in (position - 20, position + 20):
        assert wire.put(servo, ax12a.GOAL, goal) == 0
        assert wire.value(servo, ax12a.GOAL) == goal


@pytest.mark.usefixtures("may_move")
def test_a_goal_is_reached_at_the_moving_speed_and_moving_tells_so(wire: Wire, servo: int) -> None:
    start = wire.value(servo, ax12a.PRESENT_POSITION)
    goal = start + 40 if start < 512 else start - 40
    speed = 60  # 40 deg/s: 40 ticks take 0.3 s
    assert wire.put(servo, ax12a.TORQUE_LIMIT, 1023) == 0
    data = goal.to_bytes(2, "little") + speed.to_bytes(2, "little")
    wire.broadcast(Instruction.SYNC_WRITE, bytes((ax12a.GOAL.address, 4, servo)) + data)
    assert wire.put(servo, ax12a.TORQUE_ENABLE, 1) == 0
    assert wire.value(servo, ax12a.MOVING) == 1
    wire.sleep(0.15)
    assert 2 <= abs(wire.value(servo, ax12a.PRESENT_POSITION) - start) <= 38
    wire.sleep(0.6)
    assert abs(wire.value(servo, ax12a.PRESENT_POSITION) - goal) <= 8
    assert wire.value(servo, ax12a.MOVING) == 0


def test_lock_leaves_only_24_to_35_writable_until_power_off(spare: Wire) -> None:
    servo = spare.servo_ids[0]
    assert spare.put(servo, ax12a.LOCK, 1) == 0
    assert spare.put(servo, ax12a.LED, 1) == 0
    assert spare.put(servo, ax12a.TORQUE_LIMIT, 500) == 0
    for register, value in ((ax12a.LOCK, 0), (ax12a.PUNCH, 40), (ax12a.RETURN_DELAY, 1), (ax12a.ID, 9)):
        assert spare.put(servo, register, value) == ErrorBit.RANGE
        assert spare.value(servo, register) != value


def test_a_broadcast_write_out_of_range_changes_nothing(wire: Wire, servo: int) -> None:
    before = [wire.value(servo_id, ax12a.PUNCH) for servo_id in wire.servo_ids]
    packet = encode_instruction(BROADCAST_ID, Instruction.WRITE, bytes((ax12a.PUNCH.address, 0, 4)))
    assert wire.silent(packet)
    assert [wire.value(servo_id, ax12a.PUNCH) for servo_id in wire.servo_ids] == before
