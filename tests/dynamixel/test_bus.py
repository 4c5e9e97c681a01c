"""ServoBus against a scripted transport that answers real protocol bytes in virtual time."""

import logging
from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.clock import VirtualClock
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import BUS_NOISE, NO_REPLY, PORT_GONE, PROBE_EVERY, SILENT_MISSES, ServoBus
from armctl.dynamixel.packet import Instruction, encode_instruction, encode_status
from armctl.dynamixel.port import ServoPort
from armctl.errors import PortGone
from armctl.files import load_arm
from armctl.messages import Goal, Sample, ServoReading, Write

BYTE_NS = 10_000
MS = 1_000_000
TICK_NS = 100 * MS

# (request, good reply) -> what arrives instead: pairs of extra delay [us] and bytes.
Spoil = Callable[[bytes, bytes], list[tuple[int, bytes]]]


READ_STATUS = bytes((ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE))


def servo_table(servo_id: int) -> bytearray:
    table = bytearray(ax12a.TABLE_SIZE)
    for register in ax12a.REGISTERS:
        table[register.address : register.address + register.size] = register.default.to_bytes(register.size, "little")
    table[ax12a.ID.address] = servo_id
    return table


class ScriptedPort(ServoPort):
    """A half-duplex line in virtual time with one register table a servo; `spoil` queues damage per servo."""

    def __init__(self, servo_ids: tuple[int, ...], clock: VirtualClock) -> None:
        super().__init__("scripted", 1_000_000, clock)
        self.virtual_clock = clock
        self.tables = {servo_id: servo_table(servo_id) for servo_id in servo_ids}
        self.errors: dict[int, int] = {}
        self.silent: set[int] = set()
        self.spoils: dict[int, list[Spoil]] = {}
        self.adapter_us = 0
        self.requests: list[bytes] = []
        # Requests until the port vanishes.
        self.gone_after: int | None = None
        self.stuck = False
        self.flushes = 0
        self._line: list[tuple[int, int]] = []

    def openPort(self) -> bool:
        self.is_open, self.gone_after = True, None
        return True

    def closePort(self) -> None:
        self.is_open = False

    def _discard(self) -> None:
        self.flushes += 1
        now_ns = self.clock.now_ns()
        self._line = [item for item in self._line if item[0] > now_ns]

    def getBytesAvailable(self) -> int:
        return sum(at_ns <= self.clock.now_ns() for at_ns, _ in self._line)

    def _fill(self, length: int) -> None:
        if self.gone_after == 0:
            raise PortGone("scripted: the port vanished; plug the adapter in again")
        missing = length - len(self._received)
        due_ns = self._line[missing - 1][0] if len(self._line) >= missing else self._deadline_ns
        self.clock.sleep_until_ns(min(due_ns, self._deadline_ns))
        ready = [item for item in self._line[:missing] if item[0] <= self.clock.now_ns()]
        self._line = self._line[len(ready) :]
        self._received += bytes(byte for _, byte in ready)

    def _send(self, packet: bytes) -> int:
        if self.gone_after is not None:
            self.gone_after -= 1
            if self.gone_after < 0:
                raise PortGone("scripted: the port vanished; plug the adapter in again")
        if self.stuck:
            return 0
        self.requests.append(packet)
        good = self._reply(packet)
        arrivals = [(0, good)] if good else []
        if queue := self.spoils.get(packet[2]):
            arrivals = queue.pop(0)(packet, good)
        at_ns = self.clock.now_ns() + len(packet) * BYTE_NS + 500_000 + self.adapter_us * 1000
        for delay_us, data in arrivals:
            for index, byte in enumerate(data):
                self._line.append((at_ns + delay_us * 1000 + (index + 1) * BYTE_NS, byte))
        self._line.sort(key=lambda item: item[0])
        return len(packet)

    def _reply(self, request: bytes) -> bytes:
        servo_id, instruction, parameters = request[2], request[4], request[5:-1]
        if servo_id in self.silent or servo_id not in self.tables:
            return b""
        table, error = self.tables[servo_id], self.errors.get(servo_id, 0)
        if instruction == 2:
            begin, size = parameters
            return encode_status(servo_id, error, bytes(table[begin : begin + size]))
        table[parameters[0] : parameters[0] + len(parameters) - 1] = parameters[1:]
        return encode_status(servo_id, error)

    def place(self, servo_id: int, register: ax12a.Register, value: int) -> None:
        self.tables[servo_id][register.address : register.address + register.size] = value.to_bytes(
            register.size, "little"
        )


