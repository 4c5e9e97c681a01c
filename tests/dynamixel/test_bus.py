"""What a sample of `ServoBus` holds when replies are lost, late, doubled or spoilt."""

import logging

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import BUS_NOISE, NO_REPLY, PROBE_EVERY, SILENT_MISSES
from armctl.dynamixel.packet import Instruction, encode_instruction, encode_status
from armctl.messages import Goal, ServoReading, Write
from tests.dynamixel.conftest import LOST, SPOILS, ScriptedBus, at, good_after, these, tick_of

READ_STATUS = bytes((ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE))


def test_sample_holds_bytes_24_to_49_of_every_servo_fresh(bus: ScriptedBus) -> None:
    before_ns = bus.port.clock.now_ns()
    sample = bus.read_sample()
    assert (sample.time_ns, sample.port_open, sample.retries) == (before_ns, True, 0)
    for reading in sample.servos:
        assert (reading.fresh, reading.problem) == (True, "")
        assert reading.registers == bytes(bus.port.tables[reading.servo_id][24:50])
        assert before_ns < reading.stamp_ns <= bus.port.clock.now_ns()
    assert sample.bus_us == pytest.approx(6 * 900, abs=1)  # 8 + 32 bytes at 10 us, 500 us return delay
    assert bus.port.requests == [
        encode_instruction(servo_id, Instruction.READ, READ_STATUS) for servo_id in bus.servo_ids
    ]


@pytest.mark.parametrize("spoil", SPOILS)
def test_bad_reply_is_repeated_once_and_then_good(bus: ScriptedBus, spoil: str) -> None:
    bus.read_sample()
    bus.port.spoils[3] = [SPOILS[spoil]]
    sample = bus.next_sample()
    assert [reading.fresh for reading in sample.servos] == [True] * 6
    assert sample.retries == 1


@pytest.mark.parametrize("spoil", SPOILS)
def test_bad_reply_twice_is_a_stale_reading_that_says_so(bus: ScriptedBus, spoil: str) -> None:
    first = bus.read_sample().servos[2]
    bus.port.place(3, ax12a.PRESENT_TEMPERATURE, 60)
    bus.port.spoils[3] = [SPOILS[spoil]] * 2
    problem = NO_REPLY if spoil == "lost" else BUS_NOISE
    sample = bus.next_sample()
    assert sample.servos[2] == ServoReading(3, first.registers, first.stamp_ns, False, 0, problem)
    assert [reading.fresh for reading in sample.servos] == [True, True, False, True, True, True]
    assert not bus.port.is_using
    after = bus.next_sample().servos[2]
    assert after.fresh
    assert ax12a.register_value(ax12a.PRESENT_TEMPERATURE, after.registers) == 60


def test_servo_that_never_answered_has_no_registers_and_no_stamp(bus: ScriptedBus) -> None:
    bus.port.silent = {4}
    assert bus.read_sample().servos[3] == ServoReading(4, b"", 0, False, 0, NO_REPLY)


def test_silent_servo_costs_at_most_10_ms(bus: ScriptedBus) -> None:
    whole_us = bus.read_sample().bus_us
    bus.port.silent = {4}
    assert bus.next_sample().bus_us - whole_us <= 10_000


def test_long_silent_servo_is_probed_every_fifth_sample_and_found_again(bus: ScriptedBus) -> None:
    bus.port.silent = {4}
    for _ in range(SILENT_MISSES):
        bus.next_sample()
    bus.port.requests.clear()
    for _ in range(2 * PROBE_EVERY):
        assert bus.next_sample().servos[3].problem == NO_REPLY
    assert bus.port.requests.count(encode_instruction(4, Instruction.READ, READ_STATUS)) == 2
    bus.port.silent = set()
    found = [bus.next_sample().servos[3].fresh for _ in range(PROBE_EVERY + 1)]
    assert any(found)
    assert found == sorted(found)  # once back, in every sample


def test_servo_that_answered_anything_else_is_in_the_next_sample(bus: ScriptedBus) -> None:
    bus.port.silent = {4}
    for _ in range(SILENT_MISSES + PROBE_EVERY):
        bus.next_sample()
        bus.port.silent = set()
        assert bus.read(4, ax12a.ID) == 4
        assert bus.next_sample().servos[3].fresh
        bus.port.silent = {4}
        for _ in range(SILENT_MISSES):
            bus.next_sample()


def test_wholly_silent_bus_leaves_more_than_half_of_the_tick(bus: ScriptedBus) -> None:
    bus.port.silent = set(bus.servo_ids)
    costs_us = [bus.next_sample().bus_us for _ in range(20)]
    assert max(costs_us) <= 40_000
    assert max(costs_us[SILENT_MISSES:]) <= 10_000


def test_wholly_babbling_bus_fits_the_tick(bus: ScriptedBus) -> None:
    bus.port.spoils = {servo_id: [these(b"\x55" * 20_000)] * 99 for servo_id in bus.servo_ids}
    samples = [bus.next_sample() for _ in range(5)]
    assert all(reading.problem == BUS_NOISE for sample in samples for reading in sample.servos)
    assert max(sample.bus_us for sample in samples) < 80_000


def test_late_reply_is_drained_and_never_taken_for_the_next_servos(bus: ScriptedBus) -> None:
    bus.read_sample()
    bus.port.place(3, ax12a.PRESENT_POSITION, 5)
    bus.port.spoils[3] = [good_after(4_200)]
    sample = bus.next_sample()
    for reading in sample.servos:
        assert reading.fresh
        assert reading.registers == bytes(bus.port.tables[reading.servo_id][24:50])


