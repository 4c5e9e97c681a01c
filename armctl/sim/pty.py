"""The simulated arm as a program: a pseudo terminal in real time that any Dynamixel program can open.

One loop, one thread: drain the host's bytes at once (a client that flushes its output would discard them), act on
them, let reply bytes go when they would have arrived, advance the physics and keep the truth every 10 ms, serve
the control socket. The host's baud setting is read off the terminal, so servos at another baud stay silent. The
terminal's far end is held open here, or the first client to close it would end it; `link` is a symlink to it that
always names the present one and vanishes with it, by request or while an `unplug` fault is in force.

Not modelled: what a UART does to bytes (overrun, framing), and modem lines. A host that flushes its output
right behind a packet without reply (pypot does after SYNC_WRITE) may lose it: until a worker of the kernel has run the
packet is not here yet, and no thread that reads here can hold on to it (docs/simulator.md has what was measured).
"""

import contextlib
import fcntl
import os
import select
import signal
import socket
import struct
import termios
import time
import tty
from collections.abc import Callable
from pathlib import Path

from armctl.clock import ask_for_real_time
from armctl.dynamixel.packet import BadChecksum, Decoder, Instruction, Packet
from armctl.errors import ConfigError
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.control import TRUTH_PERIOD_NS, Controls, TruthRing, control_path
from armctl.sim.control_server import ControlServer

# More than a terminal holds.
TERMINAL_BYTES = 65536
# So long before a reply is due it is waited for awake: from idle a processor wakes late, and a wire is never late.
WAKE_NS = 200_000
# Linux: the terminal's settings with the baud as a plain number, also where no Bxxx constant exists.
_TCGETS2 = 0x802C542A
_TERMIOS2 = struct.Struct("4I20B2I")


class PseudoTerminal:
    """A raw pseudo terminal whose far end is published as a symlink, and can be pulled out."""

    def __init__(self, link: Path) -> None:
        """A port that is not plugged in yet."""
        self._link = link
        self._master = self._slave = -1
        # Tells of the host's bytes without asking the terminal, which would wait for the kernel's worker.
        self._arrivals = select.epoll()

    @property
    def plugged(self) -> bool:
        return self._master >= 0

    def fileno(self) -> int:
        """What to wait on for the host's bytes."""
        return self._arrivals.fileno()

    def replug(self) -> None:
        """A new terminal, the link pointing at it; nothing if plugged.

        Raises:
            ConfigError: `link` is something else than a symlink, or cannot be created.
        """
        if self.plugged:
            return
        if os.path.lexists(self._link) and not self._link.is_symlink():
            raise ConfigError(str(self._link), "", "exists and is no symlink", "remove it or choose another --link")
        self._master, self._slave = os.openpty()
        tty.setraw(self._slave)
        settings = termios.tcgetattr(self._slave)
        settings[4] = settings[5] = termios.B1000000
        termios.tcsetattr(self._slave, termios.TCSANOW, settings)
        os.set_blocking(self._master, False)
        self._arrivals.register(self._master, select.EPOLLIN | select.EPOLLET)
        # A symlink cannot be rewritten: make one beside it and rename, so that the link always names a terminal.
        fresh = self._link.with_name(f".{self._link.name}.{os.getpid()}")
        try:
            fresh.symlink_to(os.ttyname(self._slave))
            fresh.replace(self._link)
        except OSError as error:
            fresh.unlink(missing_ok=True)
            self.unplug()
            raise ConfigError(str(self._link), "", f"cannot create the link: {error.strerror}") from None

    def unplug(self) -> None:
        """Close the terminal, as a pulled cable does, and remove the link if it is still ours."""
        if not self.plugged:
            return
        with contextlib.suppress(OSError):
            if os.readlink(self._link) == os.ttyname(self._slave):
                self._link.unlink()
        os.close(self._master)
        os.close(self._slave)
        self._master = self._slave = -1

    def baud(self) -> int:
        """What the host set."""
        return int(_TERMIOS2.unpack(fcntl.ioctl(self._master, _TCGETS2, bytes(_TERMIOS2.size)))[-1])

    def read(self) -> bytes:
        """The bytes the host has written, of those told about."""
        with contextlib.suppress(BlockingIOError):
            if self._arrivals.poll(0):
                return os.read(self._master, TERMINAL_BYTES)
        return b""

    def write(self, data: bytes) -> None:
        """Hand bytes to the host; what it leaves unread until the terminal is full is lost."""
        with contextlib.suppress(BlockingIOError):
            os.write(self._master, data)


def run(
    simulated: SimulatedArm,
    *,
    link: Path,
    ready: Callable[[str], None],
    seed: int = 0,
    latency_ms: float = 0.0,
    lockstep: bool = False,
) -> None:
    """Simulate an arm until SIGTERM or SIGINT; from the main thread only.

    Args:
        link: Where the port appears; the control socket appears beside it, see `control_path`.
        ready: Called with the link's path once a client may open it.
        seed: Of the line.
        latency_ms: Timer of the adapter: replies reach the host only when it fires.
        lockstep: Whether the world follows the bus master's cycles instead of the wall clock, see `Lockstep`.
    Raises:
        ConfigError: a path that cannot be used.
        PortBusy: another simulator serves this link.
    """
    bus = SimulatedBus(simulated, latency_ms=latency_ms, seed=seed)
    terminal = PseudoTerminal(link)
    ring = TruthRing()
    world = Lockstep(simulated, bus, ring) if lockstep else RealTime(simulated, bus, ring)
    ask_for_real_time()
    stop: list[int] = []
    with contextlib.ExitStack() as cleanup:
        for number in (signal.SIGTERM, signal.SIGINT):
            cleanup.callback(signal.signal, number, signal.signal(number, lambda signum, _frame: stop.append(signum)))
        # The socket first: it tells whether the link belongs to a living simulator.
        server = ControlServer(control_path(link), Controls(simulated, ring, terminal, world.now_ns).answer)
        cleanup.callback(server.close)
        terminal.replug()
        cleanup.callback(terminal.unplug)
        simulated.advance(world.now_ns())  # the origin of the faults' time
        ready(str(link))
        pulled = False
        while not stop:
            readers: list[socket.socket | PseudoTerminal] = [*server.readers(), terminal]
            readable, writable, _ = select.select(readers, server.writers(), [], world.patience_s())
            heard = b""
            if terminal in readable and terminal.plugged:
                bus.baud = terminal.baud() or bus.baud
                heard = terminal.read()
            if (replies := world.pass_on(heard)) and terminal.plugged:
                terminal.write(replies)
            if (simulated.faults.in_force("unplug") is not None) != pulled:
                pulled = not pulled
                (terminal.unplug if pulled else terminal.replug)()
            server.serve([*(s for s in readable if isinstance(s, socket.socket)), *writable])