@pytest.fixture
def arm() -> ArmConfig:
    return load_arm("ax12-line")


def scripted(*servo_ids: int) -> tuple[ScriptedPort, ServoBus]:
    """A line with these servos, and its bus, open."""
    port = ScriptedPort(servo_ids, VirtualClock())
    bus = ServoBus(port, servo_ids)
    bus.open()
    return port, bus


@pytest.fixture
def bus(arm: ArmConfig) -> ServoBus:
    return scripted(*arm.servo_ids)[1]


@pytest.fixture
def port(bus: ServoBus) -> ScriptedPort:
    assert isinstance(bus.port, ScriptedPort)
    return bus.port


def sample_next_tick(bus: ServoBus, port: ScriptedPort) -> Sample:
    port.virtual_clock.advance_ns(TICK_NS)
    return bus.read_sample()


def lost(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return []


def echo(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(-500, request)]


def short_reply(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, encode_status(good[2], 0, good[5:-2]))]


def long_reply(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, encode_status(good[2], 0, good[5:-1] + b"\x00"))]


def cut_reply(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, good[:-3])]


def wrong_id(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, encode_status(good[2] + 1, 0, good[5:-1]))]


def bad_checksum(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, good[:-1] + bytes((good[-1] ^ 1,)))]


def absurd_registers(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    data = bytearray(good[5:-1])
    data[37 - 24] = 0x40  # position 16384
    return [(0, encode_status(good[2], 0, bytes(data)))]


def far_position(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    data = bytearray(good[5:-1])
    data[36 - 24 : 38 - 24] = (900).to_bytes(2, "little")
    return [(0, encode_status(good[2], 0, bytes(data)))]


def late_reply(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(4_200, good)]


def burst(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, b"\x55" * 500)]


def babble(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, b"\x55" * 20_000)]


SPOILS = [
    (lost, NO_REPLY), (echo, BUS_NOISE), (short_reply, BUS_NOISE), (long_reply, BUS_NOISE), (cut_reply, BUS_NOISE),
    (wrong_id, BUS_NOISE), (bad_checksum, BUS_NOISE), (absurd_registers, BUS_NOISE), (burst, BUS_NOISE),
]  # fmt: skip


# ------------------------------------------------------------------------------------------------ read_sample


def test_sample_holds_bytes_24_to_49_of_every_servo_fresh(bus: ServoBus, port: ScriptedPort) -> None:
    before_ns = port.clock.now_ns()
    sample = bus.read_sample()
    assert sample.time_ns == before_ns
    assert sample.port_open
    assert sample.retries == 0
    for reading in sample.servos:
        assert reading.fresh
        assert reading.problem == ""
        assert reading.registers == bytes(port.tables[reading.servo_id][24:50])
        assert before_ns < reading.stamp_ns <= port.clock.now_ns()
    assert sample.bus_us == pytest.approx(6 * 900, abs=1)  # 8 + 32 bytes at 10 us, 500 us return delay
    assert port.requests == [encode_instruction(servo_id, Instruction.READ, READ_STATUS) for servo_id in bus.servo_ids]


@pytest.mark.parametrize(("spoil", "problem"), SPOILS)
def test_bad_reply_is_repeated_once_and_then_good(
    bus: ServoBus, port: ScriptedPort, spoil: Spoil, problem: str
) -> None:
    bus.read_sample()
    port.spoils[3] = [spoil]
    sample = sample_next_tick(bus, port)
    assert [reading.fresh for reading in sample.servos] == [True] * 6
    assert sample.retries == 1


@pytest.mark.parametrize(("spoil", "problem"), SPOILS)
def test_bad_reply_twice_is_a_stale_reading_that_says_so(
    bus: ServoBus, port: ScriptedPort, spoil: Spoil, problem: str
) -> None:
    first = bus.read_sample().servos[2]
    port.place(3, ax12a.PRESENT_TEMPERATURE, 60)
    port.spoils[3] = [spoil, spoil]
    sample = sample_next_tick(bus, port)
    assert sample.servos[2] == ServoReading(3, first.registers, first.stamp_ns, False, 0, problem)
    assert [reading.fresh for reading in sample.servos] == [True, True, False, True, True, True]
    assert not port.is_using
    after = sample_next_tick(bus, port).servos[2]
    assert after.fresh
    assert ax12a.register_value(ax12a.PRESENT_TEMPERATURE, after.registers) == 60


