"""The real daemon on a simulated arm, both as programs of their own, and all that is seen of them."""

from __future__ import annotations

import contextlib
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml

from armctl.client import Client
from armctl.config import ArmConfig, load_arm
from armctl.demo import program
from armctl.errors import ArmctlError
from armctl.sim.control import SimulatorClient, control_path

ARM = "ax12-line"
POLL_S = 0.05


@dataclass
class Seen:
    """Everything observed, each with the monotonic instant [ns] at which it arrived."""

    snapshots: list[tuple[int, dict[str, Any]]] = field(default_factory=list)
    servos: list[tuple[int, list[dict[str, Any]]]] = field(default_factory=list)
    """What the simulated servos' registers held."""


class Rig:
    """A daemon and a simulator that run, watched by two threads."""

    def __init__(self, socket: Path, port: Path, daemon_pid: int) -> None:
        self.arm: ArmConfig = load_arm(ARM)
        self.socket, self.port, self.daemon_pid = socket, port, daemon_pid
        self.client = Client(socket, timeout_s=15.0)
        self.simulator = SimulatorClient(control_path(port))
        self.seen = Seen()
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
def rig(
    *simulator_options: str, seed: int, before_daemon: Callable[[SimulatorClient, Path], None] | None = None
) -> Iterator[Rig]:
    """A fresh pair in a folder of its own; `before_daemon` may spoil the arm before the daemon meets it."""
    with contextlib.ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="armctl-")))
        port, socket, config = folder / "servos", folder / "daemon.sock", folder / "armctl.yaml"
        config.write_text(yaml.safe_dump({"port": str(port), "arm": ARM, "data_dir": str(folder)}), encoding="utf-8")
        cleanup.enter_context(
            program(folder / "simulator.log", "sim", "--link", str(port), "--seed", str(seed), *simulator_options)
        )
        if before_daemon is not None:
            with SimulatorClient(control_path(port)) as simulator:
                before_daemon(simulator, port)
        daemon = cleanup.enter_context(
            program(folder / "daemon.log", "daemon", "--config", str(config), "--socket", str(socket))
        )
        running = Rig(socket, port, daemon.pid)
        cleanup.callback(running.close)
        yield running
