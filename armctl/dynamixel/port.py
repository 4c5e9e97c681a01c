"""The serial port as the Dynamixel SDK wants it, without the SDK's own way of opening, timing and waiting.

Rules:

1. All timing is monotonic and comes from a `Clock`; a reply is waited for as long as it can take and no longer
   (about 4.5 ms for 26 bytes at 1 Mbps, where the SDK waits 34 ms).
2. Reading blocks until the bytes are there or the packet's time is over; nothing spins. The kernel has no say in how
   long: whoever polls or reads an empty terminal while bytes are on their way waits for the kernel's worker (see
   `kernel_worker`), whatever the time limit. So the terminal is asked only once it has told that bytes are there. A
   reply that this worker may keep back is waited for once more, until `patient_until_ns` at most.
3. Bytes that have arrived count even when the host looks late, but one packet hears at most `HEARD_MAX` bytes: a
   babbling line cannot hold the caller.
4. A port has one user. Whatever goes wrong with it is a `PortMissing`, `PortBusy` or `PortGone` that says what to do.
"""

from __future__ import annotations

import array
import errno
import fcntl
import grp
import os
import select
import termios
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import ClassVar

import serial
from dynamixel_sdk import PortHandler
from serial.tools import list_ports

from armctl.clock import NS_PER_S, Clock
from armctl.dynamixel.kernel_worker import KernelWorker
from armctl.errors import BusError, PortBusy, PortGone, PortMissing

NS_PER_MS = 1_000_000
BITS_PER_BYTE = 10
RETURN_DELAY_WORST_US = 508.0
"""Largest value of the servo's return delay register, 254 units of 2 us."""
ADAPTER_LATENCY_MS = 2.0
"""What a USB adapter in low-latency mode may add to a round trip: two frames of 1 ms."""
MARGIN_MS = 1.5
QUIET_MS = 0.5
"""A line silent for this long, and four bytes more, carries no reply."""
KEEPS_UP_NS = NS_PER_MS
"""A kernel worker that is not held up takes a twentieth of it."""
LATELY_NS = NS_PER_S
HEARD_MAX = 256
DRAIN_BYTES = 64
DRAIN_ROUNDS = 8


class ServoPort(PortHandler):  # type: ignore[misc]  # the SDK has no types
    """Base of every transport: the SDK's port contract with all timing by a clock.

    A transport overrides `openPort`, `closePort`, `clearPort`, `getBytesAvailable`, `_receive` and `_send`; the SDK
    and `ServoBus` call the rest. Any of them but `closePort` may raise `PortGone`.
    """

    is_open: bool
    is_using: bool
    baudrate: int
    port_name: str
    byte_ns: int
    """Wire time of one byte [ns]."""
    low_latency: bool | None = None
    """The driver's low-latency flag, read back after opening; None: the driver has none (a pty, for one)."""

    def __init__(self, name: str, baud: int, clock: Clock) -> None:
        super().__init__(name)
        self.clock = clock
        self.return_delay_us = RETURN_DELAY_WORST_US
        self.latency_ms = ADAPTER_LATENCY_MS
        self.heard = 0
        """Bytes read since the last packet timeout was set."""
        self.clean = False
        """Set by the user: nothing waits to be thrown away, so `clearPort` need not ask the driver to."""
        self.patient_until_ns = 0
        """Set by the user: until when a busy machine may make replies late."""
        self._deadline_ns = 0
        self._allowed_ns = 0
        """How long the reply may take; 0: none is due."""
        self._asked_again = False
        """Whether this reply was waited for once more already."""
        self._request_size = 0
        self.setBaudRate(baud)

    # ------------------------------------------------------------------------------------ for the transport

    def _receive(self, length: int) -> bytes:
        """Up to `length` bytes; waits for them until `_deadline_ns`, then returns what has arrived."""
        raise NotImplementedError

    def _send(self, packet: bytes) -> int:
        """Hand `packet` to the line without blocking; the number of bytes taken."""
        raise NotImplementedError

    def _kept_back(self) -> bool:
        """Whether the machine may keep back what has been sent."""
        return False

    # ------------------------------------------------------------------------------------------ for the SDK

    def setBaudRate(self, baudrate: int) -> bool:
        """Set the rate [bit/s]; an open port is opened again with it."""
        self.baudrate = baudrate
        self.byte_ns = BITS_PER_BYTE * NS_PER_S // baudrate
        if self.is_open:
            self.closePort()
            self.openPort()
        return True

    def getCurrentTime(self) -> float:
        """Monotonic time [ms]."""
        return self.clock.now_ns() / NS_PER_MS

    def setPacketTimeout(self, packet_length: int) -> None:
        """Start waiting for a reply of `packet_length` bytes to the packet written last.

        Request and reply on the wire, the servo's return delay, the adapter's latency and a margin.
        """
        wire_ns = (self._request_size + packet_length) * self.byte_ns
        slack_ms = self.return_delay_us / 1000.0 + self.latency_ms + MARGIN_MS
        self._asked_again = False
        self._allowed_ns = wire_ns + round(slack_ms * NS_PER_MS)
        self._deadline_ns = self.clock.now_ns() + self._allowed_ns
        self.heard = 0

    def setPacketTimeoutMillis(self, msec: float) -> None:
        """Start waiting for `msec` milliseconds."""
        self._deadline_ns = self.clock.now_ns() + round(msec * NS_PER_MS)
        self._allowed_ns = self.heard = 0

    @property
    def left_ms(self) -> float:
        """What is left of the packet's time; negative when it is over."""
        return (self._deadline_ns - self.clock.now_ns()) / NS_PER_MS

    def isPacketTimeout(self) -> bool:
        """Whether the packet's time, or its share of bytes, is used up."""
        return self.clock.now_ns() >= self._deadline_ns or self.heard >= HEARD_MAX

    def readPort(self, length: int) -> bytes:
        """Up to `length` bytes, waiting for them until the packet timeout."""
        if length <= 0 or self.heard >= HEARD_MAX:
            return b""
        data = self._receive(length)
        self.heard += len(data)
        return data

    def writePort(self, packet: Sequence[int]) -> int:
        """Send a packet; the number of bytes taken, fewer if the line is stuck."""
        self._request_size = len(packet)
        return self._send(bytes(packet))

    # ------------------------------------------------------------------------------------------ for the bus

    def drain(self, quiet_ms: float = QUIET_MS) -> int:
        """Read until the line is silent for `quiet_ms`, or has spoken a few times; the number of bytes thrown away."""
        quiet_ms += 4 * self.byte_ns / NS_PER_MS
        drained = 0
        for _ in range(DRAIN_ROUNDS):
            self.setPacketTimeoutMillis(quiet_ms)
            data = self.readPort(DRAIN_BYTES)
            if not data and not self._kept_back():
                break
            drained += len(data)
        return drained


