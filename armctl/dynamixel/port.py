"""The contract between the bus and whatever carries its bytes; `tests/conformance/test_port.py` holds every transport.

What a port promises:

1. One user. `openPort` takes the line for this port alone; it raises `PortBusy` while another has it, and `PortMissing`
   where there is no line to open. Opening an open port opens it anew. `closePort` never raises.
2. One clock. All timing is monotonic and comes from the port's `Clock`.
3. Reading blocks. `readPort` returns when as many bytes as asked for are there, or at the packet's deadline with those
   that have come. Bytes that have arrived count even when the host looks late, but one packet hears at most
   `HEARD_MAX` bytes: a babbling line cannot hold the caller.
4. Writing does not block. `writePort` tells how many bytes the line took; what it did not take is never sent.
5. The deadline of a reply is the time that the reply can take and no more: request and reply on the wire, the servo's
   return delay, the adapter's latency (`allow_latency`) and a margin. For 26 bytes at 1 Mbps that is about 4.5 ms,
   where the SDK waits 34 ms.
6. `clearPort` throws away what came and was not read. It may leave that out, because it is a system call, between two
   requests of one round (`begin_round`) if the reply in between had exactly the bytes that were due.
7. `drain` reads until the line is silent, but not before the reply that is due had its time.
8. A busy machine may hand replies over late. Until the instant given to `begin_round` the port waits once more where
   it can tell that this is the reason; after it, what is late is lost.
9. A port that has vanished raises `PortGone` at every use but `closePort`, until it is opened again. So does a port
   that was never opened. The text says what to do.
10. `take_wire` tells the bytes that were sent, and those that were read, whoever threw them away then, with the time by
   which they had been read. What a driver threw away unread nobody knows.
"""

from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Sequence

from dynamixel_sdk import COMM_RX_TIMEOUT, COMM_SUCCESS, COMM_TX_FAIL, PortHandler, Protocol1PacketHandler

from armctl.clock import Clock
from armctl.dynamixel.packet import OVERHEAD_BYTES, WHOLE_SUM, wire_ns

NS_PER_MS = 1_000_000
# Largest value of the servo's return delay register, 254 units of 2 us.
RETURN_DELAY_WORST_US = 508.0
# What a USB adapter in low-latency mode may add to a round trip: two frames of 1 ms.
ADAPTER_LATENCY_MS = 2.0
MARGIN_MS = 1.5
# A line silent for this long, and four bytes more, carries no reply.
QUIET_MS = 0.5
HEARD_MAX = 256
DRAIN_BYTES = 64
DRAIN_ROUNDS = 8
# Most pieces kept for `take_wire`, of a packet each; a tick has about 15.
WIRE_PIECES = 512
# Largest error byte that the SDK takes for one of a status packet.
ERROR_MAX = 0x7F

_sdk = Protocol1PacketHandler()


