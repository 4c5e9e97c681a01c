"""The control process, and the handle its parent holds.

`python -m armctl.control.process FD` takes its settings as the first message on the inherited socket, opens the
port, and ticks until the socket closes (its host is gone) or SIGTERM arrives. Either way it first lets a motion
come to rest; torque stays as it is. A port that is busy is waited for a little: the holder may be a predecessor
that is doing just that.

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
from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self, cast

from armctl.clock import NS_PER_S, Clock, MonotonicClock, Stalls, ask_for_real_time
from armctl.config import ArmConfig
from armctl.control.link import Beat, Link, LinkClosed, Ready, StartFailed, StopAsked
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


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """What the control process needs to know; no file is read there."""

    port: str
    baud: int
    arm: ArmConfig
    period_s: float
    # Descriptor of the socket on which anybody may ask for a stop; it is inherited.
    stop_fd: int


class ControlProcess:
    """The running control process, as its host sees it."""

    def __init__(self, process: subprocess.Popen[bytes], link: Link) -> None:
        self._process, self.link = process, link

    @classmethod
    def start(cls, settings: ControlSettings, *, restarted: bool = False) -> Self:
        """Start the process; its first message says whether it owns the port."""
        link, theirs = Link.pair()
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "armctl.control.process", str(theirs.fileno())],
                pass_fds=[theirs.fileno(), settings.stop_fd],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal is the host's to answer
            )
        link.send((settings, restarted))
        return cls(process, link)

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

    def __init__(self, link: Link, lane: StopLane, loop: "ControlLoop", clock: Clock) -> None:
        # Whether the host is gone, or wants this process to be.
        self.leaving = False
        self._link, self._lane, self._loop, self._clock = link, lane, loop, clock
        self._commands: list[Command] = []
        # When the host's last word came; 0: none has come yet.
        self._heard_ns = 0
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
        silent_ns = self._clock.now_ns() - self._heard_ns if self._heard_ns else 0
        if silent_ns > SILENT_NS:
            silent_ns -= min(self._stalls.since_ns(), STALLED_MOST_NS)
        before, self._silent = self._silent, silent_ns > SILENT_NS
        return (*commands, HostSilent()) if self._silent and not before else commands

    def _receive(self) -> None:
        try:
            received = cast("list[Command | Beat]", self._link.receive())
        except LinkClosed:
            self.leaving = True
            return
        if received:
            self._heard_ns = self._clock.now_ns()
            self._stalls.begin()
        for command in received:
            if not isinstance(command, Beat):
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


def main(descriptor: int) -> int:
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
    inbox = Inbox(link, lane, loop, clock)

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
    sys.exit(main(int(sys.argv[1])))
