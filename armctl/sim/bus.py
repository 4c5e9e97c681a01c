"""Bytes in, bytes out, timed: one half-duplex bus with a fleet of simulated servos behind a USB adapter.

A byte takes ten bits at `baud` both ways. A packet is acted on when its last byte has arrived; the reply begins
after the servo's own return delay (and, if the arm asks for it, what its firmware takes), once the bus is free, and
reaches the host byte by byte or, with an adapter latency, whenever the adapter's timer fires. More than 100 ms between
two bytes put the servos' parser back to the header search. A servo set to another baud hears nothing. Two servos that
answer at once talk over each other: the bus carries the bitwise AND. What goes wrong on the way is up to `faults`. Not
modelled: the host talking into a reply, the adapter's 62-byte packets.
"""

from bisect import bisect_right
from collections.abc import Sequence
from itertools import pairwise, zip_longest

import numpy as np

from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, BadChecksum, Decoder, Instruction, Packet, encode_status, wire_ns
from armctl.sim.arm import SimulatedArm
from armctl.sim.servo import SimulatedServo

BYTE_GAP_NS = 100_000_000
# Bytes farther apart than this reach the host one after another; a byte at 57,600 baud takes 174 us.
PAUSE_NS = 200_000
BAUD_TOLERANCE = 0.03
# What the firmware needs for a reply on top of its return delay, by instruction, and for each byte that it writes.
REPLY_NS: dict[int, int] = {Instruction.PING: 18_000, Instruction.READ: 22_000, Instruction.WRITE: 24_000}
WRITE_BYTE_NS = 6_000
# For each byte that goes to its EEPROM a servo hears nothing for so long.
EEPROM_BYTE_NS = 6_000_000


