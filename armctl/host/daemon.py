"""The host process behind `armctl daemon`: it keeps a control process alive, records it, and serves clients.

Rules.
1. The port belongs to the control process alone; when that dies, requests under way fail with RESTARTED and a
   new one is started, which takes the arm as it finds it. Dying often makes the waits longer, never endless.
2. SIGTERM, SIGINT and SIGHUP: the arm comes to rest, the log is closed, torque stays; all within two seconds.
3. If this process dies, the control process sees its end of the link close, brings the arm to rest and leaves.
4. The control process starts first, so that the arm is taken in hand while this process still imports what it needs.
5. What a crash left in the folders is made whole again by a process of its own, once clients are served.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import logging
import os
import signal
import socket
from collections import deque
from collections.abc import Callable, Coroutine, Iterator, Sequence
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from armctl.clock import NS_PER_S, Clock, MonotonicClock
from armctl.config import ArmConfig, Config
from armctl.control.link import Link, LinkClosed, Ready, StartFailed, StopAsked
from armctl.control.process import ControlProcess, ControlSettings
from armctl.errors import ArmctlError, BusError, ConfigError, RequestRefused
from armctl.files import data_dir, stop_path
from armctl.host import service_manager
from armctl.host.pulse import OVERDUE_S, START_S, Heart, Pulse, beat
from armctl.messages import Reply, TickRecord
from armctl.recording.disk import PART

if TYPE_CHECKING:
    from armctl.host.host import Host
    from armctl.host.server import Server
    from armctl.host.takes import TakeRecorder
    from armctl.recording.writer import LogContext

    # Takes each tick record in.
    TakesTick = Callable[[TickRecord], None]
    MakeRecorder = Callable[[LogContext, Path, Path], TakeRecorder]

# Longest wait for the arm to come to rest at the end.
STILL_S = 1.0
LEAVE_S = 0.5
MAX_DEATHS = 5
DEATHS_WINDOW_NS = 60 * NS_PER_S
PATIENT_WAIT_S = 5.0

logger = logging.getLogger(__name__)


class ControlHandle(Heart, Protocol):
    """A control process as its supervisor needs it."""

    @property
    def link(self) -> Link: ...
    def poll(self) -> int | None: ...
    def terminate(self, timeout_s: float) -> None: ...


class StartControl(Protocol):
    """Starts a control process; `ControlProcess.start`."""

    def __call__(self, settings: ControlSettings, *, restarted: bool = False) -> ControlHandle: ...


@dataclass(frozen=True)
class Outside:
    """What the daemon is given of the world; tests give it another one."""

    start_control: StartControl = ControlProcess.start
    # None: a `Recorder`.
    make_recorder: MakeRecorder | None = None
    clock: Clock = field(default_factory=MonotonicClock)
    overdue_s: float = OVERDUE_S


async def run_daemon(
    config: Config,
    arm: ArmConfig,
    *,
    port: str,
    socket: Path,
    log_dir: Path | None,
    ready: Callable[[str], None],
    outside: Outside = Outside(),
) -> int:
    """Serve one arm until SIGTERM, SIGINT or SIGHUP.

    Args:
        port: Serial device of the arm.
        socket: Where clients connect.
        log_dir: Folder of the log; None: `logs` below the data folder.
        ready: Called once, with the socket's path, when clients are served.
        outside: Left out: real processes, files and time.
    Returns:
        Exit status.
    Raises:
        BusError: the control process could not take the port.
        ConfigError: the socket cannot be made there.
        RequestRefused: another daemon answers on the socket, or the arm never ticked.
    """
    folders = log_dir or data_dir(config) / "logs", data_dir(config) / "recordings"
    with listening_at(socket) as listening, listening_at(stop_path(socket)) as lane:
        settings = ControlSettings(port, config.baud, arm, config.period_s, stop_fd=lane.fileno())
        ending = asyncio.Event()
        loop = asyncio.get_running_loop()
        for number in service_manager.endings():
            loop.add_signal_handler(number, ending.set)
        control = outside.start_control(settings)
        left = [folder for folder in folders if any(folder.glob(f"*{PART}"))]
        try:
            # While the new process does the same and opens its port; what it sends meanwhile waits in the link.
            host, server, recorder = await _parts(config, arm, port, folders, outside)
        except BaseException:
            control.terminate(LEAVE_S)
            raise

        def pass_on() -> None:
            """A stop by signal is the control process's to answer."""
            if host.exchange.pid is not None:
                os.kill(host.exchange.pid, signal.SIGUSR1)

        loop.add_signal_handler(signal.SIGUSR1, pass_on)

        def tick(record: TickRecord) -> None:
            host.receive(record)
            server.publish(host.status)
            service_manager.notify("WATCHDOG=1")

        restart = partial(outside.start_control, settings, restarted=True)
        supervising = asyncio.create_task(supervise(control, restart, host, tick, outside))
        try:
            await _first_tick(host, supervising, ending)
            server.start(listening)
            if not ending.is_set():
                service_manager.notify("READY=1")
                # Under load each search for cycles held up every client for up to a tenth of a second.
                gc.freeze()
                gc.set_threshold(50_000, 20, 100)
                ready(str(socket))
                _recover(left)
            await _first_of(supervising, ending.wait())
            service_manager.notify("STOPPING=1")
            await _rest(host)
            await server.close()
        finally:
            supervising.cancel()
            await asyncio.gather(asyncio.to_thread(recorder.close), supervising, return_exceptions=True)
    return 0


