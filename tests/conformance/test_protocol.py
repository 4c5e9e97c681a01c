"""Protocol 1.0 as an AX-12A speaks it: packets, answers, silence, and the shape of time on the wire."""

import statistics

import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, encode_instruction
from tests.conformance.conftest import Wire

PING_REPLY_SIZE = 6


def ping(servo_id: int) -> bytes:
    return encode_instruction(servo_id, Instruction.PING)


def bad_checksum(packet: bytes) -> bytes:
    return packet[:-1] + bytes((packet[-1] ^ 0x55,))


def test_every_servo_answers_a_ping_with_its_own_id_and_no_error(wire: Wire) -> None:
    for servo_id in wire.servo_ids:
        status = wire.ask(servo_id, Instruction.PING)
        assert (status.code, status.parameters) == (0, b"")


def test_ids_nobody_has_stay_silent(wire: Wire) -> None:
    for servo_id in {0, 101, 200, 253} - set(wire.servo_ids):
        assert wire.silent(ping(servo_id))


def test_a_reply_ends_with_its_last_byte(wire: Wire, servo: int) -> None:
    assert len(wire.talk(ping(servo))) == PING_REPLY_SIZE


@pytest.mark.parametrize("instruction", [0x00, 0x07, 0x08, 0x55, 0x82, 0x92, 0xFF])
def test_an_unknown_instruction_is_met_with_silence(wire: Wire, servo: int, instruction: int) -> None:
    """0x82 and 0x92 among them: an AX-12A has neither SYNC_READ nor BULK_READ."""
    assert wire.silent(encode_instruction(servo, instruction, b"\x24\x02"))
    assert wire.ask(servo, Instruction.PING).code == 0


def test_a_bad_checksum_is_told_by_the_servo_it_names_and_changes_nothing(wire: Wire, servo: int) -> None:
    before = wire.value(servo, ax12a.LED)
    write = encode_instruction(servo, Instruction.WRITE, bytes((ax12a.LED.address, 1 - before)))
    answer = wire.talk(bad_checksum(write), size=PING_REPLY_SIZE)
    assert answer[:5] == bytes((0xFF, 0xFF, servo, 2, ErrorBit.CHECKSUM))
    assert wire.value(servo, ax12a.LED) == before


def test_a_bad_checksum_to_all_is_met_with_silence(wire: Wire) -> None:
    assert wire.silent(bad_checksum(encode_instruction(BROADCAST_ID, Instruction.ACTION)))


WRONG_COUNTS = (
    *((Instruction.READ, parameters) for parameters in (b"", b"\x24", b"\x24\x02\x00")),
    *((Instruction.WRITE, parameters) for parameters in (b"", bytes((ax12a.LED.address,)))),
    (Instruction.ACTION, b""),  # with nothing registered
)


@pytest.mark.parametrize(("instruction", "parameters"), WRONG_COUNTS)
def test_what_cannot_be_done_is_an_instruction_error(
    wire: Wire, servo: int, instruction: Instruction, parameters: bytes
) -> None:
    status = wire.ask(servo, instruction, parameters)
    assert (status.code, status.parameters) == (ErrorBit.INSTRUCTION, b"")


def test_a_request_may_be_cut_at_every_byte(wire: Wire, servo: int) -> None:
    request = encode_instruction(servo, Instruction.READ, bytes((0, 3)))
    whole = wire.talk(request, size=9)
    assert len(whole) == 9
    for cut in range(1, len(request)):
        assert wire.talk(request[:cut], request[cut:], gap_s=0.002, size=9) == whole
    assert wire.talk(*(request[i : i + 1] for i in range(len(request))), gap_s=0.002, size=9) == whole


def test_a_gap_of_over_100_ms_makes_a_request_forgotten(wire: Wire, servo: int) -> None:
    # Exact where the test has the clock; in real time with room for whatever else the machine runs.
    over_s, under_s = (0.101, 0.099) if wire.kind == "loopback" else (0.6, 0.01)
    request = ping(servo)
    assert wire.silent(request[:3], request[3:], gap_s=over_s)
    assert len(wire.talk(request, size=PING_REPLY_SIZE)) == PING_REPLY_SIZE
    assert len(wire.talk(request[:3], request[3:], gap_s=under_s, size=PING_REPLY_SIZE)) == PING_REPLY_SIZE


@pytest.mark.parametrize("dirt", [b"\x00", b"\xff", b"\xff\xff\xff", b"\x55\xaa\xff\x00", b"\xff\xff\xff\xff\xff"])
def test_dirt_before_a_header_is_skipped(wire: Wire, servo: int, dirt: bytes) -> None:
    assert len(wire.talk(dirt + ping(servo), size=PING_REPLY_SIZE)) == PING_REPLY_SIZE


def test_a_broadcast_is_never_answered(wire: Wire) -> None:
    wire.broadcast(Instruction.PING)
    wire.broadcast(Instruction.READ, bytes((0, 3)))
    wire.broadcast(Instruction.ACTION)


def test_a_broadcast_write_reaches_every_servo(wire: Wire, servo: int) -> None:
    for led in (1, 0):
        wire.broadcast(Instruction.WRITE, bytes((ax12a.LED.address, led)))
        assert [wire.value(servo_id, ax12a.LED) for servo_id in wire.servo_ids] == [led] * len(wire.servo_ids)


