"""A scripted transport that answers real protocol bytes in virtual time, the bus over it, and ways to spoil a reply."""

from collections.abc import Callable, Sequence

import pytest

from armctl.clock import VirtualClock
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.fitness import ServoJoint
from armctl.dynamixel.identify import Identification
from armctl.dynamixel.packet import encode_status
from armctl.dynamixel.port import ServoPort
from armctl.errors import PortGone
from armctl.files import load_arm
from armctl.messages import Problem, Sample

ARM = load_arm("ax12-line")
BYTE_NS = 10_000
TICK_NS = 100_000_000

# (request, good reply) -> what arrives instead: pairs of extra delay [us] and bytes.
Spoil = Callable[[bytes, bytes], list[tuple[int, bytes]]]


def servo_table(servo_id: int) -> bytearray:
    table = bytearray(ax12a.TABLE_SIZE)
    for register in ax12a.REGISTERS:
        table[register.address : register.address + register.size] = register.default.to_bytes(register.size, "little")
    table[ax12a.ID.address] = servo_id
    return table


class Line(ServoPort):
    """Answers with the same bytes whatever it is asked, one right behind the other, and notes what it was asked."""

    def __init__(self, answer: bytes = b"", baud: int = 1_000_000, clock: VirtualClock | None = None) -> None:
        self.virtual_clock = clock or VirtualClock()
        super().__init__("line", baud, self.virtual_clock)
        self.left, self.sent = answer, b""

    def openPort(self) -> bool:
        return True

    def closePort(self) -> None:
        pass

    def getBytesAvailable(self) -> int:
        return len(self._received)

    def _discard(self) -> None:
        pass

    def _send(self, packet: bytes) -> int:
        self.sent = packet
        return len(packet)

    def _fill(self, length: int) -> None:
        missing = length - len(self._received)
        in_time = max(0, (self._deadline_ns - self.clock.now_ns()) // self.byte_ns)
        arrived, self.left = self.left[: min(missing, in_time)], self.left[min(missing, in_time) :]
        self._received += arrived
        whole_ns = self.clock.now_ns() + len(arrived) * self.byte_ns
        self.clock.sleep_until_ns(whole_ns if len(arrived) == missing else self._deadline_ns)


class ScriptedPort(ServoPort):
    """A half-duplex line in virtual time with one register table a servo; `spoils` queues damage per servo."""

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
        # The bytes under way to the host, each with its instant.
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
        self.check(self.gone_after == 0)
        missing = length - len(self._received)
        due_ns = self._line[missing - 1][0] if len(self._line) >= missing else self._deadline_ns
        self.clock.sleep_until_ns(min(due_ns, self._deadline_ns))
        ready = [item for item in self._line[:missing] if item[0] <= self.clock.now_ns()]
        self._line = self._line[len(ready) :]
        self._received += bytes(byte for _, byte in ready)

    def _send(self, packet: bytes) -> int:
        if self.gone_after is not None:
            self.gone_after -= 1
            self.check(self.gone_after < 0)
        if self.stuck:
            return 0
        self.requests.append(packet)
        good = self._reply(packet)
        queue = self.spoils.get(packet[2])
        at_ns = self.clock.now_ns() + len(packet) * BYTE_NS + 500_000 + self.adapter_us * 1000
        for delay_us, data in queue.pop(0)(packet, good) if queue else [(0, good)]:
            self._line += [(at_ns + delay_us * 1000 + index * BYTE_NS, byte) for index, byte in enumerate(data, 1)]
        self._line.sort(key=lambda item: item[0])
        return len(packet)

    def check(self, gone: bool) -> None:
        if gone:
            raise PortGone("scripted: the port vanished; plug the adapter in again")

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
        end = register.address + register.size
        self.tables[servo_id][register.address : end] = value.to_bytes(register.size, "little")


class ScriptedBus(ServoBus):
    """Over a line with these servos, open."""

    port: ScriptedPort

    def __init__(self, *servo_ids: int) -> None:
        super().__init__(ScriptedPort(servo_ids, VirtualClock()), servo_ids)
        self.open()

    def identify(self, joints: Sequence[ServoJoint]) -> tuple[Problem, ...]:
        """What identifying them at one go finds unfit."""
        return Identification(self, joints, ARM.arm_id).advance() or ()

    def next_sample(self) -> Sample:
        """That of the next tick."""
        self.port.virtual_clock.advance_ns(TICK_NS)
        return self.read_sample()


@pytest.fixture
def bus() -> ScriptedBus:
    """Of servos whose angle limits are those of the arm."""
    bus = ScriptedBus(*ARM.servo_ids)
    for joint in ARM.joints:
        for register, limit in zip((ax12a.CW_LIMIT, ax12a.CCW_LIMIT), joint.limits_tick, strict=True):
            bus.port.place(joint.servo_id, register, limit)
    return bus


def tick_of(sample: Sample, servo_id: int) -> int:
    """The position that a sample has of a servo."""
    return ax12a.register_value(ax12a.PRESENT_POSITION, sample.servos[servo_id - 1].registers)


# --------------------------------------------------------------------------------------- ways to spoil a reply


def good_after(*delays_us: int) -> Spoil:
    """The good reply, once for each delay."""
    return lambda request, good: [(delay_us, good) for delay_us in delays_us]


FINE, LOST = good_after(0), good_after()


def echo(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(-500, request)]


def bad_checksum(request: bytes, good: bytes) -> list[tuple[int, bytes]]:
    return [(0, good[:-1] + bytes((good[-1] ^ 1,)))]


def these(data: bytes) -> Spoil:
    """Other bytes in its stead."""
    return lambda request, good: [(0, data)]


def at(position_tick: int) -> Spoil:
    """The status of a servo that claims to be there."""
    begin, end = 5 + ax12a.POSITION_AT, 7 + ax12a.POSITION_AT
    place = position_tick.to_bytes(2, "little")
    return lambda request, good: [(0, encode_status(good[2], 0, good[5:begin] + place + good[end:-1]))]


# Every reply that is none.
SPOILS: dict[str, Spoil] = {
    "lost": LOST,
    "echo": echo,
    "too short": lambda request, good: [(0, encode_status(good[2], 0, good[5:-2]))],
    "too long": lambda request, good: [(0, encode_status(good[2], 0, good[5:-1] + b"\x00"))],
    "cut": lambda request, good: [(0, good[:-3])],
    "wrong id": lambda request, good: [(0, encode_status(good[2] + 1, 0, good[5:-1]))],
    "bad checksum": bad_checksum,
    "absurd registers": at(16384),
    "burst": these(b"\x55" * 500),
}