class _World:
    """A simulated arm in its time, and what the host and the truth learn of it."""

    def __init__(self, arm: SimulatedArm, bus: SimulatedBus, ring: TruthRing) -> None:
        self._arm, self._bus, self._ring = arm, bus, ring
        self._truth_ns = time.monotonic_ns()

    def _keep_truth(self, until_ns: int, ahead_ns: int = 0) -> None:
        """Let the arm go on, sample by sample; the stamps are so much ahead of its own time."""
        while self._truth_ns <= until_ns:
            self._arm.advance(self._truth_ns)
            self._ring.add(self._truth_ns + ahead_ns, self._arm.true_positions())
            self._truth_ns += TRUTH_PERIOD_NS


class RealTime(_World):
    """The world's time is the wall clock's; replies wait for their bytes' time on the wire."""

    now_ns = staticmethod(time.monotonic_ns)

    def patience_s(self) -> float:
        """How long nothing is due."""
        # A reply in one piece: every piece costs a turn of the kernel's worker for terminals.
        now_ns, reply_ns = time.monotonic_ns(), self._bus.burst_end_ns()
        if reply_ns is None:
            return max(0, self._truth_ns - now_ns) / 1e9
        if reply_ns - now_ns > WAKE_NS:
            return max(0, min(self._truth_ns, reply_ns - WAKE_NS) - now_ns) / 1e9
        while time.monotonic_ns() < reply_ns:
            pass
        return 0.0

    def pass_on(self, heard: bytes) -> bytes:
        """Let the world go on to now, with the host's bytes; the bytes that reach the host by now."""
        now_ns = time.monotonic_ns()
        self._keep_truth(now_ns)
        if heard:
            self._bus.receive(heard, now_ns)
        return self._bus.transmit(now_ns)


class Lockstep(_World):
    """The world's time is the bus master's: `PERIOD_NS` from one cycle to the next, and none within.

    A cycle begins with the read that turns back: of a servo before the one read last, in the arm's order. Reading one
    servo again, as a master does that has waited in vain, begins nothing. Within a cycle the arm stands still, a servo
    reads the same however often it is asked, and replies leave at once. So what the servos answer is a function of
    the bytes they got, whatever the machine is busy with; noise is drawn from the take's seed and the cycle's number
    in it. A world without a master stands still, except while a fault has pulled the adapter out: then the wall
    clock's periods pass, or it would stay out for ever. The truth is stamped with the wall clock, to be held against
    the master's samples.
    """

    PERIOD_NS = 100_000_000

    def __init__(self, arm: SimulatedArm, bus: SimulatedBus, ring: TruthRing) -> None:
        super().__init__(arm, bus, ring)
        self._now_ns = self._truth_ns
        self._order = {servo_id: index for index, servo_id in enumerate(arm.config.servo_ids)}
        self._decoder = Decoder()
        self._last_read = -1
        self._heard_ns = 0
        arm.advance(self._now_ns)
        arm.draw_noise()
        arm.standing = True

    def now_ns(self) -> int:
        return self._now_ns

    def patience_s(self) -> float:
        """How long nothing is due."""
        return 0.1

    def pass_on(self, heard: bytes) -> bytes:
        """Let the world go on by the host's bytes; their replies."""
        wall_ns = time.monotonic_ns()
        if not heard:
            if self._arm.faults.in_force("unplug") and wall_ns - self._heard_ns >= self.PERIOD_NS:
                self._heard_ns = wall_ns
                self._begin_cycle(wall_ns)
            return b""
        self._heard_ns = wall_ns
        begin, replies = 0, bytearray()
        for end in range(1, len(heard) + 1):
            packets = self._decoder.feed(heard[end - 1 : end])
            if any(self._turns_back(packet) for packet in packets):
                self._begin_cycle(wall_ns)
            if packets or end == len(heard):
                self._bus.receive(heard[begin:end], self._now_ns)
                begin = end
                while (reply_ns := self._bus.arrival_ns()) is not None:
                    replies += self._bus.transmit(reply_ns)
        return bytes(replies)

    def _turns_back(self, packet: Packet | BadChecksum) -> bool:
        if not isinstance(packet, Packet) or packet.code != Instruction.READ or packet.servo_id not in self._order:
            return False
        before, self._last_read = self._last_read, self._order[packet.servo_id]
        return self._last_read < before

    def _begin_cycle(self, wall_ns: int) -> None:
        self._now_ns += self.PERIOD_NS
        self._arm.standing = False
        self._keep_truth(self._now_ns, wall_ns - self._now_ns)
        self._arm.advance(self._now_ns)
        self._arm.draw_noise()
        self._arm.standing = True