async def _parts(
    config: Config, arm: ArmConfig, port: str, folders: tuple[Path, Path], outside: Outside
) -> tuple[Host, Server, TakeRecorder]:
    """Import and make what serves clients."""
    from armctl.host.host import Host
    from armctl.host.jobs import optimize_task, run_job
    from armctl.host.learning import Learner
    from armctl.host.methods import Methods
    from armctl.host.roles import may_command
    from armctl.host.server import Server
    from armctl.kinematics import robots
    from armctl.recording.recorder import Recorder
    from armctl.recording.writer import LogContext

    robot = robots.get(arm.robot, arm.lengths_m)
    context = LogContext(arm=arm, robot=robot, config=config, port=port, period_s=config.period_s)
    recorder = (outside.make_recorder or Recorder)(context, *folders)
    learner = Learner(config, arm, robot, config.period_s)
    host = Host(arm, robot, config.period_s, recorder, outside.clock, learner.load, learner.learn)
    methods = Methods(host, folders[1], partial(run_job, optimize_task))
    commands = partial(may_command, commanders=config.commanders)
    return host, Server(methods.table(), outside.clock, methods.client_gone, commands, host.leases.held_by), recorder


async def supervise(
    control: ControlHandle, restart: Callable[[], ControlHandle], host: Host, tick: TakesTick, outside: Outside
) -> None:
    """Keep a control process alive, beginning with `control`, until cancelled: when it is gone, another is started.

    Raises:
        BusError: the very first process could not take the port.
    """
    deaths_ns: deque[int] = deque(maxlen=MAX_DEATHS + 1)
    while True:
        failed = await _until_gone(control, host, tick, Pulse(host.period_s, outside.overdue_s))
        if failed is not None and not deaths_ns:
            raise failed
        deaths_ns.append(outside.clock.now_ns())
        wait_s = restart_wait_s(deaths_ns)
        why = f"exit status {control.poll()}" if failed is None else str(failed)
        logger.error("RESTARTED: the control process is gone (%s); starting another in %g s", why, wait_s)
        host.note({"event": "RESTARTED", "text": f"the control process is gone ({why})"})
        await asyncio.sleep(wait_s)
        control = restart()


