"""A serial port, real or pseudo, as the bus wants it (see `port`).

Two rules more than the contract has:

1. Reading blocks until the bytes are there or the packet's time is over; nothing spins. The kernel has no say in how
   long: whoever polls or reads an empty terminal while bytes are on their way waits for the kernel's worker (see
   `kernel_worker`), whatever the time limit. So the terminal is asked only once it has told that bytes are there. A
   reply that this worker may keep back is waited for once more, as long as the bus is patient. So is one for which
   this process was not run in time: on a machine that stood still, what answers it may not have been run either. A
   virtual machine of which one processor stands still is waited for as long as that takes, up to half a second.
2. The first opening remembers the adapter by its USB identity (/dev/serial/by-id carries the serial number); every
   later one looks for that adapter, whatever name the kernel gave it after a replug, and takes no other.
"""

import array
import errno
import fcntl
import os
import select
import termios
from contextlib import ExitStack, closing, suppress
from pathlib import Path

import serial
from serial.tools import list_ports

from armctl.clock import NS_PER_S, Clock, Stalls
from armctl.dynamixel.kernel_worker import KernelWorker
from armctl.dynamixel.port import HEARD_MAX, NS_PER_MS, QUIET_MS, ServoPort
from armctl.errors import BusError, PortBusy, PortGone, PortMissing

# A kernel worker that is not held up takes a twentieth of it.
KEEPS_UP_NS = NS_PER_MS
LATELY_NS = NS_PER_S
# A process that waits comes back sooner after its time is over, unless the machine keeps it.
HELD_UP_NS = 3 * NS_PER_MS
# Of a round in which a processor of a virtual machine was not run.
STALLED_MOST_NS = NS_PER_S // 2
# Linux: the flag in the fifth number that TIOCGSERIAL tells.
ASYNC_LOW_LATENCY = 0x2000
# Linux: major numbers of what is no serial port.
UNIX98_PTY_SLAVES = range(136, 144)
BY_ID = Path("/dev/serial/by-id")


def usb_identity(path: str) -> Path | None:
    """The name under /dev/serial/by-id of the adapter at `path`; None for a port that has none (a pty)."""
    device = Path(path).resolve()
    return next((link for link in sorted(BY_ID.glob("*")) if link.resolve() == device), None)