def test_servo_that_never_answered_has_no_registers_and_no_stamp(bus: ServoBus, port: ScriptedPort) -> None:
    port.silent = {4}
    assert bus.read_sample().servos[3] == ServoReading(4, b"", 0, False, 0, NO_REPLY)


def test_silent_servo_costs_at_most_10_ms(bus: ServoBus, port: ScriptedPort) -> None:
    whole_us = bus.read_sample().bus_us
    port.silent = {4}
    assert sample_next_tick(bus, port).bus_us - whole_us <= 10_000


def test_long_silent_servo_is_probed_every_fifth_sample_and_found_again(bus: ServoBus, port: ScriptedPort) -> None:
    port.silent = {4}
    for _ in range(SILENT_MISSES):
        sample_next_tick(bus, port)
    port.requests.clear()
    for _ in range(2 * PROBE_EVERY):
        assert sample_next_tick(bus, port).servos[3].problem == NO_REPLY
    assert port.requests.count(encode_instruction(4, Instruction.READ, READ_STATUS)) == 2
    port.silent = set()
    found = [sample_next_tick(bus, port).servos[3].fresh for _ in range(PROBE_EVERY + 1)]
    assert any(found)
    assert found == sorted(found)  # once back, in every sample


def test_wholly_silent_bus_leaves_more_than_half_of_the_tick(bus: ServoBus, port: ScriptedPort) -> None:
    port.silent = set(bus.servo_ids)
    costs_us = [sample_next_tick(bus, port).bus_us for _ in range(20)]
    assert max(costs_us) <= 40_000
    assert max(costs_us[SILENT_MISSES:]) <= 10_000


def test_wholly_babbling_bus_fits_the_tick(bus: ServoBus, port: ScriptedPort) -> None:
    port.spoils = {servo_id: [babble] * 99 for servo_id in bus.servo_ids}
    samples = [sample_next_tick(bus, port) for _ in range(5)]
    assert all(reading.problem == BUS_NOISE for sample in samples for reading in sample.servos)
    assert max(sample.bus_us for sample in samples) < 80_000


def test_late_reply_is_drained_and_never_taken_for_the_next_servos(bus: ServoBus, port: ScriptedPort) -> None:
    bus.read_sample()
    port.place(3, ax12a.PRESENT_POSITION, 5)
    port.spoils[3] = [late_reply]
    sample = sample_next_tick(bus, port)
    for reading in sample.servos:
        assert reading.fresh
        assert reading.registers == bytes(port.tables[reading.servo_id][24:50])


def test_motion_no_servo_can_make_is_noise(bus: ServoBus, port: ScriptedPort) -> None:
    bus.read_sample()
    port.spoils[3] = [far_position]
    sample = sample_next_tick(bus, port)
    assert sample.retries == 1
    assert ax12a.register_value(ax12a.PRESENT_POSITION, sample.servos[2].registers) == 0


def test_jump_seen_twice_in_a_row_is_reality(bus: ServoBus, port: ScriptedPort) -> None:
    bus.read_sample()
    port.place(3, ax12a.PRESENT_POSITION, 900)
    sample = sample_next_tick(bus, port)
    assert sample.retries == 1
    assert sample.servos[2].fresh
    assert ax12a.register_value(ax12a.PRESENT_POSITION, sample.servos[2].registers) == 900


def test_jump_without_retry_left_is_stale_now_and_believed_in_the_next_sample(
    bus: ServoBus, port: ScriptedPort
) -> None:
    bus.read_sample()
    port.place(3, ax12a.PRESENT_POSITION, 900)
    port.spoils = {1: [lost], 2: [lost]}
    reading = sample_next_tick(bus, port).servos[2]
    assert not reading.fresh
    assert reading.problem == BUS_NOISE
    assert sample_next_tick(bus, port).servos[2].fresh


@given(step=st.integers(0, 180), start=st.integers(0, 843))
@settings(deadline=None, max_examples=40)
def test_motion_within_servo_speed_is_never_doubted(step: int, start: int) -> None:
    port, bus = scripted(1)
    port.place(1, ax12a.PRESENT_POSITION, start)
    bus.read_sample()
    port.place(1, ax12a.PRESENT_POSITION, start + step)
    sample = sample_next_tick(bus, port)
    assert sample.servos[0].fresh
    assert sample.retries == 0