async def _until_gone(control: ControlHandle, host: Host, tick: TakesTick, pulse: Pulse) -> BusError | None:
    """Take in what the process sends until it is gone; returns why it could not start, if so."""
    loop = asyncio.get_running_loop()
    descriptor = control.link.fileno()
    gone = asyncio.Event()
    failed: BusError | None = None

    def receive() -> None:
        nonlocal failed
        try:
            messages = control.link.receive()
        except LinkClosed:
            loop.remove_reader(descriptor)
            gone.set()
            return
        for message in messages:
            match message:
                case TickRecord():
                    pulse.ticked()
                    tick(message)
                case StopAsked():
                    host.stop_asked(message.who)
                case Reply():
                    host.exchange.answer(message)
                case Ready():
                    host.exchange.attach(message.pid, control.link.send)
                case StartFailed():
                    failed = message.error

    loop.add_reader(descriptor, receive)
    beating = asyncio.create_task(beat(control, pulse))
    try:
        await gone.wait()
        host.control_lost()
    finally:
        beating.cancel()
        loop.remove_reader(descriptor)
        # The next one can have the port only when this one has let go of it.
        await asyncio.to_thread(control.terminate, LEAVE_S)
    return failed


def restart_wait_s(deaths_ns: deque[int]) -> float:
    """How long to wait before the next start, by the times of the latest deaths [ns], oldest first."""
    return PATIENT_WAIT_S if len(deaths_ns) > MAX_DEATHS and deaths_ns[-1] - deaths_ns[0] < DEATHS_WINDOW_NS else 0.0


@contextlib.contextmanager
def listening_at(path: Path) -> Iterator[socket.socket]:
    """A socket listening at `path`, for its owner and group only.

    Its folder is made if it is missing; a socket that nobody serves any more is replaced. Nothing is left behind.

    Raises:
        RequestRefused: code BUSY, another daemon answers there.
        ConfigError: there can be no socket at that path.
    """
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        try:
            if not path.parent.exists():
                path.parent.mkdir(parents=True)
                path.parent.chmod(0o750)
            if path.is_socket():
                _refuse_second(path)
                path.unlink()
            listening.bind(str(path))
            path.chmod(0o660)  # before anybody can connect
            listening.listen()
        except OSError as error:
            why = f"cannot be made: {error.strerror or error}"
            raise ConfigError(str(path), "socket", why, "choose another with --socket") from None
        try:
            yield listening
        finally:
            path.unlink(missing_ok=True)


def _refuse_second(path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(1.0)
        try:
            probe.connect(str(path))
        except (ConnectionRefusedError, FileNotFoundError):
            return
        except TimeoutError:
            pass  # somebody listens, too busy to accept
    raise RequestRefused("BUSY", f"another daemon answers on {path}; end it first, or choose another --socket")


def _recover(folders: Sequence[Path]) -> None:
    """Begin to make whole again what a crash left in these folders."""
    from armctl.recording.compact import Compaction

    try:
        if folders:
            Compaction().start(*folders)
    except OSError as error:
        logger.error("%s: not recovered: %s", ", ".join(map(str, folders)), error)


async def _first_tick(host: Host, supervising: asyncio.Task[None], ending: asyncio.Event) -> None:
    try:
        async with asyncio.timeout(START_S):
            await _first_of(supervising, host.tick(), ending.wait())
    except TimeoutError:
        raise RequestRefused("NO_ANSWER", f"the control process did not tick within {START_S:g} s") from None


async def _first_of(supervising: asyncio.Task[None], *events: Coroutine[Any, Any, object]) -> None:
    """Wait until one of the events has come, or the supervisor has failed."""
    waiting = [asyncio.create_task(event) for event in events]
    try:
        await asyncio.wait((supervising, *waiting), return_when=asyncio.FIRST_COMPLETED)
    finally:
        for task in waiting:
            task.cancel()
    if supervising.done():
        supervising.result()


async def _rest(host: Host) -> None:
    """Bring the arm to rest, as far as there is time; a control process without a host does the same."""
    try:
        async with asyncio.timeout(STILL_S):
            await host.stop()
    except (TimeoutError, ArmctlError) as error:
        logger.warning("the arm was not seen to rest: %s", error or f"no answer in {STILL_S:g} s")