def test_motion_no_servo_can_make_is_noise(bus: ScriptedBus) -> None:
    bus.read_sample()
    bus.port.spoils[3] = [at(900)]
    sample = bus.next_sample()
    assert sample.retries == 1
    assert tick_of(sample, 3) == 0


def test_jump_seen_twice_in_a_row_is_reality(bus: ScriptedBus) -> None:
    bus.read_sample()
    bus.port.place(3, ax12a.PRESENT_POSITION, 900)
    sample = bus.next_sample()
    assert sample.retries == 1
    assert sample.servos[2].fresh
    assert tick_of(sample, 3) == 900


def test_jump_without_retry_left_is_stale_now_and_believed_in_the_next_sample(bus: ScriptedBus) -> None:
    bus.read_sample()
    bus.port.place(3, ax12a.PRESENT_POSITION, 900)
    bus.port.spoils = {1: [LOST], 2: [LOST]}
    reading = bus.next_sample().servos[2]
    assert (reading.fresh, reading.problem) == (False, BUS_NOISE)
    assert bus.next_sample().servos[2].fresh


@given(step=st.integers(0, 180), start=st.integers(0, 843))
@settings(max_examples=40)
def test_motion_within_servo_speed_is_never_doubted(step: int, start: int) -> None:
    bus = ScriptedBus(1)
    bus.port.place(1, ax12a.PRESENT_POSITION, start)
    bus.read_sample()
    bus.port.place(1, ax12a.PRESENT_POSITION, start + step)
    sample = bus.next_sample()
    assert (sample.servos[0].fresh, sample.retries) == (True, 0)


@given(replies=st.lists(st.binary(max_size=80), min_size=2, max_size=2))
def test_any_bytes_for_a_reply_are_bounded_in_time_and_never_look_fresh(replies: list[bytes]) -> None:
    bus = ScriptedBus(1)
    bus.port.spoils[1] = [these(data) for data in replies]
    sample = bus.read_sample()
    assert not sample.servos[0].fresh  # a random valid packet of 26 bytes for id 1 is out of reach
    assert sample.bus_us <= 12_000
    assert not bus.port.is_using
    assert bus.read_sample().servos[0].fresh


@given(noise=st.binary(max_size=20).filter(lambda data: b"\xff" not in data))
def test_noise_before_a_good_reply_is_skipped(noise: bytes) -> None:
    bus = ScriptedBus(1)
    bus.port.spoils[1] = [lambda request, good: [(-300, noise), (0, good)]]
    assert bus.read_sample().servos[0].registers == bytes(bus.port.tables[1][24:50])


def test_reply_behind_the_complaint_about_a_damaged_request_is_taken() -> None:
    bus = ScriptedBus(1)
    complaint = encode_status(1, ax12a.ErrorBit.CHECKSUM)
    bus.port.spoils[1] = [lambda request, good: [(0, complaint), (300, good)]]
    sample = bus.read_sample()
    assert sample.servos[0].registers == bytes(bus.port.tables[1][24:50])
    assert sample.retries == 0


def test_error_byte_is_kept_and_every_bit_named(bus: ScriptedBus, caplog: pytest.LogCaptureFixture) -> None:
    bus.port.errors[2] = ax12a.ErrorBit.OVERHEAT | ax12a.ErrorBit.OVERLOAD
    with caplog.at_level(logging.WARNING):
        reading = bus.read_sample().servos[1]
        bus.next_sample()
    assert (reading.fresh, reading.error) == (True, 0x24)
    assert [record.getMessage() for record in caplog.records] == ["servo 2: error bits are now: OVERHEAT, OVERLOAD"]


# ------------------------------------------------------------------------------- throwing away what is not asked for


def test_clean_cycle_throws_away_once(bus: ScriptedBus) -> None:
    bus.next_sample()
    bus.port.flushes = 0
    bus.next_sample()
    assert bus.port.flushes == 1
    assert bus.write_goal(Goal((512,) * 6, (50,) * 6))
    assert bus.port.flushes == 1
    assert bus.write(Write(1, ax12a.LED.address, 1, 1))
    assert bus.write(Write(1, ax12a.LED.address, 1, 0))
    assert bus.port.flushes == 3


@pytest.mark.parametrize("delay_us", [0, 300, 500, 850, 1300])
def test_reply_that_comes_twice_is_believed_of_nobody_else(bus: ScriptedBus, delay_us: int) -> None:
    for servo_id in bus.servo_ids:
        bus.port.place(servo_id, ax12a.PRESENT_POSITION, 100 * servo_id)
    bus.next_sample()
    for servo_id in bus.servo_ids:
        bus.port.spoils[servo_id] = [good_after(0, delay_us)]
    for _ in range(3):
        for reading in bus.next_sample().servos:
            assert ax12a.position_tick(reading.registers) == 100 * reading.servo_id


def test_what_comes_between_two_samples_is_thrown_away(bus: ScriptedBus) -> None:
    bus.next_sample()
    old = encode_status(1, 0, bytes(bus.port.tables[1][24:50]))
    bus.port.spoils[6] = [lambda _, good: [(0, good), (20_000, old)]]
    bus.next_sample()
    bus.port.place(1, ax12a.PRESENT_POSITION, 3)
    sample = bus.next_sample()
    assert sample.retries == 0
    assert tick_of(sample, 1) == 3
