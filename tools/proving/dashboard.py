"""`armctl web` on a daemon on simulated servos, each a program of its own."""

import contextlib
import os
import socket
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import yaml

from armctl.errors import ArmctlError
from armctl.lab.demo import started
from proving.rig import ARM

STOP_S = 10.0


@dataclass(frozen=True)
class Dashboard:
    """Where everything is."""

    folder: Path
    # The daemon's.
    socket: Path
    daemon: subprocess.Popen[str]
    web: subprocess.Popen[str]
    port: int
    token: str
    web_log: Path

    @property
    def address(self) -> str:
        return f"http://127.0.0.1:{self.port}"


@contextlib.contextmanager
def dashboard(folder: Path, seed: int) -> Iterator[Dashboard]:
    """Everything started in `folder`, and ended on leaving.

    Raises:
        ArmctlError: one of the programs did not start.
    """
    servos, path, config = folder / "servos", folder / "daemon.sock", folder / "armctl.yaml"
    config.write_text(yaml.safe_dump({"port": str(servos), "arm": ARM, "data_dir": str(folder)}), encoding="utf-8")
    common = ("--config", str(config), "--socket", str(path))
    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(started(folder / "simulator.log", "sim", "--link", str(servos), "--seed", str(seed)))
        daemon, _ = cleanup.enter_context(started(folder / "daemon.log", "daemon", *common))
        web, port, token = cleanup.enter_context(pages(folder / "web.log", *common))
        yield Dashboard(folder, path, daemon, web, port, token, folder / "web.log")


@contextlib.contextmanager
def pages(log: Path, *common: str, own: Path | None = None) -> Iterator[tuple[subprocess.Popen[str], int, str]]:
    """`armctl web` alone, with its TCP port and its token.

    Args:
        own: Where the arms of its user lie; None: as for whoever runs this.
    Raises:
        ArmctlError: it did not start.
    """
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = int(probe.getsockname()[1])
    command = [sys.executable, "-m", "armctl", "web", "--port", str(port), *common]
    environment = None if own is None else {**os.environ, "XDG_CONFIG_HOME": str(own)}
    with log.open("w", encoding="utf-8") as words:
        web = subprocess.Popen(
            command, stdout=subprocess.PIPE, stderr=words, text=True, start_new_session=True, env=environment
        )
    try:
        assert web.stdout is not None
        ready, _, token = web.stdout.readline().strip().partition("#token=")
        if not ready.startswith("ready "):
            raise ArmctlError(f"armctl web did not start: {log.read_text(encoding='utf-8').strip()[-300:]}")
        yield web, port, token
    finally:
        _end(web)


def _end(process: subprocess.Popen[str]) -> None:
    process.terminate()
    try:
        process.wait(STOP_S)
    except subprocess.TimeoutExpired:
        process.kill()
        process.wait()
    assert process.stdout is not None
    process.stdout.close()
