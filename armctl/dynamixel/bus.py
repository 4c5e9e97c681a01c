"""The servo bus: one owner of the port, one transaction at a time, and no reply believed before it is checked.

Rules:

1. A reply counts only if it is no echo of the request, comes from the servo asked, has the exact length, a good
   checksum, registers within the control table's bounds, and a position the servo can have reached since the last one.
   Only the checksum and the id are the SDK's work.
2. A bad or missing reply is repeated once, after the line has fallen quiet. A sample spends at most `SAMPLE_RETRIES`
   repetitions, and asks a servo that missed `SILENT_MISSES` samples in a row only every `PROBE_EVERY`-th time, so a
   silent bus costs a bounded part of the tick.
3. What was not read in this sample says so: `fresh` is False and the registers keep their old stamp.
4. Trouble is data (`NO_REPLY`, `BUS_NOISE`, `PORT_GONE`); only `open` raises. After `PORT_GONE` the bus is closed until
   someone opens it again.
5. Whatever may have come since the last exchange is thrown away before a request. Within a sample that is left out
   (it is a system call) after a reply of exactly the bytes that were due: a stray one in between the two is less likely
   than one behind the throwing away, and met by rule 1.
6. No read asks for two bytes: such a request could be mistaken for a reply to itself (length 4, error bit 1).
7. What a reply that comes late on a busy machine may look like (a silent servo, a second one with its id, a slow
   adapter) is believed by `identify` only if it shows again and again.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from dataclasses import dataclass
from statistics import median
from typing import NamedTuple

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, COMM_TX_FAIL, GroupSyncWrite, Protocol1PacketHandler
from dynamixel_sdk.robotis_def import INST_READ, INST_WRITE

from armctl.clock import NS_PER_S, Clock
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit, Register
from armctl.dynamixel.fitness import bus_dead, slow_adapter, table_problems
from armctl.dynamixel.port import ADAPTER_LATENCY_MS, NS_PER_MS, QUIET_MS, ServoPort
from armctl.errors import PortGone
from armctl.messages import Goal, Problem, Sample, ServoReading, Write

NO_REPLY = "NO_REPLY"
BUS_NOISE = "BUS_NOISE"
PORT_GONE = "PORT_GONE"

SAMPLE_RETRIES = 2
SILENT_MISSES = 5
"""Long enough (0.5 s at 10 Hz) that a servo which restarts after a brown-out, 0.3 s, is heard as soon as it speaks."""
PROBE_EVERY = 5

SAMPLE_PATIENCE_NS = 50 * NS_PER_MS
"""How far into a sample a busy machine may make replies late: half a tick of 100 ms."""
IDENTIFY_PATIENCE_NS = 300 * NS_PER_MS

IDENTIFY_LATENCY_MS = 20.0
"""Allowance while identifying: an adapter with the 16 ms latency timer is slow, not silent."""
SLOW_ADAPTER_MS = 8.0
"""Six reads with this much each fit half a tick of 100 ms; the usual timers are 1 and 16 ms."""
DUPLICATE_PROBES = 3
"""Reads of changing registers per servo that tell two servos with one id."""
CONFIRM_QUIET_MS = (20.0, 40.0, 80.0)
"""How long the line is to be silent before each reading that confirms a suspicion."""
LATENCY_PROBES = 6
"""Further readings of an adapter that seems slow."""

MOTION_MARGIN = 1.5
MOTION_MARGIN_TICKS = 3.0
SPEED_BOUND_TICK_S = MOTION_MARGIN * (ax12a.NO_LOAD_SPEED_RAD_S / ax12a.TICK_RAD)
POSITION_AT = ax12a.PRESENT_POSITION.address - ax12a.STATUS_BEGIN

ID_MAX = ax12a.ID.maximum
HEADER_SIZE = 5
STATUS_OVERHEAD = 6
"""Bytes of a status packet beside its parameters: header, id, length, error, checksum."""
REFUSED = ErrorBit.RANGE | ErrorBit.CHECKSUM | ErrorBit.INSTRUCTION
"""Error bits that say the very request was not carried out."""

_log = logging.getLogger(__name__)


def _impossible_bits() -> int:
    """Bits of the block 24..49, as a little-endian number, that the control table never sets."""
    mask = 0
    for register in ax12a.REGISTERS:
        if not register.eeprom and register.maximum & (register.maximum + 1) == 0:
            unused = (1 << 8 * register.size) - 1 - register.maximum
            mask |= unused << 8 * (register.address - ax12a.STATUS_BEGIN)
    return mask


IMPOSSIBLE_BITS = _impossible_bits()


class Reply(NamedTuple):
    """What came back to one request; `problem` is empty when it is good."""

    data: bytes = b""
    error: int = 0
    problem: str = ""
    elapsed_ns: int = 0


@dataclass(slots=True)
class _Track:
    """What the bus remembers of one servo between samples."""

    reading: ServoReading
    misses: int = 0
    """Samples in a row without any answer."""
    suspect: tuple[int, int] | None = None
    """Position [tick] and time [ns] of a read that no servo could have moved to; believed if the next one agrees."""


class ServoBus:
    """The servos of one arm behind one port; the port's only user. Not thread-safe."""

    def __init__(self, port: ServoPort, servo_ids: Sequence[int], clock: Clock) -> None:
        self.is_open = False
        self.servo_ids = tuple(servo_ids)
        self.firmware: tuple[int, ...] = ()
        """Firmware version of every servo as `identify` read it; -1: it did not answer."""
        self._port = port
        self._clock = clock
        self._handler = Protocol1PacketHandler()
        self._goal_writer = GroupSyncWrite(port, self._handler, ax12a.GOAL.address, 4)
        self._tracks = [_Track(ServoReading(servo_id, b"", 0, False)) for servo_id in self.servo_ids]
        self._sample_count = 0

    @property
    def port(self) -> ServoPort:
        """The transport; its user is this bus."""
        return self._port

    def open(self) -> None:
        """Open the port.

        Raises:
            PortMissing, PortBusy, PortGone: see the port.
        """
        self._port.openPort()
        self._port.latency_ms = ADAPTER_LATENCY_MS
        self.is_open = True
        for track in self._tracks:
            track.misses, track.suspect = 0, None

    def close(self) -> None:
        """Close the port; does nothing if it is closed."""
        self.is_open = False
        self._port.closePort()

    # ----------------------------------------------------------------------------------------- every tick

    def read_sample(self) -> Sample:
        """Bytes 24..49 of every servo.

        Servo and port trouble is in the sample, never raised. A silent servo costs two reply timeouts at first and
        one of them every fifth sample later.
        """
        begin_ns = self._clock.now_ns()
        self._port.patient_until_ns = begin_ns + SAMPLE_PATIENCE_NS
        self._port.clean = False  # since the last sample anything may have come
        retries = 0
        try:
            for index, track in enumerate(self._tracks):
                if track.misses >= SILENT_MISSES and (self._sample_count + index) % PROBE_EVERY:
                    self._miss(track, NO_REPLY)
                    continue
                problem = self._read_status(track)
                if problem and track.misses < SILENT_MISSES and retries < SAMPLE_RETRIES:
                    retries += 1
                    problem = self._read_status(track)
                if problem:
                    self._miss(track, problem)
        except PortGone as error:
            self._lose_port(error)
            for track in self._tracks:
                self._miss(track, PORT_GONE)
        self._sample_count += 1
        return Sample(
            time_ns=begin_ns,
            servos=tuple(track.reading for track in self._tracks),
            bus_us=(self._clock.now_ns() - begin_ns) // 1000,
            retries=retries,
            port_open=self.is_open,
        )

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
        self._goal_writer.clearParam()
        for servo_id, tick, speed in zip(self.servo_ids, goal.ticks, goal.speeds, strict=True):
            self._goal_writer.addParam(servo_id, [tick & 0xFF, tick >> 8, speed & 0xFF, speed >> 8])
        try:
            self._check_open()
            self._port.clean = True  # nobody answers
            sent: bool = self._goal_writer.txPacket() == COMM_SUCCESS
        except PortGone as error:
            self._lose_port(error)
            return False
        finally:
            self._port.is_using = self._port.clean = False
        return sent

    # -------------------------------------------------------------------------------------------- one servo

    def write(self, write: Write) -> bool:
        """Write one register and have it confirmed; False: no good reply, or the servo refused.

        Raises:
            ValueError: the value does not fit the size, or there is no such servo id.
        """
        if write.size not in (1, 2) or not 0 <= write.value < 1 << 8 * write.size:
            raise ValueError(f"servo {write.servo_id}: {write.value} does not fit {write.size} bytes")
        parameters = (write.address, *write.value.to_bytes(write.size, "little"))
        try:
            reply = self._transact_twice(write.servo_id, INST_WRITE, parameters, 0)
        except PortGone as error:
            self._lose_port(error)
            return False
        if reply.error & REFUSED:
            named = ", ".join(ErrorBit.names(reply.error))
            _log.warning("servo %d refused %d at address %d: %s", write.servo_id, write.value, write.address, named)
        return not reply.problem and not reply.error & REFUSED

    def ping(self, servo_id: int) -> int | None:
        """Model number of a servo; None: it does not answer."""
        return self.read(servo_id, ax12a.MODEL)

    def read(self, servo_id: int, register: Register) -> int | None:
        """Value of one register; None: no good reply."""
        begin = max(0, register.address - 1)  # three bytes, never two: rule 6
        try:
            reply = self._transact_twice(servo_id, INST_READ, (begin, 3), 3)
        except PortGone as error:
            self._lose_port(error)
            return None
        return None if reply.problem else ax12a.register_value(register, reply.data, begin)

    def read_block(self, servo_id: int, begin: int, size: int) -> Reply:
        """Bytes of a servo's control table, with its error bits and the time it took; trouble is in the reply.

        Raises:
            ValueError: two bytes asked for (rule 6), or no such servo id.
        """
        if size == 2:
            raise ValueError("a read of two bytes looks like a reply to itself; read three")
        try:
            return self._transact_twice(servo_id, INST_READ, (begin, size), size)
        except PortGone as error:
            self._lose_port(error)
            return Reply(problem=PORT_GONE)

    def answers_twice(self, servo_id: int) -> bool:
        """Whether more than one servo answers to an id, as far as their replies differ; False without a port."""
        try:
            return self._answers_twice(servo_id)
        except PortGone as error:
            self._lose_port(error)
            return False

    # ------------------------------------------------------------------------------------------- connecting

    def identify(self, arm: ArmConfig) -> tuple[Problem, ...]:
        """Everything that makes this bus unfit for the arm of `arm`; empty: fit.

        Also measures the adapter's latency and sets the port's allowance for it. Takes up to 50 ms a silent servo.
        """
        self._port.latency_ms = IDENTIFY_LATENCY_MS
        self._port.patient_until_ns = self._clock.now_ns() + IDENTIFY_PATIENCE_NS
        try:
            tables = [
                self._transact_twice(joint.servo_id, INST_READ, (0, ax12a.EEPROM_END), ax12a.EEPROM_END)
                for joint in arm.joints
            ]
            if all(table.problem for table in tables):
                self._port.latency_ms = ADAPTER_LATENCY_MS
                garbled = any(table.problem == BUS_NOISE for table in tables)
                return (bus_dead(len(tables), garbled, self._port.port_name, self._port.baudrate),)
            tables = self._ask_again(arm, tables)
            self.firmware = tuple(
                -1 if table.problem else ax12a.register_value(ax12a.FIRMWARE, table.data, 0) for table in tables
            )
            problems = self._adapter_problems(arm, tables)
            for joint, table in zip(arm.joints, tables, strict=True):
                servo = f"servo {joint.servo_id} ({joint.name})"
                if table.problem == NO_REPLY:
                    text = "no reply; check its cable, its supply, its id, and that its status return level is 2"
                    problems.append(Problem("SERVO_SILENT", f"{servo}: {text}", joint.servo_id))
                elif table.problem or self._answers_twice(joint.servo_id):
                    text = "garbled replies while others answer well; two servos with this id, or a bad cable: "
                    text += "connect them one at a time and give each its own id"
                    problems.append(Problem("DUPLICATE_ID", f"{servo}: {text}", joint.servo_id))
                else:
                    problems += table_problems(servo, joint.servo_id, table.data, joint.limits_tick)
        except PortGone as error:
            self._lose_port(error)
            return (Problem(PORT_GONE, str(error)),)
        return tuple(problems)

    def _ask_again(self, arm: ArmConfig, tables: list[Reply]) -> list[Reply]:
        """The tables, those that were not understood read once more after each of `CONFIRM_QUIET_MS`."""
        for quiet_ms in CONFIRM_QUIET_MS:
            if not any(table.problem for table in tables):
                break
            self._port.drain(quiet_ms)
            tables = [
                self._transact(joint.servo_id, INST_READ, (0, ax12a.EEPROM_END), ax12a.EEPROM_END)
                if table.problem
                else table
                for joint, table in zip(arm.joints, tables, strict=True)
            ]
        return tables

    def _adapter_problems(self, arm: ArmConfig, tables: Sequence[Reply]) -> list[Problem]:
        """Judge the adapter by its faster replies, less wire time and that servo's own return delay.

        By the lower quartile: a busy machine is slow now and then, a slow adapter is fast now and then, when a reply
        meets its timer just before that fires.
        """
        wire_ns = (2 * STATUS_OVERHEAD + 2 + ax12a.EEPROM_END) * self._port.byte_ns

        def added_ms(replies: Sequence[Reply]) -> list[float]:
            return sorted(
                (reply.elapsed_ns - wire_ns) / NS_PER_MS
                - 0.002 * ax12a.register_value(ax12a.RETURN_DELAY, reply.data, 0)
                for reply in replies
                if not reply.problem
            )

        latencies_ms = added_ms(tables)
        if median(latencies_ms) > SLOW_ADAPTER_MS:
            self._port.clean = False
            answers = [joint.servo_id for joint, table in zip(arm.joints, tables, strict=True) if not table.problem]
            request = (INST_READ, (0, ax12a.EEPROM_END), ax12a.EEPROM_END)
            latencies_ms = added_ms([*tables, *(self._transact(answers[0], *request) for _ in range(LATENCY_PROBES))])
        latency_ms = latencies_ms[len(latencies_ms) // 4]
        self._port.latency_ms = max(ADAPTER_LATENCY_MS, median(latencies_ms))
        if latency_ms > SLOW_ADAPTER_MS:
            return [slow_adapter(self._port.port_name, latency_ms, SLOW_ADAPTER_MS)]
        self._port.latency_ms = min(self._port.latency_ms, SLOW_ADAPTER_MS)
        return []

    def _answers_twice(self, servo_id: int) -> bool:
        """Whether replies with changing content collide, or a second one follows the first."""
        doubled = sum(self._is_doubled(servo_id) for _ in range(DUPLICATE_PROBES))
        if doubled <= DUPLICATE_PROBES // 2:
            return False
        doubled = 0
        for quiet_ms in CONFIRM_QUIET_MS:
            self._port.drain(quiet_ms)
            doubled += self._is_doubled(servo_id)
        return doubled > len(CONFIRM_QUIET_MS) // 2

    def _is_doubled(self, servo_id: int) -> bool:
        self._port.clean = False
        reply = self._transact(servo_id, INST_READ, (ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE), ax12a.STATUS_SIZE)
        return reply.problem == BUS_NOISE or self._port.drain() > 0

    # ----------------------------------------------------------------------------------------- transactions

    def _read_status(self, track: _Track) -> str:
        """Read one servo into `track`; returns the problem, if any."""
        servo_id = track.reading.servo_id
        reply = self._transact(servo_id, INST_READ, (ax12a.STATUS_BEGIN, ax12a.STATUS_SIZE), ax12a.STATUS_SIZE)
        if not reply.problem and (int.from_bytes(reply.data, "little") & IMPOSSIBLE_BITS):
            reply = self._bad(BUS_NOISE, 0)
        if reply.problem:
            return reply.problem
        now_ns = self._clock.now_ns()
        position = _position(reply.data)
        if not _possible_motion(track, position, now_ns):
            track.suspect = (position, now_ns)
            return BUS_NOISE
        if reply.error != track.reading.error:
            named = ", ".join(ErrorBit.names(reply.error)) or "none"
            _log.warning("servo %d: error bits are now: %s", servo_id, named)
        track.misses, track.suspect = 0, None
        track.reading = ServoReading(servo_id, reply.data, now_ns, True, reply.error)
        return ""

    def _miss(self, track: _Track, problem: str) -> None:
        track.misses = track.misses + 1 if problem == NO_REPLY else 0
        old = track.reading
        track.reading = ServoReading(old.servo_id, old.registers, old.stamp_ns, False, old.error, problem)

    def _transact_twice(self, servo_id: int, instruction: int, parameters: Sequence[int], reply_size: int) -> Reply:
        self._port.clean = False
        reply = self._transact(servo_id, instruction, parameters, reply_size)
        return self._transact(servo_id, instruction, parameters, reply_size) if reply.problem else reply

    def _transact(self, servo_id: int, instruction: int, parameters: Sequence[int], reply_size: int) -> Reply:
        """One request and its reply, checked as far as every instruction allows; after a bad one the line is quiet.

        Raises:
            PortGone: the port vanished or was never opened.
            ValueError: no such servo id.
        """
        if not 0 <= servo_id <= ID_MAX:
            raise ValueError(f"servo id {servo_id} is not in 0..{ID_MAX}")
        request = [0xFF, 0xFF, servo_id, len(parameters) + 2, instruction, *parameters, 0]
        port = self._port
        begin_ns = self._clock.now_ns()
        try:
            self._check_open()
            packet, result, error = self._handler.txRxPacket(port, request)
            elapsed_ns = self._clock.now_ns() - begin_ns
            # The SDK has put the checksum into `request` by now, so an echo equals it.
            if result == COMM_SUCCESS and len(packet) == reply_size + STATUS_OVERHEAD and packet != request:
                port.clean = port.heard == len(packet)
                return Reply(bytes(packet[HEADER_SIZE:-1]), error, "", elapsed_ns)
            silent = result == COMM_TX_FAIL or (result == COMM_RX_TIMEOUT and not port.heard)
            # Noise instead of the reply: an echo, or one that comes too late; the reply itself is still to come.
            due_ms = port.left_ms if port.heard < reply_size + STATUS_OVERHEAD else 0.0
            return self._bad(NO_REPLY if silent else BUS_NOISE, elapsed_ns, due_ms)
        finally:
            port.is_using = False

    def _bad(self, problem: str, elapsed_ns: int, due_ms: float = 0.0) -> Reply:
        """A reply not to be believed; whatever may still be on its way, for `due_ms` perhaps, is drained first."""
        self._port.drain(max(QUIET_MS, due_ms))
        self._port.clean = False
        return Reply(problem=problem, elapsed_ns=elapsed_ns)

    def _check_open(self) -> None:
        if not self.is_open:
            raise PortGone(f"{self._port.port_name}: the bus is closed; open it first")

    def _lose_port(self, error: PortGone) -> None:
        if self.is_open:
            _log.error("%s", error)
        self.is_open = False


def _possible_motion(track: _Track, position: int, now_ns: int) -> bool:
    """Whether a servo can have moved to `position` since it was last read, or since the read that was doubted."""
    reading, suspect = track.reading, track.suspect
    if reading.registers:
        if _reachable(position, _position(reading.registers), now_ns - reading.stamp_ns):
            return True
    elif suspect is None:
        return True
    return suspect is not None and _reachable(position, suspect[0], now_ns - suspect[1])


def _reachable(position: int, before: int, elapsed_ns: int) -> bool:
    way = abs(position - before)
    return way <= MOTION_MARGIN_TICKS or way <= SPEED_BOUND_TICK_S * elapsed_ns / NS_PER_S + MOTION_MARGIN_TICKS


def _position(block: bytes) -> int:
    """Present position [tick] in a block of status bytes."""
    return block[POSITION_AT] | block[POSITION_AT + 1] << 8