@given(replies=st.lists(st.binary(max_size=80), min_size=2, max_size=2))
@settings(deadline=None)
def test_any_bytes_for_a_reply_are_bounded_in_time_and_never_look_fresh(replies: list[bytes]) -> None:
    port, bus = scripted(1)
    port.spoils[1] = [lambda request, good, data=data: [(0, data)] for data in replies]  # type: ignore[misc]
    sample = bus.read_sample()
    assert not sample.servos[0].fresh  # a random valid packet of 26 bytes for id 1 is out of reach
    assert sample.bus_us <= 12_000
    assert not port.is_using
    assert bus.read_sample().servos[0].fresh


@given(noise=st.binary(max_size=20).filter(lambda data: b"\xff" not in data))
@settings(deadline=None)
def test_noise_before_a_good_reply_is_skipped(noise: bytes) -> None:
    port, bus = scripted(1)
    port.spoils[1] = [lambda request, good: [(-300, noise), (0, good)]]
    assert bus.read_sample().servos[0].registers == bytes(port.tables[1][24:50])


def test_error_byte_is_kept_and_every_bit_named(
    bus: ServoBus, port: ScriptedPort, caplog: pytest.LogCaptureFixture
) -> None:
    port.errors[2] = ax12a.ErrorBit.OVERHEAT | ax12a.ErrorBit.OVERLOAD
    with caplog.at_level(logging.WARNING):
        reading = bus.read_sample().servos[1]
        sample_next_tick(bus, port)
    assert reading.fresh
    assert reading.error == 0x24
    assert [record.getMessage() for record in caplog.records] == ["servo 2: error bits are now: OVERHEAT, OVERLOAD"]


# -------------------------------------------------------------------------------------------------- port gone


@pytest.mark.parametrize("requests", range(7))
def test_port_that_vanishes_within_a_sample_is_data(bus: ServoBus, port: ScriptedPort, requests: int) -> None:
    before = bus.read_sample()
    port.gone_after = requests
    sample = sample_next_tick(bus, port)
    if requests == 6:  # it vanished only after the last answer was in
        sample = sample_next_tick(bus, port)
    assert not sample.port_open
    assert not bus.is_open
    assert not port.is_using
    assert [(reading.fresh, reading.problem) for reading in sample.servos] == [(False, PORT_GONE)] * 6
    assert all(new.stamp_ns >= old.stamp_ns > 0 for new, old in zip(sample.servos, before.servos, strict=True))


def test_port_that_vanishes_while_draining_closes_the_bus(bus: ServoBus, port: ScriptedPort) -> None:
    bus.read_sample()
    port.spoils[1] = [absurd_registers]
    drain = port.drain

    def gone(quiet_ms: float = 0.5) -> int:
        port.gone_after = 0
        return drain(quiet_ms)

    port.drain = gone  # type: ignore[method-assign]
    assert not sample_next_tick(bus, port).port_open
    assert not bus.is_open


