"""The control process, and the handle its parent holds.

`python -m armctl.control.process FD` takes its settings as the first message on the inherited socket, opens the
port, and ticks until the socket closes (its host is gone) or SIGTERM arrives. Either way it first lets a motion
come to rest; torque stays as it is. A port that is busy is waited for a little: the holder may be a predecessor
that is doing just that.
"""

from __future__ import annotations

import gc
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import cast

from armctl.clock import NS_PER_S, MonotonicClock, ask_for_real_time
from armctl.config import ArmConfig
from armctl.control.link import Link, LinkClosed, Ready, StartFailed
from armctl.control.loop import ControlLoop
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.port import SerialPort
from armctl.errors import BusError, PortBusy
from armctl.kinematics import robots
from armctl.messages import Command, HostLost

SETTINGS_TIMEOUT_S = 10.0
BUSY_NS = 2 * NS_PER_S
"""How long a busy port is waited for: a control process whose host died comes to rest and leaves well within."""
BUSY_POLL_NS = NS_PER_S // 10


@dataclass(frozen=True, slots=True)
class ControlSettings:
    """What the control process needs to know; no file is read there."""

    port: str
    baud: int
    arm: ArmConfig
    period_s: float


class ControlProcess:
    """The running control process, as its host sees it."""

    def __init__(self, process: subprocess.Popen[bytes], link: Link) -> None:
        self._process, self.link = process, link
        self.pid = process.pid

    @classmethod
    def start(cls, settings: ControlSettings, *, restarted: bool = False) -> ControlProcess:
        """Start the process; its first message says whether it owns the port."""
        link, theirs = Link.pair()
        with theirs:
            process = subprocess.Popen(
                [sys.executable, "-m", "armctl.control.process", str(theirs.fileno())],
                pass_fds=[theirs.fileno()],
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                start_new_session=True,  # Ctrl-C in a terminal is the host's to answer
            )
        link.send((settings, restarted))
        return cls(process, link)

    def poll(self) -> int | None:
        """Exit status, or None while it runs."""
        return self._process.poll()

    def terminate(self, timeout_s: float) -> None:
        """Ask it to come to rest and leave; insist after `timeout_s`."""
        self.link.close()
        self._process.terminate()
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()


def main(descriptor: int) -> int:
    """Body of the control process."""
    link = Link(socket.socket(fileno=descriptor))
    leaving = False

    def leave(_signal: int, _frame: object) -> None:
        nonlocal leaving
        leaving = True

    signal.signal(signal.SIGTERM, leave)
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    select.select([link], [], [], SETTINGS_TIMEOUT_S)
    settings, restarted = cast("tuple[ControlSettings, bool]", link.receive()[0])
    clock = MonotonicClock()
    bus = ServoBus(SerialPort(settings.port, settings.baud, clock), settings.arm.servo_ids, clock)
    robot = robots.get(settings.arm.robot, settings.arm.lengths_m)
    loop = ControlLoop(bus, clock, settings.arm, robot, settings.period_s, restarted=restarted)
    give_up_ns = clock.now_ns() + BUSY_NS
    while not bus.is_open:
        try:
            loop.open()
        except BusError as error:
            if leaving or clock.now_ns() >= give_up_ns or not isinstance(error, PortBusy):
                link.send(StartFailed(error.code, str(error)))
                return 1
            clock.sleep_until_ns(clock.now_ns() + BUSY_POLL_NS)
    link.send(Ready(os.getpid()))

    def inbox() -> Sequence[Command]:
        nonlocal leaving
        if leaving:
            return (HostLost(),)
        try:
            return cast("list[Command]", link.receive())
        except LinkClosed:
            leaving = True
            return (HostLost(),)

    gc.freeze()
    ask_for_real_time()
    loop.run(inbox, link.send, lambda: leaving)
    bus.close()
    return 0


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1])))
