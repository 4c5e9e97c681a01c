"""The servo bus: one owner of the port, one transaction at a time, and no reply believed before it is checked.

Rules:

1. A reply counts only if it is no echo of the request, comes from the servo asked, has the exact length, a good
   checksum, registers within the control table's bounds, and a position the servo can have reached since the last one.
   The checksum and the id are the port's work (see `ServoPort.ask`).
2. A bad or missing reply is repeated once, after the line has fallen quiet. A sample spends at most `SAMPLE_RETRIES`
   repetitions, and asks a servo that missed `SILENT_MISSES` samples in a row only every `PROBE_EVERY`-th time, so a
   silent bus costs a bounded part of the tick. One that has answered anything else is asked again at once.
3. What was not read in this sample says so: `fresh` is False and the registers keep their old stamp.
4. Trouble is data (`NO_REPLY`, `BUS_NOISE`, `PORT_GONE`); only `open` raises. After `PORT_GONE` the bus is closed until
   someone opens it again.
5. Whatever may have come since the last exchange is thrown away before a sample's first request, and before every
   other one. A stray reply within a sample is less likely, and met by rule 1.
6. No read asks for two bytes: such a request could be mistaken for a reply to itself (length 4, error bit 1).

What is found when connecting is in `identify.py`.
"""

import logging
import struct
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, COMM_TX_FAIL

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import IMPOSSIBLE_BITS, ErrorBit, Register, Seen, believable, position_tick
from armctl.dynamixel.packet import BROADCAST_ID, HEADER, OVERHEAD_BYTES, Instruction, encode_instruction
from armctl.dynamixel.port import ADAPTER_LATENCY_MS, DRAIN_ROUNDS, NS_PER_MS, QUIET_MS, ServoPort
from armctl.errors import PortGone
from armctl.messages import Goal, Sample, ServoReading, Write

# Why nothing good came back.
NO_REPLY, BUS_NOISE, PORT_GONE = "NO_REPLY", "BUS_NOISE", "PORT_GONE"
SAMPLE_RETRIES = 2
# Long enough (0.5 s at 10 Hz) that a servo which restarts after a brown-out, 0.3 s, is heard as soon as it speaks.
SILENT_MISSES = 5
PROBE_EVERY = 5

# How far into a sample a busy machine may make replies late: half a tick of 100 ms.
SAMPLE_PATIENCE_NS = 50 * NS_PER_MS

ID_MAX = ax12a.ID.maximum
ERROR_AT = 4
DATA_AT = 5
STATUS_BLOCK = (ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE)
# Error bits that say the very request was not carried out.
REFUSED = ErrorBit.RANGE | ErrorBit.CHECKSUM | ErrorBit.INSTRUCTION

_log = logging.getLogger(__name__)


class Reply(NamedTuple):
    """What came back to one request; `problem` is empty when it is good."""

    data: bytes = b""
    error: int = 0
    problem: str = ""
    elapsed_ns: int = 0


@dataclass(slots=True)
class _Track:
    """What the bus remembers of one servo between samples."""

    # The packet that reads its status.
    request: bytes
    reading: ServoReading
    # Its position in the reading; None: it was never read.
    seen: Seen | None = None
    # Samples in a row without any answer.
    misses: int = 0
    # A position that no servo could have moved to; believed if the next read agrees.
    suspect: Seen | None = None