BY_ID = Path("/dev/serial/by-id")


def _usb_identity(path: str) -> Path | None:
    """The name under /dev/serial/by-id of the adapter at `path`; None for a port that has none (a pty)."""
    device = Path(path).resolve()
    return next((link for link in sorted(BY_ID.glob("*")) if link.resolve() == device), None)


class SerialPort(ServoPort):
    """A tty: exclusive, raw, non-blocking, with low latency where the driver knows it.

    The first opening remembers the adapter by its USB identity (/dev/serial/by-id carries the serial number); every
    later one looks for that adapter, whatever name the kernel gave it after a replug, and takes no other.
    """

    ser: serial.Serial | None
    _fd = -1
    _arrivals: select.epoll
    """Tells of arrived bytes once, and asks the terminal for nothing until it has told of some (rule 2)."""
    _worker: KernelWorker | None
    _late_ns = -NS_PER_S
    """When the worker was last seen to be late."""
    _received = b""
    """Bytes that came with those asked for."""
    _ASYNC_LOW_LATENCY: ClassVar[int] = 0x2000

    def __init__(self, name: str, baud: int, clock: Clock) -> None:
        self._identity: Path | None = None
        self._opened = ExitStack()
        super().__init__(name, baud, clock)

    def openPort(self) -> bool:
        """Open the port for this process alone.

        Raises:
            PortMissing: no such port, no serial port, or no permission; the text lists what is there.
            PortBusy: another process holds it; the text names the process where /proc shows it.
        """
        if self.is_open:
            self.closePort()
        path = str(self._identity or self.port_name)
        try:
            self.ser = serial.Serial(path, self.baudrate, timeout=0, exclusive=True)
            self._fd = self.ser.fileno()
            self._arrivals = self._opened.enter_context(select.epoll())
            self._arrivals.register(self._fd, select.EPOLLIN | select.EPOLLET)
            self._worker = self._watched_worker()
            # The mark lives until the tty's last descriptor closes. Who owns a pty's master may hold its slave too,
            # and would lock us out after a crash of ours; there the advisory lock must do.
            if not _is_pty(self._fd):
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
        except (OSError, termios.error, ValueError) as error:
            self.closePort()
            raise _open_error(path, self.baudrate, error) from None
        self._identity = self._identity or _usb_identity(self.port_name)
        self.low_latency = self._ask_low_latency(self.ser)
        self.is_open = True
        return True

    def closePort(self) -> None:
        self._opened.close()
        self.is_open, self._fd = False, -1
        if self.ser is not None:
            with suppress(OSError):  # an unplugged device may refuse even this; the descriptor is gone all the same
                self.ser.close()
            self.ser = None

    def clearPort(self) -> None:
        """Throw away what was received and not read."""
        self._check()
        if self._received or not self.clean:
            self._received = b""
            self._arrivals.poll(0)  # before the bytes it tells of are gone
            try:
                termios.tcflush(self._fd, termios.TCIFLUSH)
            except (OSError, termios.error) as error:
                raise self._gone(error) from None

    def getBytesAvailable(self) -> int:
        self._check()
        assert self.ser is not None
        try:
            return len(self._received) + self.ser.in_waiting
        except (OSError, termios.error) as error:
            raise self._gone(error) from None

    def _receive(self, length: int) -> bytes:
        if len(self._received) < length:
            self._check()
            try:
                self._fill(length)
            except (OSError, termios.error) as error:
                raise self._gone(error) from None
        data, self._received = self._received[:length], self._received[length:]
        return data

    def _fill(self, length: int) -> None:
        """Read until `length` bytes are there or the packet's time is over."""
        now_ns = self.clock.now_ns
        while len(self._received) < length:
            wait_ns = self._deadline_ns - now_ns()
            if self._received or self.heard:
                # What follows needs its time on the wire, and where an adapter cut the reply, the adapter's.
                rest_ns = (length - len(self._received)) * self.byte_ns
                wait_ns = min(wait_ns, rest_ns + round((self.latency_ms + QUIET_MS) * NS_PER_MS))
            # `select`, because `poll` of epoll itself waits whole milliseconds.
            if not select.select((self._arrivals,), (), (), max(0, wait_ns) / NS_PER_S)[0]:
                if not self._allowed_ns or not self._kept_back():
                    break
                self._deadline_ns = now_ns() + self._allowed_ns
                continue
            if not self._arrivals.poll(0):
                continue
            arrived = os.read(self._fd, HEARD_MAX)
            if not arrived:
                raise OSError(errno.EIO, "end of file")
            self._received += arrived

    def _watched_worker(self) -> KernelWorker | None:
        try:
            worker = KernelWorker()
        except OSError:  # there are no pseudo terminals here; then what is late counts as lost
            return None
        self._opened.callback(worker.close)
        return worker

    def _kept_back(self) -> bool:
        now_ns = self.clock.now_ns()
        if self._worker is None or now_ns >= self.patient_until_ns:
            return False
        if self._worker.delay_ns(self.clock, self.patient_until_ns) > KEEPS_UP_NS:
            self._late_ns = self.clock.now_ns()
            return True
        # It keeps up just now; a moment ago, when the request or the reply was on its way, it may not have.
        first, self._asked_again = not self._asked_again, True
        return first and now_ns - self._late_ns < LATELY_NS

    def _send(self, packet: bytes) -> int:
        self._check()
        try:
            try:
                sent = os.write(self._fd, packet)
            except BlockingIOError:
                sent = 0
            if sent < len(packet):  # nothing that waits here may reach the servos later, in a burst
                termios.tcflush(self._fd, termios.TCOFLUSH)
        except (OSError, termios.error) as error:
            raise self._gone(error) from None
        return sent

    def _check(self) -> None:
        if self._fd < 0:
            raise PortGone(f"{self.port_name}: the port is not open; open it first")

    def _gone(self, error: Exception) -> PortGone:
        """Unplugging shows as OSError, SerialException (one of them) or termios.error (none of them)."""
        return PortGone(f"{self.port_name}: the port vanished ({_reason(error)}); plug the adapter in again")

    def _ask_low_latency(self, ser: serial.Serial) -> bool | None:
        state = array.array("i", [0] * 32)
        try:
            ser.set_low_latency_mode(True)
            fcntl.ioctl(ser.fileno(), termios.TIOCGSERIAL, state)
        except (ValueError, OSError):
            return None
        return bool(state[4] & self._ASYNC_LOW_LATENCY)