def test_sync_write_gives_each_servo_its_own_value_in_silence(wire: Wire, servo: int) -> None:
    punches = {servo_id: 32 + servo_id for servo_id in wire.servo_ids}
    for values in (punches, dict.fromkeys(wire.servo_ids, ax12a.PUNCH.default)):
        data = bytes((ax12a.PUNCH.address, 2))
        for servo_id, value in values.items():
            data += bytes((servo_id,)) + value.to_bytes(2, "little")
        wire.broadcast(Instruction.SYNC_WRITE, data)
        assert {servo_id: wire.value(servo_id, ax12a.PUNCH) for servo_id in wire.servo_ids} == values


def test_malformed_sync_write_changes_nothing(wire: Wire, servo: int) -> None:
    before, at = wire.value(servo, ax12a.PUNCH), ax12a.PUNCH.address
    for parameters in ((), (at,), (at, 0, servo), (at, 2, servo, 99), (at, 4, servo, 0, 1), (at, 2, servo, 0, 4)):
        wire.broadcast(Instruction.SYNC_WRITE, bytes(parameters))
        assert wire.value(servo, ax12a.PUNCH) == before


@pytest.mark.parametrize("to_all", [False, True])
def test_a_registered_write_waits_for_action(wire: Wire, servo: int, to_all: bool) -> None:
    before = wire.value(servo, ax12a.LED)
    assert wire.ask(servo, Instruction.REG_WRITE, bytes((ax12a.LED.address, 1 - before))).code == 0
    assert (wire.value(servo, ax12a.LED), wire.value(servo, ax12a.REGISTERED)) == (before, 1)
    if to_all:
        wire.broadcast(Instruction.ACTION)
    else:
        assert wire.ask(servo, Instruction.ACTION).code == 0
    assert (wire.value(servo, ax12a.LED), wire.value(servo, ax12a.REGISTERED)) == (1 - before, 0)


def test_a_registered_write_out_of_range_is_refused_at_once(wire: Wire, servo: int) -> None:
    assert wire.ask(servo, Instruction.REG_WRITE, bytes((ax12a.LED.address, 2))).code == ErrorBit.RANGE
    assert wire.value(servo, ax12a.REGISTERED) == 0


@pytest.mark.parametrize(("level", "reads"), [(0, False), (1, True), (2, True)])
def test_status_return_level_decides_what_is_answered(wire: Wire, servo: int, level: int, reads: bool) -> None:
    wire.talk(encode_instruction(servo, Instruction.WRITE, bytes((ax12a.RETURN_LEVEL.address, level))))
    assert wire.ask(servo, Instruction.PING).code == 0
    assert bool(wire.talk(encode_instruction(servo, Instruction.READ, bytes((0, 3))), size=9)) is reads
    write = encode_instruction(servo, Instruction.WRITE, bytes((ax12a.LED.address, 1)))
    assert bool(wire.talk(write, size=PING_REPLY_SIZE)) is (level == 2)
    assert bool(wire.talk(bad_checksum(ping(servo)), size=PING_REPLY_SIZE)) is (level == 2)
    wire.talk(encode_instruction(servo, Instruction.WRITE, bytes((ax12a.RETURN_LEVEL.address, 2))))
    assert wire.value(servo, ax12a.LED) == 1


@pytest.mark.parametrize("delay", [0, 100, 254])
def test_a_reply_takes_its_bytes_time_and_the_return_delay(wire: Wire, servo: int, delay: int) -> None:
    assert wire.put(servo, ax12a.RETURN_DELAY, delay) == 0
    request = encode_instruction(servo, Instruction.READ, bytes((24, 26)))
    took_us = []
    for _ in range(5):
        wire.port.clearPort()
        begin_ns = wire.clock.now_ns()
        wire.port.writePort(list(request))
        wire.port.setPacketTimeoutMillis(100.0)
        assert len(wire.port.readPort(32)) == 32
        took_us.append((wire.clock.now_ns() - begin_ns) / 1000.0)
    least_us = (8 + 32) * 10 + 2 * delay
    assert min(took_us) >= least_us
    assert statistics.median(took_us) <= least_us + 40_000


def test_a_servo_hears_only_its_own_baud(spare: Wire) -> None:
    servo = spare.servo_ids[0]
    assert spare.put(servo, ax12a.BAUD, 34) == 0  # 57 143 baud, 0.8 % off 57 600
    assert spare.silent(ping(servo))
    assert spare.ask(spare.servo_ids[1], Instruction.PING).code == 0
    spare.host_baud(57_600)
    assert spare.ask(servo, Instruction.PING).code == 0
    assert spare.silent(ping(spare.servo_ids[1]))


def test_a_servo_answers_under_its_new_id_only(spare: Wire) -> None:
    servo = spare.servo_ids[0]
    assert spare.put(servo, ax12a.ID, 77) == 0
    assert spare.silent(ping(servo))
    assert spare.ask(77, Instruction.PING).code == 0


def test_reset_brings_back_the_factory_table_and_id_1(spare: Wire) -> None:
    first, second = spare.servo_ids[:2]
    assert spare.put(first, ax12a.ID, 99) == 0
    assert spare.put(second, ax12a.PUNCH, 200) == 0
    assert spare.put(second, ax12a.TORQUE_ENABLE, 1) == 0
    assert spare.ask(second, Instruction.RESET).code == 0
    assert spare.silent(ping(second))
    for register in ax12a.REGISTERS:
        if register.writable and register is not ax12a.GOAL:  # which follows the position
            assert spare.value(1, register) == register.default
