"""Protocol 1.0 packets: laws of the codec, and equality with ROBOTIS' own bytes."""

from collections.abc import Callable
from itertools import pairwise

import dynamixel_sdk
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel import packet as module
from armctl.dynamixel.packet import BadChecksum, Decoder, Instruction, Packet, encode_instruction, encode_status
from tests.dynamixel.conftest import Line

packets = st.builds(Packet, st.integers(0, module.BROADCAST_ID), st.integers(0, 255), st.binary(max_size=40))
garbage = st.binary(max_size=20).map(lambda data: data.replace(b"\xff", b"\x00"))


def encode(packet: Packet) -> bytes:
    return encode_instruction(packet.servo_id, packet.code, packet.parameters)


@given(packets)
def test_decode_inverts_encode_at_every_split_point(packet: Packet) -> None:
    data = encode(packet)
    for split in range(len(data) + 1):
        decoder = Decoder()
        assert decoder.feed(data[:split]) + decoder.feed(data[split:]) == [packet]


@given(st.lists(packets, max_size=5), st.data())
def test_garbage_between_packets_is_skipped(expected: list[Packet], data: st.DataObject) -> None:
    stream = data.draw(garbage)
    for packet in expected:
        stream += encode(packet) + data.draw(garbage)
    assert Decoder().feed(stream) == expected


@given(st.binary(max_size=300), st.data())
def test_result_depends_on_the_bytes_and_not_on_their_cuts(stream: bytes, data: st.DataObject) -> None:
    # Bytes of headers and small lengths, so that the search meets every false beginning.
    stream = bytes((0xFF, 0xFF, 1, 2, 3, byte)[byte % 6] for byte in stream)
    cuts = sorted(data.draw(st.lists(st.integers(0, len(stream)), max_size=10)))
    decoder = Decoder()
    found = [event for a, b in pairwise([0, *cuts, len(stream)]) for event in decoder.feed(stream[a:b])]
    assert found == Decoder().feed(stream)


@given(packets, st.binary(max_size=4), st.data())
def test_whole_takes_one_packet_alone_and_only_what_feeding_it_gives(
    packet: Packet, more: bytes, data: st.DataObject
) -> None:
    good = encode(packet)
    assert Decoder().whole(good) == packet
    raw = bytearray(good + more)
    raw[data.draw(st.integers(0, len(raw) - 1))] ^= data.draw(st.integers(0, 255))
    whole = Decoder().whole(bytes(raw))
    assert whole is None or Decoder().feed(bytes(raw)) == [whole]
    half_fed = Decoder()
    half_fed.feed(good[:3])
    assert half_fed.whole(good) is None


@given(packets, st.data())
def test_any_single_wrong_byte_behind_the_length_is_a_bad_checksum(packet: Packet, data: st.DataObject) -> None:
    good = encode(packet)
    at = data.draw(st.integers(4, len(good) - 1))
    raw = bytearray(good)
    raw[at] ^= data.draw(st.integers(1, 255))
    first, *_ = Decoder().feed(bytes(raw))
    assert first == BadChecksum(bytes(raw))
    assert isinstance(first, BadChecksum)
    assert first.servo_id == packet.servo_id


BAD = encode_status(3, 0, b"\x01\x02")[:-1] + b"\x00"
GOOD = encode_status(4, 0, b"\x07")


@pytest.mark.parametrize(
    ("before", "found"),
    [
        (BAD, [BadChecksum(BAD)]),
        # What cannot begin a packet holds nothing back.
        (b"\xff", []),
        (b"\xff\xff\xff", []),
        (b"\xff\xff\x01\x00", []),
        (b"\xff\xff\x01\x01", []),
        (b"\xff\xff\x01\xf7", []),
    ],
)
def test_packet_after_a_bad_checksum_or_junk_is_found(before: bytes, found: list[BadChecksum]) -> None:
    assert Decoder().feed(before + GOOD) == [*found, Packet(4, 0, b"\x07")]


def test_packet_inside_a_false_header_is_found() -> None:
    assert Decoder().feed(b"\xff\xff\x01\x05" + GOOD)[-1] == Packet(4, 0, b"\x07")


def test_reset_forgets_a_half_packet_and_nothing_else() -> None:
    decoder = Decoder()
    assert decoder.feed(b"\xff\xff\x01\xf0\x03") == []
    decoder.reset()
    assert decoder.feed(encode_status(1, 0)) == [Packet(1, 0)]


@given(st.lists(st.binary(max_size=200), max_size=20))
def test_memory_is_bounded(pieces: list[bytes]) -> None:
    decoder = Decoder()
    for piece in pieces:
        decoder.feed(piece)
        assert len(decoder._buffer) < module.MAX_LENGTH + 4


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: encode_instruction(255, 1), "servo id 255"),
        (lambda: encode_status(254, 0), "servo id 254"),
        (lambda: encode_instruction(1, 256), "code 256"),
        (lambda: encode_instruction(1, 3, bytes(245)), "245 parameters"),
    ],
)
def test_what_no_packet_can_hold_is_refused(make: Callable[[], bytes], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


@given(st.integers(0, 253), st.sampled_from(list(Instruction)), st.binary(max_size=60))
def test_instruction_packets_are_the_sdks_bytes(servo_id: int, instruction: Instruction, parameters: bytes) -> None:
    port = Line()
    packet = [0, 0, servo_id, len(parameters) + 2, instruction, *parameters, 0]
    result = dynamixel_sdk.Protocol1PacketHandler().txPacket(port, packet)
    assert result == dynamixel_sdk.COMM_SUCCESS
    assert port.sent == encode_instruction(servo_id, instruction, parameters)


@given(st.integers(0, 253), st.integers(0, 127), st.binary(max_size=60))
def test_the_sdk_accepts_status_packets(servo_id: int, error: int, parameters: bytes) -> None:
    status = encode_status(servo_id, error, parameters)
    line = Line(status)
    line.setPacketTimeout(len(status))
    received, result = dynamixel_sdk.Protocol1PacketHandler().rxPacket(line)
    assert result == dynamixel_sdk.COMM_SUCCESS
    assert bytes(received) == status


@given(st.lists(st.one_of(packets.map(encode), st.binary(max_size=30), st.just(b"\xff\xff\x01")), max_size=6))
def test_feeding_what_is_wanted_finds_every_packet_where_it_ends(parts: list[bytes]) -> None:
    stream = b"".join(parts)
    by_byte, by_want = Decoder(), Decoder()
    ends = [(at + 1, found) for at in range(len(stream)) for found in by_byte.feed(stream[at : at + 1])]
    wanted_ends, at = [], 0
    while at < len(stream):
        piece = stream[at : at + by_want.wanted]
        at += len(piece)
        wanted_ends += [(at, found) for found in by_want.feed(piece)]
    assert wanted_ends == ends