class SerialPort(ServoPort):
    """A tty: exclusive, raw, non-blocking, with low latency where the driver knows it."""

    _fd = -1
    # Tells of arrived bytes once, and asks the terminal for nothing until it has told of some (rule 1).
    _arrivals: select.epoll
    _worker: KernelWorker | None
    # When the worker was last seen to be late.
    _late_ns = -NS_PER_S
    # Whether the terminal may hold bytes that it has told of already.
    _unread = True
    # Whether this reply was waited for once more already.
    _asked_again = False

    def __init__(self, name: str, baud: int, clock: Clock) -> None:
        self.ser: serial.Serial | None = None
        self._identity: Path | None = None
        self._opened = ExitStack()
        self._stalls = Stalls()
        # How long this round has waited on because of a stall.
        self._made_up_ns = 0
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
            if os.major(os.fstat(self._fd).st_rdev) not in UNIX98_PTY_SLAVES:
                fcntl.ioctl(self._fd, termios.TIOCEXCL)
        except (OSError, termios.error, ValueError) as error:
            self.closePort()
            raise _open_error(path, self.baudrate, error) from None
        self._identity = self._identity or usb_identity(self.port_name)
        self.low_latency = self._ask_low_latency(self.ser)
        self.is_open = self._unread = True
        return True

    def closePort(self) -> None:
        self._opened.close()
        self.is_open, self._fd = False, -1
        if self.ser is not None:
            with suppress(OSError):  # an unplugged device may refuse even this; the descriptor is gone all the same
                self.ser.close()
            self.ser = None

    def begin_round(self, patience_ns: int | None = None) -> int:
        self._stalls.begin()
        self._made_up_ns = 0
        return super().begin_round(patience_ns)

    def getBytesAvailable(self) -> int:
        if self.ser is None:
            raise self._gone()
        try:
            return len(self._received) + self.ser.in_waiting
        except OSError as error:
            raise self._gone(error) from None

    def _discard(self) -> None:
        if self._fd < 0:
            raise self._gone()
        try:
            if self._arrivals.poll(0) or self._unread:  # or nothing has come since the last read
                self._unread = False
                termios.tcflush(self._fd, termios.TCIFLUSH)
        except (OSError, termios.error) as error:
            raise self._gone(error) from None

    def _fill(self, length: int) -> None:
        if self._fd < 0:
            raise self._gone()
        if self._allowed_ns and not (self._received or self.heard):
            # The request has just left: until something comes, there is no need to look at the clock.
            wait_ns, self._asked_again = self._allowed_ns, False
        else:
            wait_ns = self._wait_ns(length)
        try:
            while True:
                # `poll` waits whole milliseconds only, `select` waits for what is left of them.
                if self._arrivals.poll(wait_ns // NS_PER_MS / 1000.0):
                    arrived = os.read(self._fd, HEARD_MAX)
                    if not arrived:
                        raise OSError(errno.EIO, "end of file")
                    self._received += arrived
                    self._unread = len(arrived) == HEARD_MAX
                    if len(self._received) >= length:
                        return
                elif not select.select((self._arrivals,), (), (), wait_ns % NS_PER_MS / NS_PER_S)[0]:
                    if not self._allowed_ns or not self._kept_back():
                        return
                    self._deadline_ns = self._now_ns() + self._allowed_ns
                wait_ns = self._wait_ns(length)
        except OSError as error:
            raise self._gone(error) from None

    def _wait_ns(self, length: int) -> int:
        """How long to wait for what is missing of `length` bytes."""
        wait_ns = self._deadline_ns - self._now_ns()
        if self._received or self.heard:
            # What follows needs its time on the wire, and where an adapter cut the reply, the adapter's.
            rest_ns = (length - len(self._received)) * self.byte_ns
            wait_ns = min(wait_ns, rest_ns + round((self._latency_ms + QUIET_MS) * NS_PER_MS))
        return max(0, wait_ns)

    def _watched_worker(self) -> KernelWorker | None:
        with suppress(OSError):  # there are no pseudo terminals here; then what is late counts as lost
            return self._opened.enter_context(closing(KernelWorker()))
        return None

    def _kept_back(self) -> bool:
        now_ns = self._now_ns()
        held_up_ns = now_ns - self._deadline_ns
        if held_up_ns > HELD_UP_NS:
            self._patient_until_ns += held_up_ns
            return True
        if self._made_up_ns < min(self._stalls.since_ns(), STALLED_MOST_NS):
            self._made_up_ns += self._allowed_ns
            self._patient_until_ns += self._allowed_ns
            return True
        if self._worker is None or now_ns >= self._patient_until_ns:
            return False
        if self._worker.delay_ns(self.clock, self._patient_until_ns) > KEEPS_UP_NS:
            self._late_ns = self._now_ns()
            return True
        # It keeps up just now; a moment ago, when the request or the reply was on its way, it may not have.
        first, self._asked_again = not self._asked_again, True
        return first and now_ns - self._late_ns < LATELY_NS

    def _send(self, packet: bytes) -> int:
        sent = 0
        try:
            with suppress(BlockingIOError):
                sent = os.write(self._fd, packet)
            if sent < len(packet):  # nothing that waits here may reach the servos later, in a burst
                termios.tcflush(self._fd, termios.TCOFLUSH)
        except (OSError, termios.error) as error:
            raise self._gone(error) from None
        return sent

    def _gone(self, error: Exception | None = None) -> PortGone:
        """What a use of the terminal raises if the port is not open, or vanishes meanwhile.

        Unplugging shows as OSError, SerialException (one of them) or termios.error (none of them).
        """
        if error is None or self._fd < 0:
            return PortGone(f"{self.port_name}: the port is not open; open it first")
        return PortGone(f"{self.port_name}: the port vanished ({_reason(error)}); plug the adapter in again")

    def _ask_low_latency(self, ser: serial.Serial) -> bool | None:
        state = array.array("i", [0] * 32)
        with suppress(ValueError, OSError):
            ser.set_low_latency_mode(True)
            fcntl.ioctl(ser.fileno(), termios.TIOCGSERIAL, state)
            return bool(state[4] & ASYNC_LOW_LATENCY)
        return None


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
        group = str(os.stat(path).st_gid)
        with suppress(KeyError):  # it has no name here
            group = Path(path).group()
        remedy = f"sudo usermod -aG {group} $USER, then log in again"
        return PortMissing(f"{path}: no permission; it belongs to group {group}: {remedy}")
    if isinstance(error, ValueError):
        return PortMissing(f"{path}: the adapter cannot do {baud} baud ({error}); set another baud rate")
    return PortMissing(f"{path}: no usable serial port ({_reason(error)}); name another one with --port")


def _holders(path: str) -> list[str]:
    """Processes that have the port open, as far as /proc lets us see: `name (pid 123)`."""
    device = os.path.realpath(path)
    found: dict[str, str] = {}
    for link in Path("/proc").glob("[0-9]*/fd/*"):
        with suppress(OSError):  # ended meanwhile, or not ours to see
            if os.readlink(link) == device:
                process = link.parent.parent
                found[process.name] = f"{(process / 'comm').read_text().strip()} (pid {process.name})"
    return list(found.values())
