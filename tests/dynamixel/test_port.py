"""The timing every ServoPort shares, its short cut past the SDK's loops, and ports that do not open."""

import errno
import grp
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from unittest.mock import Mock

import pytest
import serial
from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.clock import MonotonicClock, VirtualClock
from armctl.dynamixel import port as module
from armctl.dynamixel.packet import OVERHEAD_BYTES, Instruction, encode_instruction, encode_status
from armctl.dynamixel.port import ServoPort
from armctl.dynamixel.serial_port import SerialPort
from armctl.errors import PortMissing
from tests.dynamixel.conftest import Line

BAUD = 1_000_000
READ = encode_instruction(1, Instruction.READ, bytes((24, 26)))


# ----------------------------------------------------------------------------------------------------- timing


def is_over(line: Line, *after_ns: int) -> Iterator[bool]:
    """Whether the time for a reply is over so much later, and so much later still."""
    for ns in after_ns:
        line.virtual_clock.advance_ns(ns)
        yield line.isPacketTimeout()


def test_status_read_is_waited_for_about_5_ms() -> None:
    line = Line()
    line.writePort([0] * 8)
    line.setPacketTimeout(32)
    assert [*is_over(line, 4_400_000, 100_000, 0)] == [False, True, True]


@given(
    baud=st.sampled_from([9_600, 57_600, 115_200, 1_000_000]),
    request=st.integers(6, 200),
    reply=st.integers(6, 200),
    delay_us=st.floats(0, 508),
    latency_ms=st.floats(0, 20),
)
def test_timeout_covers_wire_return_delay_and_adapter(
    baud: int, request: int, reply: int, delay_us: float, latency_ms: float
) -> None:
    line = Line(baud=baud)
    line.allow_latency(latency_ms)
    line.writePort([0] * request)
    line.setPacketTimeout(reply)
    needed_ns = round((request + reply) * 1e10 / baud + delay_us * 1e3 + latency_ms * 1e6)
    assert [*is_over(line, needed_ns, 2_600_000)] == [False, True]


def test_timeout_in_milliseconds_is_exact_and_by_the_clock() -> None:
    line = Line(clock=VirtualClock(start_ns=10**15 + 7))
    assert line.getCurrentTime() == pytest.approx(1e9)
    line.setPacketTimeoutMillis(3)
    assert [*is_over(line, 2_999_999, 1)] == [False, True]


def test_transport_that_misses_part_of_the_contract_is_no_port() -> None:
    with pytest.raises(TypeError, match="abstract method"):
        ServoPort("line", BAUD, VirtualClock())


# ---------------------------------------------------------------------------------------------------- opening


def test_missing_path_lists_what_is_there_and_what_to_do(tmp_path: Path) -> None:
    path = str(tmp_path / "ttyUSB9")
    with pytest.raises(PortMissing, match=rf"{path}: no such port; found: .*; plug the adapter in"):
        SerialPort(path, BAUD, MonotonicClock()).openPort()


def test_file_that_is_no_tty_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_text("")
    port = SerialPort(str(path), BAUD, MonotonicClock())
    with pytest.raises(PortMissing, match="no usable serial port"):
        port.openPort()
    assert not port.is_open


def test_no_permission_names_the_group(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    path = tmp_path / "tty"
    path.write_text("")
    os.chown(path, -1, os.getgid())
    monkeypatch.setattr(serial, "Serial", Mock(side_effect=serial.SerialException(errno.EACCES, "could not open port")))
    with pytest.raises(PortMissing, match=r"no permission; it belongs to group (\S+): sudo usermod -aG \1 "):
        SerialPort(str(path), BAUD, MonotonicClock()).openPort()
    monkeypatch.setattr(grp, "getgrgid", {}.__getitem__)
    with pytest.raises(PortMissing, match=f"group {os.getgid()}:"):
        SerialPort(str(path), BAUD, MonotonicClock()).openPort()


def test_baud_rate_the_adapter_refuses_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "Serial", Mock(side_effect=ValueError("Failed to set custom baud rate (12345)")))
    with pytest.raises(PortMissing, match="cannot do 12345 baud"):
        SerialPort("/dev/null", 12_345, MonotonicClock()).openPort()


# ---------------------------------------------------------- what the SDK gives, at the same instant, whatever comes


def by_sdk(line: Line) -> tuple[bytes, int]:
    sdk = Protocol1PacketHandler()
    packet, result, _ = sdk.txRxPacket(line, list(READ))
    # A status with nothing in it is the reply to what was left of an earlier request.
    while result == COMM_SUCCESS and (len(packet) == OVERHEAD_BYTES or packet[2] != READ[2]):
        packet, result = sdk.rxPacket(line)
    return bytes(packet), result


def outcome(answer: bytes, ask: Callable[[Line], tuple[bytes, int]]) -> tuple[object, ...]:
    line = Line(answer)
    packet, result = ask(line)
    good = packet if result == COMM_SUCCESS else b""
    still_there = line._received + line.left
    return good, result, line.sent, line.clock.now_ns(), line.heard, still_there, line.is_using


byte = st.integers(0, 255)
parameters = st.binary(max_size=26) | st.binary(max_size=244)
statuses = st.builds(encode_status, st.sampled_from([0, 1, 2, 253]), byte, parameters)
places = st.integers(0, 40)
damaged = st.builds(lambda data, at, wrong: data[:at] + bytes((wrong,)) + data[at + 1 :], statuses, places, byte)
junk = st.sampled_from([b"\xff\xff", b"\xff\xff\x01\xfa\x00" * 40])
pieces = st.one_of(statuses, damaged, st.binary(max_size=20), junk)


@given(answer=st.lists(pieces, max_size=4).map(b"".join), cut=st.integers(0, 400))
@example(answer=encode_status(2, 0, bytes(244)) + encode_status(1, 0, bytes(26)), cut=400)  # more than is heard
@settings(max_examples=400)
def test_every_answer_is_taken_as_the_sdk_takes_it(answer: bytes, cut: int) -> None:
    assert outcome(answer[:cut], lambda line: line.ask(READ, 32)) == outcome(answer[:cut], by_sdk)


def test_a_whole_good_reply_takes_the_short_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "_sdk", None)
    reply = encode_status(1, 0, bytes(range(26)))
    assert Line(reply).ask(READ, 32) == (reply, COMM_SUCCESS)