class ServoBus:
    """The servos of one arm behind one port; the port's only user. Not thread-safe."""

    def __init__(self, port: ServoPort, servo_ids: Sequence[int]) -> None:
        self.is_open = False
        # The transport; its user is this bus.
        self.port = port
        self.servo_ids = tuple(servo_ids)
        # Firmware version of every servo as `identify` read it; -1: it did not answer.
        self.firmware: tuple[int, ...] = ()
        # What samples allow the adapter.
        self.latency_ms = ADAPTER_LATENCY_MS
        reads = [encode_instruction(servo_id, Instruction.READ, bytes(STATUS_BLOCK)) for servo_id in servo_ids]
        self._tracks = [_Track(read, ServoReading(read[2], b"", 0, False)) for read in reads]
        self._sample_count = 0
        # Why it is not open.
        self.closed_because = f"{port.port_name}: the bus is closed; open it first"

    def open(self) -> None:
        """Open the port.

        Raises:
            PortMissing, PortBusy, PortGone: see the port.
        """
        self.port.openPort()
        self.allow_latency(ADAPTER_LATENCY_MS)
        self.is_open = True
        for track in self._tracks:
            track.misses, track.suspect = 0, None

    def close(self) -> None:
        """Close the port; does nothing if it is closed."""
        self.is_open = False
        self.port.closePort()

    # ----------------------------------------------------------------------------------------- every tick

    def read_sample(self) -> Sample:
        """Bytes 24..49 of every servo.

        Servo and port trouble is in the sample, never raised. A silent servo costs two reply timeouts at first and
        one of them every fifth sample later.
        """
        begin_ns = self.port.begin_round(SAMPLE_PATIENCE_NS)
        retries = 0
        for index, track in enumerate(self._tracks):
            if track.misses >= SILENT_MISSES and (self._sample_count + index) % PROBE_EVERY:
                self._miss(track, NO_REPLY)
                continue
            problem = self._read_status(track)
            if problem and track.misses < SILENT_MISSES and retries < SAMPLE_RETRIES and self.is_open:
                retries += 1
                problem = self._read_status(track)
            if problem:
                self._miss(track, problem)
        if not self.is_open:
            for track in self._tracks:
                self._miss(track, PORT_GONE)
        self._sample_count += 1
        servos, bus_us = tuple([track.reading for track in self._tracks]), (self.port.clock.now_ns() - begin_ns) // 1000
        return Sample(begin_ns, servos, bus_us, retries, self.is_open)

    def write_goal(self, goal: Goal) -> bool:
        """Send goal position and moving speed to all servos in one SYNC_WRITE, which nobody answers.

        Returns:
            Whether it left; False: the port is gone or stuck.
        Raises:
            ValueError: a goal that is no whole tick or speed in 0..1023, or not one for each servo.
        """
        for what, values in (("goal position", goal.ticks), ("moving speed", goal.speeds)):
            if len(values) != len(self.servo_ids):
                raise ValueError(f"{len(values)} values of {what} for {len(self.servo_ids)} servos")
            for servo_id, value in zip(self.servo_ids, values, strict=True):
                if not (isinstance(value, int) and 0 <= value <= ax12a.TICK_MAX):
                    raise ValueError(f"servo {servo_id}: {what} {value!r} is no whole number in 0..{ax12a.TICK_MAX}")
        if not self.is_open:
            return False
        goals = b"".join(struct.pack("<BHH", *one) for one in zip(self.servo_ids, goal.ticks, goal.speeds, strict=True))
        body = bytes((BROADCAST_ID, len(goals) + 4, Instruction.SYNC_WRITE, ax12a.GOAL.address, 4)) + goals
        packet = HEADER + body + bytes((~sum(body) & 0xFF,))
        try:
            self.port.clearPort()
            return self.port.writePort(packet) == len(packet)
        except PortGone as error:
            self._lose_port(error)
            return False

    # -------------------------------------------------------------------------------------------- one servo

    def write(self, write: Write) -> bool:
        """Write one register and have it confirmed; False: no good reply, or the servo refused.

        Raises:
            ValueError: the value does not fit the size, or there is no such servo id.
        """
        if write.size not in (1, 2) or not 0 <= write.value < 1 << 8 * write.size:
            raise ValueError(f"servo {write.servo_id}: {write.value} does not fit {write.size} bytes")
        parameters = bytes((write.address,)) + write.value.to_bytes(write.size, "little")
        reply = self._ask(write.servo_id, Instruction.WRITE, parameters, 0)
        if reply.error & REFUSED:
            named = ", ".join(ErrorBit.names(reply.error))
            _log.warning("servo %d refused %d at address %d: %s", write.servo_id, write.value, write.address, named)
        return not reply.problem and not reply.error & REFUSED

    def read(self, servo_id: int, register: Register) -> int | None:
        """Value of one register; None: no good reply."""
        begin = max(0, register.address - 1)  # three bytes, never two: rule 6
        reply = self.read_block(servo_id, begin, 3)
        return None if reply.problem else ax12a.register_value(register, reply.data, begin)

    def read_block(self, servo_id: int, begin: int, size: int, tries: int = 2) -> Reply:
        """Bytes of a servo's control table, with its error bits and the time it took; trouble is in the reply.

        Args:
            tries: How often it is asked for while the reply is bad or missing.
        Raises:
            ValueError: two bytes asked for (rule 6), or no such servo id.
        """
        if size == 2:
            raise ValueError("a read of two bytes looks like a reply to itself; read three")
        return self._ask(servo_id, Instruction.READ, bytes((begin, size)), size, tries)

    def allow_latency(self, latency_ms: float) -> None:
        """From now on wait so much longer for a reply in samples, because the adapter may keep it back."""
        self.latency_ms = latency_ms
        self.port.allow_latency(latency_ms)

    # ----------------------------------------------------------------------------------------- transactions

    def _read_status(self, track: _Track) -> str:
        """Read one servo into `track`; returns the problem, if any."""
        packet, problem = self._exchange(track.request, OVERHEAD_BYTES + ax12a.STATUS_SIZE)
        if problem:
            return problem
        data, error = packet[DATA_AT:-1], packet[ERROR_AT]
        if int.from_bytes(data, "little") & IMPOSSIBLE_BITS:
            self.drain()
            return BUS_NOISE
        now_ns = self.port.arrived_ns
        old, seen = track.reading, (position_tick(data), now_ns)
        if not believable(seen, track.seen, track.suspect):
            track.suspect = seen
            return BUS_NOISE
        if error != old.error:
            named = ", ".join(ErrorBit.names(error)) or "none"
            _log.warning("servo %d: error bits are now: %s", old.servo_id, named)
        track.misses, track.seen, track.suspect = 0, seen, None
        track.reading = ServoReading(old.servo_id, data, now_ns, True, error)
        return ""

    def _miss(self, track: _Track, problem: str) -> None:
        track.misses = track.misses + 1 if problem == NO_REPLY else 0
        track.reading = replace(track.reading, fresh=False, problem=problem)

    def _ask(self, servo_id: int, instruction: int, parameters: bytes, reply_size: int, tries: int = 2) -> Reply:
        """The first good reply to a request that belongs to no sample, or the last bad one.

        Raises:
            ValueError: no such servo id.
        """
        if not 0 <= servo_id <= ID_MAX:
            raise ValueError(f"servo id {servo_id} is not in 0..{ID_MAX}")
        request = encode_instruction(servo_id, instruction, parameters)
        problem = ""
        for _ in range(tries):
            begin_ns = self.port.begin_round()
            packet, problem = self._exchange(request, reply_size + OVERHEAD_BYTES)
            if not problem:
                for track in self._tracks:
                    if track.reading.servo_id == servo_id:
                        track.misses = 0
                return Reply(packet[DATA_AT:-1], packet[ERROR_AT], "", self.port.arrived_ns - begin_ns)
        return Reply(problem=problem)

    def _exchange(self, request: bytes, size: int) -> tuple[bytes, str]:
        """Send a packet, and check its reply of `size` bytes as far as every instruction allows.

        Returns:
            (the reply, "") or, once the line is quiet again, (nothing, the problem).
        """
        if not self.is_open:
            return b"", PORT_GONE
        try:
            packet, result = self.port.ask(request, size)
        except PortGone as error:
            self._lose_port(error)
            return b"", PORT_GONE
        if result == COMM_SUCCESS and len(packet) == size and packet != request:
            return packet, ""
        silent = result == COMM_TX_FAIL or (result == COMM_RX_TIMEOUT and not self.port.heard)
        self.drain()  # of an echo, or of a late reply to another request, the reply itself is still to come
        return b"", PORT_GONE if not self.is_open else NO_REPLY if silent else BUS_NOISE

    def drain(self, quiet_ms: float = QUIET_MS, rounds: int = DRAIN_ROUNDS) -> int:
        """See the port; 0 if it is lost."""
        try:
            return self.port.drain(quiet_ms, rounds)
        except PortGone as error:
            self._lose_port(error)
            return 0

    def _lose_port(self, error: PortGone) -> None:
        if self.is_open:
            _log.error("%s", error)
        self.is_open, self.closed_because = False, str(error)