class SimulatedBus:
    """The servos of one arm at the far end of a serial adapter."""

    def __init__(self, arm: SimulatedArm, *, baud: int = 1_000_000, latency_ms: float = 0.0, seed: int = 0) -> None:
        """A quiet bus; the seed draws the phase of the adapter's timer."""
        self.arm = arm
        self._servo_ids = arm.config.servo_ids
        # The host's setting; may change at any time.
        self.baud = baud
        # The port that has this bus for itself, if there is one.
        self.user: object = None
        self._latency_ns = round(latency_ms * 1e6)
        self._phase_ns = int(np.random.default_rng(seed).integers(self._latency_ns)) if self._latency_ns else 0
        self._decoder = Decoder()
        # When the servos had the last byte of the host.
        self._last_byte_ns: int | None = None
        # When the last reply leaves the wire.
        self._quiet_ns = 0
        # The bytes under way to the host.
        self._replies = b""
        # When each of them gets there.
        self._arrivals_ns: Sequence[int] = ()
        # Which servos hear a packet, by whom it is to.
        self._hearers: dict[int, list[int]] = {}
        # At how many writes to EEPROMs, and at which baud, that was so.
        self._listed_for = (-1, 0)
        # The second servos with an id that is taken, by the number of their fault.
        self._strangers: dict[int, SimulatedServo] = {}

    def plugged(self, now_ns: int) -> bool:
        """Whether the adapter is in the host."""
        if not self.arm.faults.planned:
            return True
        self.arm.advance(now_ns)
        return self.arm.faults.in_force("unplug") is None

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host.

        Args:
            now_ns: When the first byte leaves the host; it waits for those sent before.
        """
        byte_ns = wire_ns(self.baud)
        decoder, time_ns = self._decoder, now_ns
        if self._last_byte_ns is not None:
            time_ns = max(now_ns, self._last_byte_ns)
            if time_ns - self._last_byte_ns > BYTE_GAP_NS:
                decoder.reset()
        echo = False
        if self.arm.faults.planned:
            self.arm.advance(now_ns)
            echo = self.arm.faults.in_force("echo") is not None
        if not echo and (whole := decoder.whole(data)) is not None:
            self._last_byte_ns = time_ns = time_ns + len(data) * byte_ns
            self._dispatch(whole, time_ns, byte_ns)
            return
        at = 0
        while at < len(data):
            piece = data[at : at + decoder.wanted]
            at += len(piece)
            if echo:
                self._hand_on(piece, time_ns, byte_ns)
            time_ns += len(piece) * byte_ns
            for packet in decoder.feed(piece):
                self._dispatch(packet, time_ns, byte_ns)
        self._last_byte_ns = time_ns

    def burst_end_ns(self) -> int | None:
        """When the last of the reply bytes arrives that follow one another without a pause; None: there are none."""
        arrivals_ns = self._arrivals_ns
        before_pauses = (end_ns for end_ns, begin_ns in pairwise(arrivals_ns) if begin_ns - end_ns > PAUSE_NS)
        return next(before_pauses, arrivals_ns[-1] if arrivals_ns else None)

    def arrival_ns(self, count: int = 1) -> int | None:
        """When so many reply bytes will have arrived at the host; None: fewer are under way."""
        return self._arrivals_ns[count - 1] if count <= len(self._arrivals_ns) else None

    def transmit(self, now_ns: int) -> bytes:
        """Reply bytes that have arrived at the host by `now_ns`, each handed out once."""
        if not self._arrivals_ns:
            return b""
        count = bisect_right(self._arrivals_ns, now_ns)
        arrived, self._replies = self._replies[:count], self._replies[count:]
        self._arrivals_ns = self._arrivals_ns[count:]
        return arrived

    def _dispatch(self, packet: Packet | BadChecksum, time_ns: int, byte_ns: int) -> None:
        arm, to = self.arm, packet.servo_id
        if (arm.eeprom_writes, self.baud) != self._listed_for:
            self._list_hearers()
        hearers = self._hearers.get(to, ())
        faults = arm.faults
        one_reply = len(hearers) == 1 or (to == BROADCAST_ID and not arm.spec.variants.broadcast_ping_answered)
        if one_reply and not faults.planned:  # nearly all
            arm.advance(time_ns, hearers[0] if len(hearers) == 1 else None)
            for i in hearers:
                status, delay_ns = self._told(arm.servos[i], packet, time_ns)
                if status is not None:
                    self._quiet_ns = max(time_ns + delay_ns, self._quiet_ns)
                    self._speak(status, byte_ns, 0)
            return
        arm.advance(time_ns)
        if faults.in_force("dead_bus"):
            return
        if faults.in_force("same_id"):  # a stranger hears what is told to another servo
            hearers = self._hearers[BROADCAST_ID]
        statuses: list[bytes] = []
        delay_ns = late_ns = 0
        for i in hearers:
            servo_id, servo = self._servo_ids[i], arm.servos[i]
            if servo.booting or faults.in_force("mute", servo_id):
                continue
            status, servo_delay_ns = self._told(servo, packet, time_ns)
            if to == servo_id and (noise := faults.happening("garbage", servo_id)):
                self._quiet_ns = max(time_ns, self._quiet_ns)
                self._speak(noise.rng.bytes(round(noise.amount)), byte_ns, 0)
            if status is not None:
                status, servo_late_ns = self._spoil(status, servo_id)
                late_ns = max(late_ns, servo_late_ns)
            if stranger := self._stranger(servo_id, servo):
                statuses += filter(None, [stranger.handle(packet)])
            if status is not None:
                statuses.append(status)
                delay_ns = max(delay_ns, servo_delay_ns)
        if not statuses:
            return
        self._quiet_ns = max(time_ns + delay_ns, self._quiet_ns)
        on_wire = statuses[0]
        for status in statuses[1:]:
            on_wire = bytes(a & b for a, b in zip_longest(on_wire, status, fillvalue=0xFF))
        self._speak(on_wire, byte_ns, late_ns)

    def _told(self, servo: SimulatedServo, packet: Packet | BadChecksum, time_ns: int) -> tuple[bytes | None, int]:
        """What a servo answers, and after how long [ns]."""
        if servo.booting or time_ns < servo.deaf_until_ns:
            return None, 0
        delay_ns, written = servo.return_delay_ns, servo.eeprom_writes
        status = servo.handle(packet)
        if self.arm.spec.firmware_takes_time and isinstance(packet, Packet):
            delay_ns += REPLY_NS.get(packet.code, REPLY_NS[Instruction.WRITE])
            if packet.code == Instruction.WRITE:
                delay_ns += max(0, len(packet.parameters) - 1) * WRITE_BYTE_NS
            servo.deaf_until_ns = time_ns + (servo.eeprom_writes - written) * EEPROM_BYTE_NS
        return status, delay_ns

    def _list_hearers(self) -> None:
        """Note which servos hear what is said to whom: this changes with an EEPROM, or with the host's baud."""
        hearers: dict[int, list[int]] = {BROADCAST_ID: []}
        for i, servo in enumerate(self.arm.servos):
            if abs(servo.baud / self.baud - 1.0) <= BAUD_TOLERANCE:
                hearers[BROADCAST_ID].append(i)
                hearers.setdefault(servo.servo_id, []).append(i)
        self._hearers, self._listed_for = hearers, (self.arm.eeprom_writes, self.baud)

    def _spoil(self, status: bytes, servo_id: int) -> tuple[bytes | None, int]:
        """What the faults leave of a reply, and how much later [ns] it reaches the host."""
        faults = self.arm.faults
        if faults.happening("lost", servo_id):
            return None, 0
        if struck := faults.happening("wrong_id", servo_id):
            wrong = (servo_id + 1) % (ax12a.ID.maximum + 1) if struck.fault.value is None else round(struck.amount)
            status = encode_status(wrong, status[4], status[5:-1])
        if struck := faults.happening("corrupted", servo_id):
            at = int(struck.rng.integers(len(status)))
            wrong = status[at] ^ int(struck.rng.integers(1, 256))
            status = status[:at] + bytes((wrong,)) + status[at + 1 :]
        if struck := faults.happening("truncated", servo_id):
            keeps = int(struck.rng.integers(1, len(status))) if struck.fault.value is None else round(struck.amount)
            status = status[:keeps]
        if faults.happening("duplicated", servo_id):
            status += status
        late = faults.happening("late", servo_id)
        return status, round(late.amount * 1e6) if late else 0

    def _stranger(self, servo_id: int, servo: SimulatedServo) -> SimulatedServo | None:
        """The second servo with this id, if there is one: alike but for its position."""
        planned = self.arm.faults.in_force("same_id", servo_id)
        if planned is None:
            return None
        if planned.id not in self._strangers:
            away_tick = -100.0 if servo.position_tick > ax12a.TICK_MAX / 2 else 100.0
            position_tick, noise_tick = servo.position_tick + away_tick, self.arm.spec.noise_tick
            stranger = SimulatedServo(servo_id, planned.rng, position_tick=position_tick, noise_tick=noise_tick)
            stranger.table[: ax12a.EEPROM_END] = servo.table[: ax12a.EEPROM_END]
            self._strangers[planned.id] = stranger
        return self._strangers[planned.id]

    def _speak(self, data: bytes, byte_ns: int, late_ns: int) -> None:
        """Put bytes on the wire as soon as it is quiet."""
        self._hand_on(data, self._quiet_ns + late_ns, byte_ns)
        self._quiet_ns += len(data) * byte_ns

    def _hand_on(self, data: bytes, time_ns: int, byte_ns: int) -> None:
        """Let bytes that come to the adapter one after another from `time_ns` on reach the host, after those before."""
        arrivals_ns: Sequence[int] = range(time_ns + byte_ns, time_ns + len(data) * byte_ns + 1, byte_ns)
        latency_ns = self._latency_ns
        if self.arm.faults.planned and (other := self.arm.faults.in_force("latency")):
            latency_ns = round(other.amount * 1e6)
        if latency_ns:  # the adapter hands on what it has when its timer fires
            phase_ns = self._phase_ns
            arrivals_ns = [phase_ns - (phase_ns - at_ns) // latency_ns * latency_ns for at_ns in arrivals_ns]
        before_ns = self._arrivals_ns
        if before_ns:
            arrivals_ns = [*before_ns, *(max(at_ns, before_ns[-1]) for at_ns in arrivals_ns)]
        self._arrivals_ns = arrivals_ns
        self._replies += data
