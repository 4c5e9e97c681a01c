"""The real daemon on a simulated arm, both as programs of their own, and all that is seen of them."""

import contextlib
import os
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from armctl.client import Client
from armctl.clock import NS_PER_S, MonotonicClock, ask_for_real_time
from armctl.config import ArmConfig
from armctl.dynamixel.kernel_worker import KernelWorker
from armctl.errors import ArmctlError, RequestRefused
from armctl.files import load_arm
from armctl.lab.demo import started
from armctl.sim.control import SimulatorClient, control_path

ARM = "ax12-line"
POLL_S = 0.05
LOOK_S = 0.01
# Nobody waits longer for a process whose daemon is gone.
OUTLIVES_S = 20.0
LONGEST_NS = 2 * NS_PER_S


@dataclass
class Seen:
    """Everything observed, each with the monotonic instant [ns] at which it arrived."""

    snapshots: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    # What the simulated servos' registers held.
    servos: list[tuple[int, list[dict[str, Any]]]] = field(default_factory=list)


class Rig:
    """A daemon and a simulator that run, watched by two threads."""

    def __init__(self, socket: Path, port: Path, daemon_pid: int, simulator_pid: int) -> None:
        self.arm: ArmConfig = load_arm(ARM)
        self.socket, self.port, self.daemon_pid, self.simulator_pid = socket, port, daemon_pid, simulator_pid
        self.client = Client(socket, timeout_s=15.0)
        self.simulator = SimulatorClient(control_path(port))
        self.seen = Seen()
        self.kernel = KernelWatch()
        self._ending = threading.Event()
        self._daemon_watcher = Client(socket)
        self._simulator_watcher = SimulatorClient(control_path(port))
        self._threads = [
            threading.Thread(target=work, daemon=True) for work in (self._watch_daemon, self._watch_simulator)
        ]
        for thread in self._threads:
            thread.start()

    def stop_watching(self) -> None:
        """From here on nobody subscribes or asks."""
        self._ending.set()
        for thread in self._threads:
            thread.join(2.0)
        self._daemon_watcher.close()
        self._simulator_watcher.close()

    def close(self) -> None:
        self.stop_watching()
        self.client.close()
        self.simulator.close()
        self.kernel.close()

    @property
    def snapshot(self) -> dict[str, Any]:
        """The newest."""
        return self.seen.snapshots[-1][1] if self.seen.snapshots else {}

    def wait(self, done: Callable[[dict[str, Any]], bool], timeout_s: float) -> bool:
        """Whether a snapshot came to hold in time."""
        deadline_s = time.monotonic() + timeout_s
        while time.monotonic() < deadline_s:
            if self.snapshot and done(self.snapshot):
                return True
            time.sleep(0.01)
        return False

    def _watch_daemon(self) -> None:
        with contextlib.suppress(ArmctlError, OSError):
            for snapshot in self._daemon_watcher.subscribe():
                self.seen.snapshots.append((time.monotonic_ns(), snapshot))
                if self._ending.is_set():
                    return

    def _watch_simulator(self) -> None:
        with contextlib.suppress(ArmctlError, OSError):
            while not self._ending.wait(POLL_S):
                self.seen.servos.append((time.monotonic_ns(), self._simulator_watcher.state()["servos"]))


@contextlib.contextmanager
def installed(folder: Path) -> Iterator[None]:
    """Programs started meanwhile find and keep their bytecode, as those of an installation do.

    A checkout may be told to keep none (PYTHONDONTWRITEBYTECODE); then half of each start is the compiler's.

    It ends when they all have: a job whose daemon was killed goes on until it next looks.

    Args:
        folder: Where the bytecode is kept.
    Raises:
        ArmctlError: one of them goes on.
    """
    before = {name: os.environ.pop(name, None) for name in ("PYTHONDONTWRITEBYTECODE", "PYTHONPYCACHEPREFIX")}
    os.environ["PYTHONPYCACHEPREFIX"] = str(folder)
    try:
        yield
    finally:
        del os.environ["PYTHONPYCACHEPREFIX"]
        os.environ.update({name: value for name, value in before.items() if value is not None})
        _wait_for_those_with(os.fsencode(folder))


def _wait_for_those_with(value: bytes) -> None:
    """Return once no process has it in its environment."""
    deadline_s = time.monotonic() + OUTLIVES_S
    while True:
        going_on = []
        for path in Path("/proc").glob("[0-9]*/environ"):
            with contextlib.suppress(OSError):  # it has just ended, or is somebody else's
                if value in path.read_bytes():
                    going_on.append(path.parent.name)
        if not going_on:
            return
        if time.monotonic() > deadline_s:
            raise ArmctlError(f"processes {', '.join(going_on)} go on after everything was ended")
        time.sleep(POLL_S)


