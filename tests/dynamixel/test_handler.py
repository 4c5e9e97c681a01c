"""The short cut past the SDK's loops gives what the SDK gives, at the same instant, whatever comes down the line."""

from typing import Any

from dynamixel_sdk import COMM_SUCCESS, Protocol1PacketHandler
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.dynamixel.packet import encode_status
from armctl.dynamixel.port import PacketHandler
from tests.dynamixel.conftest import Line

READ = (0xFF, 0xFF, 1, 4, 2, 24, 26, 0)


def outcome(handler: Any, answer: bytes) -> tuple[object, ...]:
    line = Line(answer)
    packet, result, error = handler.txRxPacket(line, list(READ))
    good = bytes(packet) if result == COMM_SUCCESS else b""
    return good, result, error, line.clock.now_ns(), line.heard, len(line._received) + len(line.left), line.is_using


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
@settings(deadline=None, max_examples=400)
def test_every_answer_is_taken_as_the_sdk_takes_it(answer: bytes, cut: int) -> None:
    assert outcome(PacketHandler(), answer[:cut]) == outcome(Protocol1PacketHandler(), answer[:cut])


def test_a_whole_good_reply_takes_the_short_cut() -> None:
    line = Line(encode_status(1, 0, bytes(range(26))))
    line.setPacketTimeout(32)
    packet, result = PacketHandler().rxPacket(line)
    assert (packet, result) == (encode_status(1, 0, bytes(range(26))), COMM_SUCCESS)
    assert isinstance(packet, bytes), "the SDK would have made a list of it"
