"""Bytes in, bytes out, timed: one half-duplex bus with a fleet of simulated servos behind a USB adapter.

A byte takes ten bits at `baud` both ways. A packet is acted on when its last byte has arrived; the reply begins
after the servo's own return delay, once the bus is free, and reaches the host byte by byte or, with an adapter
latency, whenever the adapter's timer fires. More than 100 ms between two bytes put the servos' parser back to the
header search. A servo set to another baud hears nothing. Two servos with one id talk over each other: the bus
carries the bitwise AND. Not modelled: the host talking into a reply, bit errors, the adapter's 62-byte packets.
"""

from __future__ import annotations

from collections import deque
from itertools import zip_longest

import numpy as np

from armctl.clock import NS_PER_S
from armctl.dynamixel.packet import BITS_PER_BYTE, BadChecksum, Decoder, Packet
from armctl.sim.arm import SimulatedArm

BYTE_GAP_NS = 100_000_000
BAUD_TOLERANCE = 0.03


class SimulatedBus:
    """The servos of one arm at the far end of a serial adapter."""

    def __init__(self, arm: SimulatedArm, *, baud: int = 1_000_000, latency_ms: float = 0.0, seed: int = 0) -> None:
        """A quiet bus; the seed draws the phase of the adapter's timer.

        Raises:
            ValueError: the baud is not positive or the latency negative.
        """
        if baud <= 0 or latency_ms < 0.0:
            raise ValueError(f"baud {baud} must be above 0, latency_ms {latency_ms} at least 0")
        self.arm = arm
        self.baud = baud
        """The host's setting; may change at any time."""
        self._latency_ns = round(latency_ms * 1e6)
        self._phase_ns = int(np.random.default_rng(seed).integers(self._latency_ns)) if self._latency_ns else 0
        self._decoder = Decoder()
        self._last_byte_ns: int | None = None
        """When the servos had the last byte of the host."""
        self._quiet_ns = 0
        """When the last reply leaves the wire."""
        self._replies: deque[tuple[int, int]] = deque()
        """Arrival at the host [ns] and value of each byte under way."""

    def receive(self, data: bytes, now_ns: int) -> None:
        """Take bytes of the host.

        Args:
            now_ns: When the first byte leaves the host; it waits for those sent before.
        """
        if not data:
            return
        byte_ns = BITS_PER_BYTE * NS_PER_S // self.baud
        time_ns = now_ns
        if self._last_byte_ns is not None:
            time_ns = max(now_ns, self._last_byte_ns)
            if time_ns - self._last_byte_ns > BYTE_GAP_NS:
                self._decoder.reset()
        for i in range(len(data)):
            time_ns += byte_ns
            for packet in self._decoder.feed(data[i : i + 1]):
                self._dispatch(packet, time_ns, byte_ns)
        self._last_byte_ns = time_ns

    def next_transmit_ns(self) -> int | None:
        """When the next reply byte arrives at the host; None: nothing is under way."""
        return self._replies[0][0] if self._replies else None

    def transmit(self, now_ns: int) -> bytes:
        """Reply bytes that have arrived at the host by `now_ns`, each handed out once."""
        arrived = bytearray()
        while self._replies and self._replies[0][0] <= now_ns:
            arrived.append(self._replies.popleft()[1])
        return bytes(arrived)

    def _dispatch(self, packet: Packet | BadChecksum, time_ns: int, byte_ns: int) -> None:
        self.arm.advance(time_ns)
        statuses: list[bytes] = []
        delay_ns = 0
        for servo in self.arm.servos:
            if abs(servo.baud / self.baud - 1.0) > BAUD_TOLERANCE:
                continue
            servo_delay_ns = servo.return_delay_ns
            status = servo.handle(packet)
            if status is not None:
                statuses.append(status)
                delay_ns = max(delay_ns, servo_delay_ns)
        if not statuses:
            return
        self._quiet_ns = max(time_ns + delay_ns, self._quiet_ns)
        for values in zip_longest(*statuses, fillvalue=0xFF):
            on_wire = 0xFF
            for value in values:
                on_wire &= value
            self._quiet_ns += byte_ns
            self._replies.append((self._arrival_ns(self._quiet_ns), on_wire))

    def _arrival_ns(self, time_ns: int) -> int:
        """When the adapter hands on a byte that it has at `time_ns`."""
        if not self._latency_ns:
            return time_ns
        periods = -((self._phase_ns - time_ns) // self._latency_ns)
        return self._phase_ns + periods * self._latency_ns
