"""The control process, and the handle its parent holds.

`python -m armctl.control.process FD HEART` takes its settings as the first message on the inherited socket FD, opens
the port, and ticks until the socket closes (its host is gone) or SIGTERM arrives. Either way it first lets a motion
come to rest; torque stays as it is. A port that is busy is waited for a little: the holder may be a predecessor
that is doing just that. HEART is the file of the host's heartbeat.

Importing what the body needs takes longer than all the rest of its start: so that happens in `main`, and the host,
which holds a handle only, imports other things meanwhile.
"""

import gc
import os
import select
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Sequence
from typing import TYPE_CHECKING, NamedTuple, Self, cast

from armctl.clock import NS_PER_S, Clock, MonotonicClock, Stalls, ask_for_precedence, ask_for_real_time
from armctl.config import ArmConfig
from armctl.control.link import Link, LinkClosed, Ready, StartFailed, StopAsked, heartbeat
from armctl.control.stop_lane import REQUEST_ID, StopLane
from armctl.errors import BusError, PortBusy
from armctl.messages import Command, Hold, HostLost, HostSilent, Reply, TickRecord

if TYPE_CHECKING:
    from armctl.control.loop import ControlLoop

SETTINGS_TIMEOUT_S = 10.0
# How long a busy port is waited for: a control process whose host died comes to rest and leaves well within.
BUSY_NS = 2 * NS_PER_S
# A host that was not heard for so long hangs: it says something every 50 ms.
SILENT_NS = 300_000_000
# A host is no more silent than the machine stood still, up to so long.
STALLED_MOST_NS = NS_PER_S
BUSY_POLL_NS = NS_PER_S // 10


class ControlSettings(NamedTuple):
    """What the control process needs to know; no file is read there."""

    port: str
    baud: int
    arm: ArmConfig
    period_s: float
    # Descriptor of the socket on which anybody may ask for a stop; it is inherited.
    stop_fd: int


class ControlProcess:
    """The running control process, as its host sees it."""

    def __init__(self, process: subprocess.Popen[bytes], link: Link, heart: memoryview) -> None:
        self._process, self.link, self._heart = process, link, heart

    @classmethod
    def start(cls, settings: ControlSettings, *, restarted: bool = False) -> Self:
        """Start the process; its first message says whether it owns the port."""
        link, theirs = Link.pair()
        with theirs, os.fdopen(os.memfd_create("armctl-heartbeat"), "r+b") as heart:
            heart.truncate(8)
            process = subprocess.Popen(
                [sys.executable, "-m", "armctl.control.process", f"{theirs.fileno()}", f"{heart.fileno()}"],
                pass_fds=[theirs.fileno(), heart.fileno(), settings.stop_fd],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal is the host's to answer
            )
            ask_for_precedence(process.pid)  # an arm waits for it, on a busy machine too
            link.send((settings, restarted))
            return cls(process, link, heartbeat(heart.fileno()))

    def beat(self) -> None:
        """Tell it that the host is there."""
        self._heart[0] = time.monotonic_ns()

    def poll(self) -> int | None:
        """Exit status, or None while it runs."""
        return self._process.poll()

    def kill(self) -> None:
        """End it at once, also where it hangs."""
        self._process.kill()

    def terminate(self, timeout_s: float) -> None:
        """Ask it to come to rest and leave; insist after `timeout_s`."""
        self.link.close()
        self._process.terminate()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


