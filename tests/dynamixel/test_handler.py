"""The short cut past the SDK's loops gives what the SDK gives, at the same instant, whatever comes down the line."""

from collections.abc import Callable

import pytest
from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.dynamixel import port
from armctl.dynamixel.packet import Instruction, encode_instruction, encode_status
from tests.dynamixel.conftest import Line

READ = encode_instruction(1, Instruction.READ, bytes((24, 26)))


def by_sdk(line: Line) -> tuple[bytes, int]:
    packet, result, _ = Protocol1PacketHandler().txRxPacket(line, list(READ))
    return bytes(packet), result


def outcome(answer: bytes, ask: Callable[[Line], tuple[bytes, int]]) -> tuple[object, ...]:
    line = Line(answer)
    packet, result = ask(line)
    good = packet if result == COMM_SUCCESS else b""
    still_there = line._received + line.left
    return good, result, line.sent, line.clock.now_ns(), line.heard, still_there, line.is_using


statuses = st.builds(
    encode_status,
    st.sampled_from([0, 1, 2, 253]),
    st.integers(0, 255),
    st.binary(max_size=26) | st.binary(max_size=244),
)
damaged = st.builds(
    lambda data, cut, byte: data[:cut] + bytes((byte,)) + data[cut + 1 :],
    statuses,
    st.integers(0, 40),
    st.integers(0, 255),
)
pieces = st.one_of(
    statuses, damaged, st.binary(max_size=20), st.just(b"\xff\xff"), st.just(b"\xff\xff\x01\xfa\x00" * 40)
)


@given(answer=st.lists(pieces, max_size=4).map(b"".join), cut=st.integers(0, 400))
@example(answer=encode_status(2, 0, bytes(244)) + encode_status(1, 0, bytes(26)), cut=400)  # more than is heard
@settings(max_examples=400)
def test_every_answer_is_taken_as_the_sdk_takes_it(answer: bytes, cut: int) -> None:
    assert outcome(answer[:cut], lambda line: line.ask(READ, 32)) == outcome(answer[:cut], by_sdk)


def test_a_whole_good_reply_takes_the_short_cut(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(port, "_sdk", None)
    reply = encode_status(1, 0, bytes(range(26)))
    assert Line(reply).ask(READ, 32) == (reply, COMM_SUCCESS)