class ServoPort(PortHandler, ABC):  # type: ignore[misc]  # the SDK has no types
    """Base of every transport: the contract above, with all that does not depend on what carries the bytes.

    A transport overrides the abstract methods; the SDK and `ServoBus` call the rest.
    """

    baudrate: int
    # Wire time of one byte [ns].
    byte_ns: int
    # The driver's low-latency flag, read back after opening; None: the driver has none (a pty, for one).
    low_latency: bool | None = None

    def __init__(self, name: str, baud: int, clock: Clock) -> None:
        # The SDK's own fields for time limits are left out: an object of more than 30 fields is looked through slowly,
        # which took a third of the processor time of a reading.
        self.is_open = self.is_using = False
        self.port_name = name
        self.clock, self._now_ns = clock, clock.now_ns
        # Bytes read since the last request.
        self.heard = 0
        self.allow_latency(ADAPTER_LATENCY_MS)
        # Bytes that have arrived and were not read.
        self._received = b""
        self._patient_until_ns = 0
        # Whether nothing can have come in this round that was not asked for.
        self._clean = False
        # When the clock was looked at for the last reply, if the next request follows at once; 0: look again.
        self._begin_ns = 0
        self._deadline_ns = 0
        # How long the reply may take; 0: none is due.
        self._allowed_ns = 0
        # Bytes of the reply that is due.
        self._due = 0
        self._request_size = 0
        # When the last reply to `ask` had been read [ns].
        self.arrived_ns = 0
        # For `take_wire`, and what was read since the last piece of it.
        self._wire: deque[tuple[int, bool, bytes]] = deque(maxlen=WIRE_PIECES)
        self._read = b""
        self.setBaudRate(baud)

    # ------------------------------------------------------------------------------------ for the transport

    @abstractmethod
    def openPort(self) -> bool:
        """Take the line; True.

        Raises:
            PortMissing, PortBusy: see rule 1.
        """

    @abstractmethod
    def closePort(self) -> None:
        """Let the line go."""

    @abstractmethod
    def getBytesAvailable(self) -> int:
        """How many bytes can be read without waiting."""

    @abstractmethod
    def _fill(self, length: int) -> None:
        """Wait until `length` bytes are in `_received`, or until `_deadline_ns`."""

    @abstractmethod
    def _send(self, packet: bytes) -> int:
        """Hand `packet` to the line without blocking; the number of bytes taken."""

    @abstractmethod
    def _discard(self) -> None:
        """Throw away what has arrived."""

    def _kept_back(self) -> bool:
        """Whether the machine may keep back what has been sent."""
        return False

    # ------------------------------------------------------------------------------------------ for the SDK

    def setBaudRate(self, baudrate: int) -> bool:
        """Set the rate [bit/s]; an open port is opened again with it."""
        self.baudrate = baudrate
        self.byte_ns = wire_ns(baudrate)
        if self.is_open:
            self.closePort()
            self.openPort()
        return True

    def getCurrentTime(self) -> float:
        """Monotonic time [ms]."""
        return self._now_ns() / NS_PER_MS

    def setPacketTimeout(self, packet_length: int) -> None:
        """Begin to wait for a reply of `packet_length` bytes to the packet written last (rule 5)."""
        self._allowed_ns = (self._request_size + packet_length) * self.byte_ns + self._slack_ns
        self._deadline_ns = (self._begin_ns or self._now_ns()) + self._allowed_ns
        self._due = packet_length
        self._begin_ns = self.heard = 0

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Begin to wait for `msec` milliseconds."""
        self._deadline_ns = self._now_ns() + round(msec * NS_PER_MS)
        self._allowed_ns = self._due = self._begin_ns = self.heard = 0

    def isPacketTimeout(self) -> bool:
        """Whether the packet's time, or its share of bytes, is used up."""
        return self.heard >= HEARD_MAX or self._now_ns() >= self._deadline_ns

    def readPort(self, length: int) -> bytes:
        """Up to `length` bytes, waiting for them until the packet timeout."""
        data = self.peek(length) if length > 0 else b""
        self._received = self._received[len(data) :]
        self.heard += len(data)
        self._read += data
        return data

    def peek(self, length: int) -> bytes:
        """What `readPort` would return, which then returns it again at once."""
        if self.heard >= HEARD_MAX:
            return b""
        if len(self._received) < length:
            self._fill(length)
        return self._received[:length]

    def writePort(self, packet: Sequence[int]) -> int:
        """Send a packet; the number of bytes taken, fewer if the line is stuck."""
        self._request_size = len(packet)
        now_ns = self._begin_ns or self._now_ns()
        taken = self._send(data := bytes(packet))
        self._stamp_read(now_ns)
        self._wire.append((now_ns, True, data[:taken]))
        return taken

    def clearPort(self) -> None:
        """Throw away what was received and not read (rule 6)."""
        if self._received or not (self._clean and self.heard == self._due > 0):
            self._read += self._received
            self._received = b""
            self._discard()
            self._clean, self._begin_ns = True, 0  # a driver may have taken its time over it

    # ------------------------------------------------------------------------------------------ for the bus

    def begin_round(self, patience_ns: int | None = None) -> int:
        """Begin a number of requests that follow one another at once; what came since the last of them is stray.

        Args:
            patience_ns: For how long a busy machine may make replies late (rule 8); None: as long as said before.
        Returns:
            The time now [ns].
        """
        now_ns = self._now_ns()
        self._clean, self._begin_ns = False, 0
        if patience_ns is not None:
            self._patient_until_ns = now_ns + patience_ns
        return now_ns

    def ask(self, request: bytes, size: int) -> tuple[bytes, int]:
        """Send a request to one servo; its status packet, `size` bytes if it is good, and how receiving it went.

        As the SDK's `txRxPacket` has it: packets of other servos are passed over, and it waits as long. But the reply
        that comes nearly always, the one that is due, whole, alone and with a good checksum, is taken at a glance: the
        SDK looks at every byte in Python, which was half of the processor time of a reading.
        """
        self.clearPort()
        if self.writePort(request) < len(request):
            return b"", COMM_TX_FAIL
        self.setPacketTimeout(size)
        if not self._received:
            self._fill(OVERHEAD_BYTES)
        reply = self._received
        # Header and id as in the request, the length that is due, an error byte that may be one.
        if (
            len(reply) >= OVERHEAD_BYTES
            and reply[:3] == request[:3]
            and reply[3] == size - 4
            and reply[4] <= ERROR_MAX
            and (len(reply) >= size or len(self.peek(size)) == size)
            and sum(self._received[:size]) & 0xFF == WHOLE_SUM
        ):
            reply, result = self.readPort(size), COMM_SUCCESS
        else:
            reply, result = self._search(request[2], size) if reply else (b"", COMM_RX_TIMEOUT)
        # The wait for the next reply of the round begins here.
        self.arrived_ns = self._begin_ns = self._now_ns()
        self._stamp_read(self.arrived_ns)
        return reply, result

    def _search(self, servo_id: int, size: int) -> tuple[bytes, int]:
        """The SDK's search for the packet of a servo, in whatever has come and is still to come.

        One of it that holds nothing says that an earlier request came damaged; the reply may stand behind it.
        """
        while True:
            packet, result = _sdk.rxPacket(self)
            if result != COMM_SUCCESS or (packet[2] == servo_id and not OVERHEAD_BYTES == len(packet) < size):
                return bytes(packet), result

    def take_wire(self) -> tuple[tuple[int, bool, bytes], ...]:
        """What went over the wire since the last call: when [ns], whether it was sent, and the bytes (rule 10)."""
        self._stamp_read(self._now_ns())
        wire = tuple(self._wire)
        self._wire.clear()
        return wire

    def _stamp_read(self, now_ns: int) -> None:
        """Make what was read since the last piece a piece of the wire that was read by now."""
        if self._read:
            self._wire.append((now_ns, False, self._read))
            self._read = b""

    def allow_latency(self, latency_ms: float) -> None:
        """From now on wait so much longer for a reply, because the adapter may keep it back."""
        self._latency_ms = latency_ms
        self._slack_ns = round((RETURN_DELAY_WORST_US / 1000.0 + latency_ms + MARGIN_MS) * NS_PER_MS)

    def drain(self, quiet_ms: float = QUIET_MS, rounds: int = DRAIN_ROUNDS) -> int:
        """Read until the line is silent for `quiet_ms`, or has spoken `rounds` times; how many bytes were dropped."""
        if self.heard < self._due:  # the reply may still come
            quiet_ms = max(quiet_ms, (self._deadline_ns - self._now_ns()) / NS_PER_MS)
        quiet_ms += 4 * self.byte_ns / NS_PER_MS
        self._clean = False
        drained = 0
        for _ in range(rounds):
            self.setPacketTimeoutMillis(quiet_ms)
            data = self.readPort(DRAIN_BYTES)
            if not data and not self._kept_back():
                break
            drained += len(data)
        return drained
