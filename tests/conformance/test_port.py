"""The contract of `armctl/dynamixel/port.py`, rule by rule, the same for every transport that the bus may be given."""

import contextlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest

from armctl.clock import MonotonicClock, VirtualClock
from armctl.dynamixel.packet import Instruction, encode_instruction, encode_status
from armctl.dynamixel.port import HEARD_MAX, WIRE_PIECES, ServoPort
from armctl.dynamixel.serial_port import SerialPort
from armctl.errors import PortBusy, PortGone, PortMissing
from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.control import SimulatorClient, control_path
from armctl.sim.loopback import LoopbackPort
from tests.conformance.conftest import BAUD, simulator

PING, PONG = encode_instruction(1, Instruction.PING), encode_status(1, 0)
LONG_READ, LONG_REPLY_SIZE = encode_instruction(1, Instruction.READ, bytes((0, 50))), 56
# How long a machine that runs other tests may hold back a reply that is sure to come.
PATIENCE_MS = 2000.0


@dataclass
class Line:
    """A line to servos with one port, which is open, and a hand on the adapter's plug."""

    port: ServoPort
    # Makes a second port on the same line, not yet open.
    another: Callable[[], ServoPort]
    unplug: Callable[[], object]
    replug: Callable[[], object]

    def wait(self, duration_ms: float) -> None:
        self.port.clock.sleep_until_ns(self.port.clock.now_ns() + round(1e6 * duration_ms))

    def ask(self, *packets: bytes, size: int) -> None:
        """Send packets, and wait until so many bytes of reply have arrived, unread."""
        for packet in packets:
            assert self.port.writePort(list(packet)) == len(packet)
        give_up_ns = self.port.clock.now_ns() + round(1e6 * PATIENCE_MS)
        while self.port.getBytesAvailable() < size and self.port.clock.now_ns() < give_up_ns:
            self.wait(1.0)


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("sim") / "port"
    with simulator(path):
        yield path


@pytest.fixture(params=["loopback", pytest.param("pty", marks=pytest.mark.pty)])
def line(request: pytest.FixtureRequest) -> Iterator[Line]:
    with contextlib.ExitStack() as cleanup:
        if request.param == "loopback":
            clock, bus = VirtualClock(), SimulatedBus(SimulatedArm(load_arm("ax12-line"), seed=1))
            port = LoopbackPort(bus, clock)
            found = Line(port, lambda: LoopbackPort(bus, clock), port.unplug, port.replug)
        else:
            path: Path = request.getfixturevalue("link")
            hand = cleanup.enter_context(SimulatorClient(control_path(path)))
            cleanup.callback(hand.replug)
            serial = SerialPort(str(path), BAUD, MonotonicClock())
            found = Line(serial, lambda: SerialPort(str(path), BAUD, MonotonicClock()), hand.unplug, hand.replug)
        found.port.openPort()
        cleanup.callback(found.port.closePort)
        yield found


# --------------------------------------------------------------------------------------------- rule 1: one user


def test_a_second_port_on_the_line_is_refused_until_the_first_is_closed(line: Line) -> None:
    second = line.another()
    with pytest.raises(PortBusy, match=r"one program at a time can drive (the bus|it)"):
        second.openPort()
    assert not second.is_open
    line.port.closePort()
    assert second.openPort()
    second.closePort()
    second.closePort()


def test_opening_an_open_port_opens_it_anew(line: Line) -> None:
    line.ask(PING, size=len(PONG))
    assert line.port.openPort()
    assert line.port.setBaudRate(BAUD)
    assert line.port.is_open
    line.ask(PING, size=len(PONG))
    assert line.port.readPort(2 * len(PONG))[-len(PONG) :] == PONG


# ---------------------------------------------------------------------------------- rules 2 to 4: time and bytes


def test_a_silent_line_is_waited_for_until_the_deadline_on_the_ports_clock(line: Line) -> None:
    begin_ns = line.port.clock.now_ns()
    line.port.setPacketTimeoutMillis(20.0)
    assert not line.port.isPacketTimeout()
    assert line.port.readPort(6) == b""
    assert line.port.clock.now_ns() >= begin_ns + 20_000_000
    assert line.port.isPacketTimeout()


def test_a_read_ends_with_the_bytes_asked_for_and_leaves_the_rest(line: Line) -> None:
    begin_ns = line.port.clock.now_ns()
    line.port.writePort(list(PING))
    line.port.setPacketTimeoutMillis(PATIENCE_MS)
    assert line.port.peek(4) == PONG[:4]
    assert line.port.readPort(4) == PONG[:4]
    assert line.port.readPort(2) == PONG[4:]
    assert line.port.heard == len(PONG)
    assert line.port.clock.now_ns() < begin_ns + round(1e6 * PATIENCE_MS)


def test_a_read_of_too_many_bytes_returns_those_that_came_by_the_deadline(line: Line) -> None:
    line.port.writePort(list(PING))
    line.port.setPacketTimeoutMillis(100.0)
    assert line.port.readPort(50) == PONG
    assert line.port.readPort(0) == b""


def test_bytes_that_arrived_count_after_the_deadline(line: Line) -> None:
    line.ask(PING, size=len(PONG))
    line.port.setPacketTimeoutMillis(0.0)
    line.wait(5.0)
    assert line.port.readPort(6) == PONG


def test_one_packet_hears_a_bounded_number_of_bytes(line: Line) -> None:
    line.ask(*[LONG_READ] * 8, size=8 * LONG_REPLY_SIZE)
    line.port.setPacketTimeoutMillis(PATIENCE_MS)
    while line.port.readPort(50):
        pass
    assert HEARD_MAX <= line.port.heard < HEARD_MAX + 50
    assert line.port.isPacketTimeout()


