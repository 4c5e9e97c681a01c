"""A port in virtual time: the Dynamixel SDK on one side, the simulated bus on the other, no kernel between.

Rules:

1. Only reading moves the clock, and only to where something happens: the next reply byte, or the packet's deadline.
2. A port that was open when the adapter was pulled out is gone at its next use, though the adapter be back by then.
3. No threads and no real time, so the same calls give the same bytes at the same instants.

Not modelled: the kernel's buffers, scheduling delays, and an adapter that drops what it is sent.
"""

from armctl.clock import VirtualClock
from armctl.dynamixel.port import ServoPort
from armctl.errors import PortBusy, PortGone, PortMissing
from armctl.sim.bus import SimulatedBus


class LoopbackPort(ServoPort):
    """`ServoPort` over a `SimulatedBus`, which runs at whatever baud the port has; waiting costs virtual time only."""

    clock: VirtualClock

    def __init__(self, bus: SimulatedBus, clock: VirtualClock) -> None:
        self._bus, self._plugged = bus, True
        # How often the adapter had been pulled out when the port was opened.
        self._unplugs = 0
        super().__init__("loopback", 1_000_000, clock)

    def unplug(self) -> None:
        """From now on every use of the port raises `PortGone`, and opening it `PortMissing`."""
        self._plugged = False
        self.closePort()

    def replug(self) -> None:
        """Let the port be opened again; one that was open stays gone, as a descriptor does."""
        self._plugged = True

    def setBaudRate(self, baudrate: int) -> bool:
        self._bus.baud = baudrate
        return super().setBaudRate(baudrate)

    def openPort(self) -> bool:
        if not (self._plugged and self._bus.plugged(self.clock.now_ns())):
            raise PortMissing("loopback: unplugged; call replug(), or wait for the end of the fault")
        if self._bus.user not in (None, self):
            raise PortBusy("loopback: another port has this bus; close that one, one program at a time can drive it")
        self._bus.user, self._unplugs = self, self._bus.arm.faults.unplugs
        self.is_open = True
        self.begin_round()
        self.clearPort()
        return True

    def closePort(self) -> None:
        self.is_open = False
        if self._bus.user is self:
            self._bus.user = None

    def getBytesAvailable(self) -> int:
        self._arrive()
        return len(self._received)

    def _discard(self) -> None:
        self._arrive()
        self._received = b""

    def _fill(self, length: int) -> None:
        self._check()
        all_ns, until_ns = self._bus.arrival_ns(length - len(self._received)), self._deadline_ns
        self.clock.sleep_until_ns(until_ns if all_ns is None or all_ns > until_ns else all_ns)
        self._arrive()

    def _send(self, packet: bytes) -> int:
        self._check()
        self._bus.receive(packet, self.clock.now_ns())
        return len(packet)

    def _arrive(self) -> None:
        self._check()
        self._received += self._bus.transmit(self.clock.now_ns())

    def _check(self) -> None:
        # Whether it is plugged in is asked first: that may move the arm over faults that began and ended meanwhile.
        plugged = self.is_open and self._bus.plugged(self.clock.now_ns())
        if not plugged or self._bus.arm.faults.unplugs != self._unplugs:
            self.closePort()
            raise PortGone("loopback: the port vanished; plug the adapter in again")