def _is_pty(fd: int) -> bool:
    return 136 <= os.major(os.fstat(fd).st_rdev) <= 143  # Unix98 pty slaves


def _reason(error: Exception) -> str:
    number = error.args[0] if error.args else None
    return os.strerror(number) if isinstance(number, int) else str(error)


def _open_error(path: str, baud: int, error: Exception) -> BusError:
    """The expected failure behind what open, flock, ioctl or tcsetattr raised."""
    number = error.args[0] if error.args else None
    if number == errno.ENOENT:
        found = sorted(port.device for port in list_ports.comports() if port.hwid != "n/a")
        return PortMissing(
            f"{path}: no such port; found: {', '.join(found) or 'no USB serial port at all'}; "
            "plug the adapter in, or name another port with --port"
        )
    if number in (errno.EBUSY, errno.EAGAIN):
        holders = ", ".join(_holders(path)) or "another process (of another user)"
        return PortBusy(f"{path}: in use by {holders}; stop it, one program at a time can drive the bus")
    if number in (errno.EACCES, errno.EPERM):
        group = _group(path)
        return PortMissing(
            f"{path}: no permission; it belongs to group {group}: sudo usermod -aG {group} $USER, then log in again"
        )
    if isinstance(error, ValueError):
        return PortMissing(f"{path}: the adapter cannot do {baud} baud ({error}); set another baud rate")
    return PortMissing(f"{path}: no usable serial port ({_reason(error)}); name another one with --port")


def _holders(path: str) -> list[str]:
    """Processes that have the port open, as far as /proc lets us see: `name (pid 123)`."""
    device = os.path.realpath(path)
    found: dict[str, str] = {}
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        try:
            if os.readlink(link) == device:
                process = link.parent.parent
                found[process.name] = f"{(process / 'comm').read_text().strip()} (pid {process.name})"
        except OSError:  # ended meanwhile, or not ours to see
            continue
    return list(found.values())


def _group(path: str) -> str:
    gid = os.stat(path).st_gid
    try:
        return grp.getgrgid(gid).gr_name
    except KeyError:
        return str(gid)
