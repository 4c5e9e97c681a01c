"""Dynamixel protocol 1.0 packets, without I/O.

    instruction   FF FF ID LENGTH INSTRUCTION PARAMETERS... CHECKSUM
    status        FF FF ID LENGTH ERROR       PARAMETERS... CHECKSUM

LENGTH counts what follows it: the parameters and 2. CHECKSUM is the inverted low byte of the sum from ID to the
last parameter. ID 255 and a LENGTH outside 2..246 cannot begin a packet (the whole is at most 250 bytes, the
limit of ROBOTIS' SDK). Both kinds have one shape, so one decoder serves both; whether `code` is an instruction or
an error byte, only the direction tells.
"""

from enum import IntEnum
from typing import NamedTuple

from armctl.messages import NS_PER_S

HEADER = b"\xff\xff"
# Sum of a whole packet, checksum and header included.
WHOLE_SUM = (sum(HEADER) + 0xFF) & 0xFF
BROADCAST_ID = 0xFE
MIN_LENGTH = 2
MAX_LENGTH = 246
# Bytes of a packet without parameters.
OVERHEAD_BYTES = 6
# On the wire: a start bit, eight data bits, a stop bit.
BITS_PER_BYTE = 10


def wire_ns(baud: int) -> int:
    """How long a byte takes on the wire."""
    return BITS_PER_BYTE * NS_PER_S // baud


class Instruction(IntEnum):
    """Instructions an AX-12A knows; it stays silent to any other."""

    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    RESET = 0x06
    SYNC_WRITE = 0x83


class Packet(NamedTuple):
    """One packet with a good checksum."""

    servo_id: int
    # Instruction of an instruction packet, error byte of a status packet.
    code: int
    parameters: bytes = b""


class BadChecksum(NamedTuple):
    """Bytes in the shape of a packet whose checksum does not hold."""

    raw: bytes

    @property
    def servo_id(self) -> int:
        """The address as it was received, possibly itself corrupt."""
        return self.raw[2]


def _encode(servo_id: int, code: int, parameters: bytes, highest_id: int) -> bytes:
    length = len(parameters) + 2
    if not 0 <= servo_id <= highest_id:
        raise ValueError(f"servo id {servo_id} is outside 0..{highest_id}")
    if not 0 <= code <= 0xFF:
        raise ValueError(f"code {code} is no byte")
    if length > MAX_LENGTH:
        raise ValueError(f"{len(parameters)} parameters; a packet holds at most {MAX_LENGTH - 2}")
    checksum = ~(servo_id + length + code + sum(parameters)) & 0xFF
    return b"\xff\xff%c%c%c%b%c" % (servo_id, length, code, parameters, checksum)


def encode_instruction(servo_id: int, instruction: int, parameters: bytes = b"") -> bytes:
    """An instruction packet to one servo or, with `BROADCAST_ID`, to all.

    Raises:
        ValueError: an id outside 0..254, an instruction that is no byte, or more than 244 parameters.
    """
    return _encode(servo_id, instruction, parameters, BROADCAST_ID)


def encode_status(servo_id: int, error: int, parameters: bytes = b"") -> bytes:
    """A servo's reply.

    Raises:
        ValueError: an id outside 0..253, an error that is no byte, or more than 244 parameters.
    """
    return _encode(servo_id, error, parameters, BROADCAST_ID - 1)


class Decoder:
    """Packets out of a byte stream that may be cut and dirtied anywhere.

    What it returns depends on the bytes only, not on how they were cut. Bytes that cannot begin a packet are
    skipped; after a bad checksum the search goes on one byte behind the false header, so a good packet inside is
    not lost. A false header can hold back what follows until its length is filled: the protocol's remedy is
    `reset` after a gap.
    """

    def __init__(self) -> None:
        self._buffer = bytearray()

    @property
    def wanted(self) -> int:
        """The fewest bytes that can complete a packet; so many may be fed at once without missing when it ended."""
        buffer = self._buffer
        return (buffer[3] + 4 if len(buffer) > 3 else OVERHEAD_BYTES) - len(buffer)

    def whole(self, data: bytes) -> Packet | None:
        """The good packet that `data` is from the first byte to the last; None: anything else, which is to be fed."""
        if (
            not self._buffer
            and OVERHEAD_BYTES <= len(data) <= MAX_LENGTH + 4
            and len(data) == data[3] + 4
            and data[:2] == HEADER
            and data[2] <= BROADCAST_ID
            and sum(data) & 0xFF == WHOLE_SUM
        ):
            return Packet(data[2], data[4], data[5:-1])
        return None

    def feed(self, data: bytes) -> list[Packet | BadChecksum]:
        """Everything that `data` completes, in order."""
        buffer = self._buffer
        buffer += data
        found: list[Packet | BadChecksum] = []
        while (begin := buffer.find(HEADER)) >= 0:
            del buffer[:begin]
            if len(buffer) < 4:
                # FF FF FF: the header may begin one byte later.
                if buffer[2:3] == b"\xff":
                    del buffer[0]
                    continue
                return found
            servo_id, length = buffer[2], buffer[3]
            if servo_id > BROADCAST_ID or not MIN_LENGTH <= length <= MAX_LENGTH:
                del buffer[0]
                continue
            end = length + 4
            if len(buffer) < end:
                return found
            if sum(buffer[2:end]) & 0xFF == 0xFF:
                found.append(Packet(servo_id, buffer[4], bytes(buffer[5 : end - 1])))
                del buffer[:end]
            else:
                found.append(BadChecksum(bytes(buffer[:end])))
                del buffer[0]
        # Without a header only a last FF can still become one.
        del buffer[: len(buffer) - buffer.endswith(b"\xff")]
        return found

    def reset(self) -> None:
        """Forget a half-received packet: what a servo does when 100 ms pass between two bytes."""
        self._buffer.clear()