# ----------------------------------------------------------------------------------------------- rule 5: latency


def test_a_reply_is_waited_for_as_long_as_it_can_take_with_the_adapters_latency(line: Line) -> None:
    waited_ns = []
    for latency_ms in (2.0, 30.0):
        line.port.allow_latency(latency_ms)
        line.port.drain()
        begin_ns = line.port.clock.now_ns()
        line.port.setPacketTimeout(6)
        assert line.port.readPort(6) == b""
        waited_ns.append(line.port.clock.now_ns() - begin_ns)
    assert waited_ns[0] >= 4_000_000
    assert waited_ns[1] >= 32_000_000


# --------------------------------------------------------------------------------- rules 6 and 7: throwing away


def test_cleared_bytes_are_never_read(line: Line) -> None:
    line.ask(PING, size=len(PONG))
    line.port.clearPort()
    assert line.port.getBytesAvailable() == 0
    line.port.setPacketTimeoutMillis(5.0)
    assert line.port.readPort(1) == b""


def test_what_comes_between_two_rounds_is_thrown_away(line: Line) -> None:
    line.port.begin_round()
    line.port.writePort(list(PING))
    line.port.setPacketTimeout(6)
    line.ask(size=len(PONG))
    assert line.port.readPort(6) == PONG
    line.ask(PING, size=len(PONG))
    line.port.begin_round()
    line.port.clearPort()
    assert line.port.getBytesAvailable() == 0


def test_bytes_beyond_the_reply_that_was_due_are_thrown_away_within_a_round_too(line: Line) -> None:
    line.port.begin_round()
    line.ask(PING, PING, size=2 * len(PONG))
    line.port.setPacketTimeout(6)
    assert line.port.readPort(8) == PONG + PONG[:2]
    line.port.clearPort()
    assert line.port.getBytesAvailable() == 0


def test_draining_tells_how_much_it_threw_away_and_leaves_the_line_silent(line: Line) -> None:
    line.ask(PING, PING, size=2 * len(PONG))
    assert line.port.drain() == 2 * len(PONG)
    assert line.port.drain() == 0


def test_draining_does_not_stop_before_the_reply_that_is_due(line: Line) -> None:
    line.port.allow_latency(100.0)
    line.port.writePort(list(PING))
    line.port.setPacketTimeout(6)
    assert line.port.drain(quiet_ms=0.0) == len(PONG)


# ---------------------------------------------------------------------------------------- rule 9: a lost port


def every_use(port: ServoPort) -> list[Callable[[], object]]:
    return [lambda: port.readPort(6), lambda: port.writePort(list(PING)), port.clearPort, port.getBytesAvailable]


def test_every_use_of_a_port_that_is_not_open_is_port_gone(line: Line) -> None:
    line.port.closePort()
    line.port.closePort()
    for port in (line.port, line.another()):
        for use in every_use(port):
            with pytest.raises(PortGone, match=r"open it first|plug the adapter in again"):
                use()


def test_every_use_of_an_unplugged_port_is_port_gone_until_it_is_opened_again(line: Line) -> None:
    line.unplug()
    line.port.setPacketTimeoutMillis(PATIENCE_MS)
    for use in every_use(line.port):
        with pytest.raises(PortGone, match=r"vanished.*plug the adapter in again"):
            use()
    line.port.closePort()
    with pytest.raises(PortMissing):
        line.port.openPort()
    line.replug()
    with pytest.raises(PortGone):
        line.port.readPort(1)
    assert line.port.openPort()
    line.ask(PING, size=len(PONG))
    assert line.port.readPort(6) == PONG


# ------------------------------------------------------------------------------------------- rule 10: the wire


def test_the_wire_is_told_once_as_it_was_sent_and_read(line: Line) -> None:
    line.port.clearPort()
    line.port.take_wire()
    begin_ns = line.port.clock.now_ns()
    line.port.ask(PING, len(PONG))
    line.port.begin_round()
    line.port.ask(LONG_READ, LONG_REPLY_SIZE)
    wire = line.port.take_wire()
    times_ns, sent, data = zip(*wire, strict=True)
    assert list(times_ns) == sorted(times_ns)
    assert begin_ns <= times_ns[0] <= times_ns[-1] <= line.port.clock.now_ns()
    assert b"".join(one for one, out in zip(data, sent, strict=True) if out) == PING + LONG_READ
    answered = b"".join(one for one, out in zip(data, sent, strict=True) if not out)
    assert answered[: len(PONG)] == PONG
    assert len(answered) == len(PONG) + LONG_REPLY_SIZE
    assert line.port.take_wire() == ()


def test_what_was_read_and_thrown_away_is_told_too(line: Line) -> None:
    line.ask(PING, size=len(PONG))
    line.port.setPacketTimeoutMillis(PATIENCE_MS)
    assert line.port.peek(len(PONG)) == PONG
    line.port.take_wire()
    line.port.clearPort()
    assert [(sent, data) for _, sent, data in line.port.take_wire()] == [(False, PONG)]


def test_the_wire_that_nobody_takes_keeps_its_newest_pieces(line: Line) -> None:
    for _ in range(WIRE_PIECES // 2 + 5):
        line.port.ask(PING, len(PONG))
    wire = line.port.take_wire()
    assert len(wire) == WIRE_PIECES
    assert wire[-1][2] == PONG
