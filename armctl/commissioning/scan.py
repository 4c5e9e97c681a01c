"""Which servos answer, and at what baud.

Rules:

1. Only PING and READ are sent: nothing moves and nothing changes.
2. A silent id costs its request and the slowest reply over a quick adapter, about 4 ms at 1 Mbps.
3. A reply that comes while a later id is being asked tells of a slow adapter: from there on the patience is
   `IDENTIFY_LATENCY_MS`, and the ids asked meanwhile are asked again. An id from which only noise comes is asked
   again with that patience.
4. A PING's echo looks like a reply with the voltage bit set; such an id counts only if it can also be read. An id
   from which only noise comes counts if every read of it is noise, too: several servos talk at once.
"""

from collections.abc import Callable, Sequence
from typing import Literal, NamedTuple

from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.identify import IDENTIFY_LATENCY_MS, answers_twice
from armctl.dynamixel.packet import OVERHEAD_BYTES, Decoder, Instruction, Packet, encode_instruction
from armctl.dynamixel.port import ADAPTER_LATENCY_MS, ServoPort
from armctl.errors import PortGone, PortMissing

ALL_IDS = range(ax12a.ID.maximum + 1)
# What ROBOTIS' tools offer for an AX-12A; the likely ones first.
USUAL_BAUDS = (1_000_000, 57_600, 115_200, 500_000, 250_000, 200_000, 400_000, 19_200, 9_600)

# (baud, ids asked, ids in all).
Progress = Callable[[int, int, int], None]


class FoundServo(NamedTuple):
    """One id that answers."""

    servo_id: int
    baud: int
    # None: it answers a PING but no READ (its status return level is 0, or its replies are garbled).
    model: int | None
    firmware: int | None
    # PING to the last byte of its reply.
    round_trip_us: int
    # More than one servo answers to this id.
    clash: bool


# What came from an id, and how long after the request [ns].
_Answer = tuple[Literal["status", "echo", "noise"], int]


def scan(
    bus: ServoBus, bauds: Sequence[int], servo_ids: Sequence[int] = ALL_IDS, progress: Progress | None = None
) -> list[FoundServo]:
    """Every servo that answers at one of `bauds`; the bus is open, and stays at the last baud and as patient as with a
    slow adapter.

    Raises:
        PortGone: the port vanished.
        PortMissing: the adapter can do none of the bauds.
    """
    found: list[FoundServo] = []
    refused: list[PortMissing] = []
    for baud in bauds:
        if baud != bus.port.baudrate:
            try:
                bus.port.setBaudRate(baud)
            except PortMissing as error:
                refused.append(error)
                continue
        answers = sorted(_ping_all(bus.port, servo_ids, progress).items())
        found += [servo for servo_id, answer in answers if (servo := _look_at(bus, servo_id, *answer))]
    if len(refused) == len(bauds):
        raise refused[0]
    return found


def _look_at(bus: ServoBus, servo_id: int, kind: str, elapsed_ns: int) -> FoundServo | None:
    reply = bus.read_block(servo_id, ax12a.MODEL.address, 3)
    clash = answers_twice(bus, servo_id)
    if not bus.is_open:
        raise PortGone(f"{bus.port.port_name}: the port vanished during the scan; plug the adapter in again")
    if reply.problem and (kind == "echo" or (kind == "noise" and not clash)):
        return None
    model = firmware = None
    if not reply.problem:
        model, firmware = (ax12a.register_value(register, reply.data, 0) for register in (ax12a.MODEL, ax12a.FIRMWARE))
    return FoundServo(servo_id, bus.port.baudrate, model, firmware, elapsed_ns // 1000, clash)


def _ping_all(port: ServoPort, servo_ids: Sequence[int], progress: Progress | None) -> dict[int, _Answer]:
    """What came from each id that is not silent."""
    answers: dict[int, _Answer] = {}
    decoder = Decoder()
    patient_until = -1
    index = 0
    port.drain()
    while index < len(servo_ids):
        servo_id = servo_ids[index]
        request = encode_instruction(servo_id, Instruction.PING)
        patient = index <= patient_until
        port.allow_latency(IDENTIFY_LATENCY_MS if patient else ADAPTER_LATENCY_MS)
        begin_ns = port.begin_round()
        port.writePort(list(request))
        port.setPacketTimeout(OVERHEAD_BYTES)
        heard = _listen(port, decoder, servo_id)
        elapsed_ns = port.clock.now_ns() - begin_ns
        if not patient and not heard and (port.heard or index == len(servo_ids) - 1):
            # Half a reply, or the last id: what is still under way may belong to an earlier one.
            noise = port.heard
            port.setPacketTimeoutMillis(IDENTIFY_LATENCY_MS)
            heard = _listen(port, decoder, None)
            if noise or port.heard:
                patient_until = index
        late = [i for i in range(index) if servo_ids[i] in heard and servo_ids[i] not in answers]
        if not patient and (late or patient_until == index):
            patient_until = len(servo_ids) if late else index  # a slow adapter is one for all of them
            port.setPacketTimeoutMillis(IDENTIFY_LATENCY_MS)
            _listen(port, decoder, None)
            decoder.reset()
            index = min(late, default=index)
            continue
        if servo_id in heard:
            answers[servo_id] = ("echo" if heard[servo_id] == request else "status", elapsed_ns)
        elif port.heard:
            answers[servo_id] = ("noise", elapsed_ns)
            port.drain()
            decoder.reset()
        index += 1
        if progress is not None:
            progress(port.baudrate, index, len(servo_ids))
    port.allow_latency(IDENTIFY_LATENCY_MS)
    return answers


def _listen(port: ServoPort, decoder: Decoder, servo_id: int | None) -> dict[int, bytes]:
    """Good packets by the id they come from, until `servo_id` has answered or the port's deadline."""
    heard: dict[int, bytes] = {}
    while servo_id not in heard and (data := port.readPort(OVERHEAD_BYTES)):
        for packet in decoder.feed(data):
            if isinstance(packet, Packet):
                heard[packet.servo_id] = encode_instruction(packet.servo_id, packet.code, packet.parameters)
    return heard