def test_closed_bus_answers_everything_with_data(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    bus.close()
    assert not bus.read_sample().port_open
    assert not bus.write_goal(Goal((512,) * 6, (50,) * 6))
    assert not bus.write(Write(1, 24, 1, 1))
    assert bus.read(1, ax12a.MODEL) is None
    assert [problem.code for problem in bus.identify(arm.joints)] == [PORT_GONE]
    assert port.requests == []


def test_reopened_bus_reads_again(bus: ServoBus, port: ScriptedPort) -> None:
    bus.read_sample()
    port.gone_after = 0
    bus.read_sample()
    bus.close()
    bus.open()
    sample = sample_next_tick(bus, port)
    assert sample.port_open
    assert all(reading.fresh for reading in sample.servos)


def test_every_way_the_port_can_vanish_leaves_is_using_false(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    calls: list[Callable[[], object]] = [
        bus.read_sample,
        lambda: bus.write_goal(Goal((512,) * 6, (50,) * 6)),
        lambda: bus.write(Write(1, 24, 1, 1)),
        lambda: bus.read(1, ax12a.GOAL),
        lambda: bus.identify(arm.joints),
    ]
    for call in calls:
        bus.open()
        port.gone_after = 0
        call()
        assert not port.is_using
        assert not bus.is_open


def test_unexpected_error_in_the_transport_leaves_is_using_false(bus: ServoBus, port: ScriptedPort) -> None:
    def broken(length: int) -> None:
        raise RuntimeError("broken")

    fill, port._fill = port._fill, broken  # type: ignore[method-assign]
    with pytest.raises(RuntimeError):
        bus.read_sample()
    assert not port.is_using
    port._fill = fill  # type: ignore[method-assign]
    assert bus.read_sample().servos[0].fresh


def test_line_that_takes_no_bytes_is_no_reply(bus: ServoBus, port: ScriptedPort) -> None:
    port.stuck = True
    assert {reading.problem for reading in bus.read_sample().servos} == {NO_REPLY}
    assert not bus.write_goal(Goal((512,) * 6, (50,) * 6))
    assert bus.is_open


# ------------------------------------------------------------------------------------------------------ writing


def test_goal_is_one_sync_write_of_four_bytes_at_address_30(bus: ServoBus, port: ScriptedPort) -> None:
    assert bus.write_goal(Goal((0, 1, 256, 512, 1022, 1023), (1, 2, 3, 300, 1023, 0)))
    assert len(port.requests) == 1
    body = port.requests[0][2:-1]
    assert list(body) == [
        254, 34, 0x83, 30, 4,
        1, 0, 0, 1, 0,
        2, 1, 0, 2, 0,
        3, 0, 1, 3, 0,
        4, 0, 2, 44, 1,
        5, 254, 3, 255, 3,
        6, 255, 3, 0, 0,
    ]  # fmt: skip
    assert port.requests[0][-1] == ~sum(body) & 0xFF


@pytest.mark.parametrize("bad", [-1, 1024, 70_000, 512.0, None])
@pytest.mark.parametrize("where", ["ticks", "speeds"])
def test_goal_that_is_no_whole_tick_is_refused_before_the_wire(
    bus: ServoBus, port: ScriptedPort, bad: int, where: str
) -> None:
    spoiled, fine = (512, 512, bad, 512, 512, 512), (512,) * 6
    goal = Goal(spoiled, fine) if where == "ticks" else Goal(fine, spoiled)
    with pytest.raises(ValueError, match=r"servo 3: .* no whole number in 0\.\.1023"):
        bus.write_goal(goal)
    assert port.requests == []


def test_goal_of_another_arm_is_refused(bus: ServoBus) -> None:
    with pytest.raises(ValueError, match="5 values of moving speed for 6 servos"):
        bus.write_goal(Goal((512,) * 6, (50,) * 5))


def test_write_is_confirmed_and_read_back(bus: ServoBus, port: ScriptedPort) -> None:
    assert bus.write(Write(2, ax12a.TORQUE_LIMIT.address, 2, 300))
    assert bus.read(2, ax12a.TORQUE_LIMIT) == 300
    assert bus.read(2, ax12a.MODEL) == 12


@given(register=st.sampled_from([register for register in ax12a.REGISTERS if register.writable]), data=st.data())
@settings(deadline=None)
def test_read_returns_what_write_wrote_for_every_register(register: ax12a.Register, data: st.DataObject) -> None:
    _, bus = scripted(1)
    value = data.draw(st.integers(register.minimum, register.maximum))
    assert bus.write(Write(1, register.address, register.size, value))
    assert bus.read(1, register) == value


def test_write_is_repeated_once(bus: ServoBus, port: ScriptedPort) -> None:
    port.spoils[2] = [lost]
    assert bus.write(Write(2, 24, 1, 1))
    port.spoils[2] = [lost, lost]
    assert not bus.write(Write(2, 24, 1, 1))
    assert bus.is_open


def test_refused_write_is_no_good_reply_but_a_hot_servo_still_obeys(
    bus: ServoBus, port: ScriptedPort, caplog: pytest.LogCaptureFixture
) -> None:
    port.errors[2] = int(ax12a.ErrorBit.RANGE)
    assert not bus.write(Write(2, 24, 1, 1))
    assert "servo 2 refused 1 at address 24: RANGE" in caplog.text
    port.errors[2] = int(ax12a.ErrorBit.OVERHEAT)
    assert bus.write(Write(2, 24, 1, 1))


@pytest.mark.parametrize(
    "write", [Write(1, 30, 2, 70_000), Write(1, 24, 1, -1), Write(1, 24, 3, 1), Write(254, 24, 1, 1)]
)
def test_write_that_does_not_fit_is_refused_before_the_wire(bus: ServoBus, port: ScriptedPort, write: Write) -> None:
    with pytest.raises(ValueError, match=r"does not fit|is not in"):
        bus.write(write)
    assert port.requests == []


def test_echoing_adapter_never_looks_like_a_servo(bus: ServoBus, port: ScriptedPort) -> None:
    for register in ax12a.REGISTERS:
        port.spoils[1] = [echo, echo]
        assert bus.read(1, register) is None
    port.spoils[1] = [echo, echo]
    assert not bus.write(Write(1, 24, 1, 1))


def test_silent_servo_reads_as_none(bus: ServoBus, port: ScriptedPort) -> None:
    assert bus.read(77, ax12a.MODEL) is None


# --------------------------------------------------------------------------------------------------- identify


def test_fit_arm_has_no_problems(bus: ServoBus, arm: ArmConfig) -> None:
    assert bus.identify(arm.joints) == ()


def test_missing_servo_is_named_with_its_joint(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.silent = {3}
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("SERVO_SILENT", 3)
    assert problem.text.startswith("servo 3 (elbow): no reply; check")


def test_silent_bus_is_one_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.silent = set(arm.servo_ids)
    (problem,) = bus.identify(arm.joints)
    assert problem.code == "BUS_DEAD"
    assert "not a byte came" in problem.text
    for cause in ("supply", "1000000 baud", "cable"):
        assert cause in problem.text
    whole_us = bus.read_sample().bus_us
    assert whole_us <= 40_000  # the generous timeout of identify is over


def test_bus_of_garbage_is_one_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils = {servo_id: [echo] * 9 for servo_id in arm.servo_ids}
    (problem,) = bus.identify(arm.joints)
    assert problem.code == "BUS_DEAD"
    assert "only garbled bytes" in problem.text


def test_other_model_is_named_and_its_table_not_judged(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.place(2, ax12a.MODEL, 18)
    port.place(2, ax12a.CCW_LIMIT, 1)
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("WRONG_MODEL", 2)
    assert "model number 18, wanted 12" in problem.text


@pytest.mark.parametrize(
    ("register", "value", "text"),
    [
        (ax12a.CW_LIMIT, 100, "cw_angle_limit is 100, wanted at most 18"),
        (ax12a.CCW_LIMIT, 1000, "ccw_angle_limit is 1000, wanted at least 1006"),
        (ax12a.CCW_LIMIT, 0, "wheel mode"),
        (ax12a.RETURN_LEVEL, 1, "status_return_level is 1, wanted 2"),
    ],
)
def test_eeprom_that_forbids_motion_is_shown(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, register: ax12a.Register, value: int, text: str
) -> None:
    port.place(3, register, value)
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("EEPROM_MISMATCH", 3)
    assert problem.text.startswith("servo 3 (elbow): ")
    assert text in problem.text


def test_other_eeprom_values_are_no_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.place(3, ax12a.RETURN_DELAY, 0)
    port.place(3, ax12a.MAX_TORQUE, 500)
    port.place(3, ax12a.CW_LIMIT, 18)
    assert bus.identify(arm.joints) == ()


def test_second_reply_hints_at_two_servos_with_one_id(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils[3] = [lambda request, good: [(0, good)]] + [lambda request, good: [(0, good), (400, good)]] * 6
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("DUPLICATE_ID", 3)
    assert "two servos with this id" in problem.text


def test_colliding_replies_hint_at_two_servos_with_one_id(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils[3] = [bad_checksum] * 20
    (problem,) = bus.identify(arm.joints)
    assert (problem.code, problem.servo_id) == ("DUPLICATE_ID", 3)


def late(delay_ms: float) -> Spoil:
    return lambda request, good: [(round(1000 * delay_ms), good)]


@pytest.mark.parametrize("spoiled", [1, 2, 3, 4])
@pytest.mark.parametrize("spoil", [lost, bad_checksum, late(22.0), late(30.0), late(45.0)])
def test_a_servo_that_is_misheard_for_a_moment_is_fit(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, spoil: Spoil, spoiled: int
) -> None:
    port.spoils[3] = [spoil] * spoiled
    assert bus.identify(arm.joints) == ()
    assert all(reading.fresh for reading in bus.read_sample().servos)


@pytest.mark.parametrize("delay_ms", [22.0, 30.0, 45.0, 70.0])
def test_replies_that_come_late_for_a_moment_are_no_second_servo(
    bus: ServoBus, port: ScriptedPort, arm: ArmConfig, delay_ms: float
) -> None:
    port.spoils[3] = [lambda request, good: [(0, good)]] + [late(delay_ms)] * 4
    assert bus.identify(arm.joints) == ()


def test_an_adapter_that_is_slow_now_and_then_is_fit(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.spoils = {servo_id: [late(12.0)] for servo_id in arm.servo_ids[1:]}
    port.spoils[arm.servo_ids[0]] = [late(12.0), lambda request, good: [(0, good)]] * 2
    assert bus.identify(arm.joints) == ()
    assert port._latency_ms <= 8.0


def test_slow_adapter_is_told_from_a_dead_bus_and_still_read(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.adapter_us = 16_000
    (problem,) = bus.identify(arm.joints)
    assert problem.code == "SLOW_ADAPTER"
    assert "adds 16.0 ms" in problem.text
    assert "latency_timer" in problem.text
    assert all(reading.fresh for reading in bus.read_sample().servos)


def test_usual_adapter_latency_is_no_problem(bus: ServoBus, port: ScriptedPort, arm: ArmConfig) -> None:
    port.adapter_us = 2_000
    assert bus.identify(arm.joints) == ()
    assert all(reading.fresh for reading in bus.read_sample().servos)


def test_block_of_a_servo_tells_its_bytes_its_error_bits_and_its_time(bus: ServoBus, port: ScriptedPort) -> None:
    port.errors[2] = ax12a.ErrorBit.OVERLOAD
    reply = bus.read_block(2, 0, ax12a.EEPROM_END)
    assert (reply.data, reply.error, reply.problem) == (bytes(port.tables[2][:24]), ax12a.ErrorBit.OVERLOAD, "")
    assert reply.elapsed_ns == (8 + 30) * BYTE_NS + 500_000
    assert bus.read_block(77, 0, 3).problem == NO_REPLY
    with pytest.raises(ValueError, match="two bytes"):
        bus.read_block(2, 0, 2)


def test_colliding_replies_answer_twice_and_others_do_not(bus: ServoBus, port: ScriptedPort) -> None:
    port.spoils[3] = [bad_checksum] * 6
    assert bus.answers_twice(3)
    assert not bus.answers_twice(2)
    assert not bus.answers_twice(77)


def test_block_of_a_vanished_port_is_data(bus: ServoBus, port: ScriptedPort) -> None:
    port.gone_after = 0
    assert bus.read_block(1, 0, 3).problem == PORT_GONE
    assert not bus.is_open
    assert not bus.answers_twice(1)


# ------------------------------------------------------------------------------- throwing away what is not asked for


def test_clean_cycle_throws_away_once(bus: ServoBus, port: ScriptedPort) -> None:
    sample_next_tick(bus, port)
    port.flushes = 0
    sample_next_tick(bus, port)
    assert port.flushes == 1
    assert bus.write_goal(Goal((512,) * 6, (50,) * 6))
    assert port.flushes == 1
    assert bus.write(Write(1, ax12a.LED.address, 1, 1))
    assert bus.write(Write(1, ax12a.LED.address, 1, 0))
    assert port.flushes == 3


@pytest.mark.parametrize("delay_us", [0, 300, 500, 850, 1300])
def test_reply_that_comes_twice_is_believed_of_nobody_else(bus: ServoBus, port: ScriptedPort, delay_us: int) -> None:
    for servo_id in bus.servo_ids:
        port.place(servo_id, ax12a.PRESENT_POSITION, 100 * servo_id)
    sample_next_tick(bus, port)
    for servo_id in bus.servo_ids:
        port.spoils[servo_id] = [lambda _, good: [(0, good), (delay_us, good)]]
    for _ in range(3):
        for reading in sample_next_tick(bus, port).servos:
            assert ax12a.register_value(ax12a.PRESENT_POSITION, reading.registers) == 100 * reading.servo_id


def test_what_comes_between_two_samples_is_thrown_away(bus: ServoBus, port: ScriptedPort) -> None:
    sample_next_tick(bus, port)
    old = encode_status(1, 0, bytes(port.tables[1][24:50]))
    port.spoils[6] = [lambda _, good: [(0, good), (20_000, old)]]
    sample_next_tick(bus, port)
    port.place(1, ax12a.PRESENT_POSITION, 3)
    sample = sample_next_tick(bus, port)
    assert sample.retries == 0
    assert ax12a.register_value(ax12a.PRESENT_POSITION, sample.servos[0].registers) == 3