class Inbox:
    """What the host has sent since the last tick.

    A `Hold` that finds the arm at rest is answered when it comes: nothing moves, and nothing accepted before it will,
    since there is none or it would be stopped by this very `Hold` in the next tick. One that must bring something to
    rest is answered by the tick in which it lies still.
    """

    def __init__(self, link: Link, lane: StopLane, loop: "ControlLoop", clock: Clock, heart: memoryview) -> None:
        # Whether the host is gone, or wants this process to be.
        self.leaving = False
        self._link, self._lane, self._loop, self._clock = link, lane, loop, clock
        self._commands: list[Command] = []
        self._heart, self._beat_ns = heart, 0
        # When the host was last there, 0 before it ever was, and when that was last looked at.
        self._heard_ns = self._looked_ns = 0
        self._silent = False
        self._stalls = Stalls()
        # Whether a stop of the lane is under way.
        self._stopping = False

    def wait(self, deadline_ns: int) -> None:
        """Take in what comes until `deadline_ns`."""
        while not self.leaving and (left_ns := deadline_ns - self._clock.now_ns()) > 0:
            if not select.select([self._link, *self._lane.ends()], [], [], left_ns / NS_PER_S)[0]:
                break
            self._receive()
        self._clock.sleep_until_ns(deadline_ns)

    def take(self) -> Sequence[Command]:
        """Everything that has come."""
        if not self.leaving:
            self._receive()
        if self.leaving:
            return (HostLost(),)
        commands, self._commands = self._commands, []
        silent_ns = self._silent_ns()
        if silent_ns > SILENT_NS:
            silent_ns -= min(self._stalls.since_ns(), STALLED_MOST_NS)
        before, self._silent = self._silent, silent_ns > SILENT_NS
        return (*commands, HostSilent()) if self._silent and not before else commands

    def _silent_ns(self) -> int:
        """For how long the host was not there; what it said while this process itself hung counts as said now."""
        now_ns, beat_ns = self._clock.now_ns(), self._heart[0]
        hung = now_ns - self._looked_ns > SILENT_NS + self._loop.period_ns
        if beat_ns != self._beat_ns:
            self._beat_ns, self._heard_ns = beat_ns, now_ns if hung else beat_ns
            self._stalls.begin()
        self._looked_ns = now_ns
        return now_ns - self._heard_ns if self._heard_ns else 0

    def _receive(self) -> None:
        try:
            received = cast("list[Command]", self._link.receive())
        except LinkClosed:
            self.leaving = True
            return
        for command in received:
            self._put(command)
        who = self._lane.receive()
        if who and not self._stopping:
            self._stopping = True
            self._link.send(StopAsked(", ".join(who)))
            self._put(Hold(REQUEST_ID))

    def _put(self, command: Command) -> None:
        self._commands.append(command)
        if isinstance(command, Hold) and self._loop.at_rest and all(isinstance(c, Hold) for c in self._commands):
            self._answer(Reply(command.request_id, True))

    def _answer(self, reply: Reply) -> None:
        if reply.request_id == REQUEST_ID:
            self._stopping = False
            self._lane.answer(f"ok {self._loop.state.mode}" if reply.ok else f"{reply.code}: {reply.message}")
        else:
            self._link.send(reply)

    def told(self, record: TickRecord) -> bool:
        """Pass a tick on to the host, and its answers to the lane; whether the host took it."""
        for reply in record.outputs.replies:
            if reply.request_id == REQUEST_ID:
                self._answer(reply)
        return self._link.send(record)


def main(descriptor: int, heart: int) -> int:
    """Body of the control process."""
    from armctl.control.loop import ControlLoop
    from armctl.dynamixel.bus import ServoBus
    from armctl.dynamixel.serial_port import SerialPort
    from armctl.kinematics import robots

    link = Link(socket.socket(fileno=descriptor))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    select.select([link], [], [], SETTINGS_TIMEOUT_S)
    settings, restarted = cast("tuple[ControlSettings, bool]", link.receive()[0])
    clock = MonotonicClock()
    bus = ServoBus(SerialPort(settings.port, settings.baud, clock), settings.arm.servo_ids)
    robot = robots.get(settings.arm.robot, settings.arm.lengths_m)
    loop = ControlLoop(bus, clock, settings.arm, robot, settings.period_s, restarted=restarted)
    lane = StopLane(socket.socket(fileno=settings.stop_fd), clock)
    inbox = Inbox(link, lane, loop, clock, heartbeat(heart))

    def leave(_signal: int, _frame: object) -> None:
        inbox.leaving = True

    signal.signal(signal.SIGTERM, leave)
    signal.signal(signal.SIGUSR1, lambda *_: lane.signal())
    give_up_ns = clock.now_ns() + BUSY_NS
    while not bus.is_open:
        try:
            bus.open()
        except BusError as error:
            if inbox.leaving or clock.now_ns() >= give_up_ns or not isinstance(error, PortBusy):
                link.send(StartFailed(error))
                return 1
            clock.sleep_until_ns(clock.now_ns() + BUSY_POLL_NS)
    link.send(Ready(os.getpid()))
    gc.freeze()
    ask_for_real_time()
    loop.run(inbox.take, inbox.told, lambda: inbox.leaving, inbox.wait)
    bus.close()
    lane.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