class OtherWork:
    """How busy the machine is with what is none of this: programs that were not started from here."""

    def __init__(self) -> None:
        self._begin_s = time.monotonic()
        self._busy_s = _machine_s() - _own_s()

    def cores(self) -> float:
        """Cores that other programs have used on average since this was made."""
        return (_machine_s() - _own_s() - self._busy_s) / (time.monotonic() - self._begin_s)


class KernelWatch:
    """How long the kernel keeps back what programs tell one another over a pseudo terminal, looked at all the time."""

    def __init__(self) -> None:
        self._worker, self._clock = KernelWorker(), MonotonicClock()
        # When a byte was sent, and when it came [ns].
        self._delays: list[tuple[int, int]] = []
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._look, daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._ending.set()
        self._thread.join()
        self._worker.close()

    def worst_s(self, begin_ns: int, end_ns: int) -> float:
        """The longest delay of a byte that was on its way between two instants."""
        return max((end - begin for begin, end in self._delays if end >= begin_ns and begin <= end_ns), default=0) / 1e9

    def _look(self) -> None:
        ask_for_real_time()  # this thread: it is to see the kernel's delays, not its own
        while not self._ending.wait(LOOK_S):
            begin_ns = self._clock.now_ns()
            self._delays.append((begin_ns, begin_ns + self._worker.delay_ns(self._clock, begin_ns + LONGEST_NS)))


def waited_s(pid: int) -> float:
    """How long a process has been ready to run and had no processor so far (its main thread)."""
    with contextlib.suppress(OSError, IndexError):  # ended, or a kernel that keeps no such accounts
        return int(Path(f"/proc/{pid}/schedstat").read_text(encoding="utf-8").split()[1]) / 1e9
    return 0.0


def _machine_s() -> float:
    """Processor time used since the machine was started, by whatever."""
    user, nice, system, _idle, _waiting, irq, softirq, steal, *_ = map(
        int, Path("/proc/stat").read_text(encoding="utf-8").split("\n", 1)[0].split()[1:]
    )
    return (user + nice + system + irq + softirq + steal) / os.sysconf("SC_CLK_TCK")


def _own_s() -> float:
    """Processor time used by this process and all that were started from it, those that have ended included."""
    parents: dict[int, int] = {}
    ticks: dict[int, int] = {}
    for path in Path("/proc").glob("[0-9]*/stat"):
        with contextlib.suppress(OSError):  # ended meanwhile
            fields = path.read_text(encoding="utf-8").rpartition(") ")[2].split()
            pid = int(path.parent.name)
            parents[pid], ticks[pid] = int(fields[1]), sum(map(int, fields[11:15]))
    own = {os.getpid()}
    while grown := {pid for pid, parent in parents.items() if parent in own} - own:
        own |= grown
    return sum(ticks[pid] for pid in own) / os.sysconf("SC_CLK_TCK")


def hold(client: Client, timeout_s: float) -> list[str]:
    """Bring the arm to hold, whatever it does; returns the faults that stood in the way.

    Raises:
        ArmctlError: it did not hold in time.
    """
    deadline_s, faults = time.monotonic() + timeout_s, list[str]()
    while (status := client.call("status"))["state"] != "holding":
        fault = status["fault"]
        if fault is not None and f"{fault['code']}: {fault['text']}" not in faults:
            faults.append(f"{fault['code']}: {fault['text']}")
        if time.monotonic() > deadline_s:
            raise ArmctlError(f"the arm does not hold within {timeout_s:g} s: {status['state']}, {faults}")
        with contextlib.suppress(RequestRefused):  # a servo answered late: again
            if status["state"] in ("off", "faulted"):
                client.call("torque_on" if fault is None else "clear")
        time.sleep(POLL_S)
    return faults


@contextlib.contextmanager
def rig(
    *simulator_options: str, seed: int, before_daemon: Callable[[SimulatorClient, Path], None] | None = None
) -> Iterator[Rig]:
    """A fresh pair in a folder of its own; `before_daemon` may spoil the arm before the daemon meets it."""
    with contextlib.ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="armctl-")))
        cleanup.enter_context(installed(folder / "bytecode"))
        port, socket, config = folder / "servos", folder / "daemon.sock", folder / "armctl.yaml"
        config.write_text(yaml.safe_dump({"port": str(port), "arm": ARM, "data_dir": str(folder)}), encoding="utf-8")
        servos, _ = cleanup.enter_context(
            started(folder / "simulator.log", "sim", "--link", str(port), "--seed", str(seed), *simulator_options)
        )
        if before_daemon is not None:
            with SimulatorClient(control_path(port)) as simulator:
                before_daemon(simulator, port)
        daemon, _ = cleanup.enter_context(
            started(folder / "daemon.log", "daemon", "--config", str(config), "--socket", str(socket))
        )
        running = Rig(socket, port, daemon.pid, servos.pid)
        cleanup.callback(running.close)
        yield running
