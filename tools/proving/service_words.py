"""The systemd units, judged by systemd itself, and the service protocol, by a stand-in for the service manager.

`systemd-analyze verify` has to say nothing, and the exposure it works out has to stay within its bound. The daemon has
to say READY=1 only when it serves, to feed the watchdog while its control loop ticks, to stop feeding it when the loop
stands still, and to say STOPPING=1 when it is told to end.
"""

import contextlib
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from armctl.commissioning.installation import TEMPLATE_PREFIX, UNITS, template
from armctl.errors import ArmctlError
from armctl.lab.demo import started

EXPOSURE = {"armctl.service": 0.9, "armctl-web.service": 1.1}
# WatchdogSec of the unit.
WATCHDOG_S = 10.0
# Without a tick for so long no word may come; the unit's watchdog waits longer.
QUIET_S = 0.2


class NotifySocket:
    """What a service manager listens on."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(str(path))

    def close(self) -> None:
        self._socket.close()

    def heard(self, word: str, timeout_s: float) -> bool:
        """Whether `word` comes within the time; what else comes is dropped."""
        deadline_s = time.monotonic() + timeout_s
        while (left_s := deadline_s - time.monotonic()) > 0.0:
            self._socket.settimeout(left_s)
            with contextlib.suppress(TimeoutError):
                if word in self._socket.recv(4096).decode().split("\n"):
                    return True
        return False

    def drain(self) -> None:
        """Forget what has come."""
        self._socket.setblocking(False)
        with contextlib.suppress(BlockingIOError):
            while True:
                self._socket.recv(4096)


def units() -> Iterator[dict[str, Any]]:
    """What systemd-analyze says of each unit.

    Raises:
        ArmctlError: systemd-analyze is not on this machine.
    """
    if shutil.which("systemd-analyze") is None:
        raise ArmctlError("systemd-analyze is missing; install it: sudo apt install systemd")
    with tempfile.TemporaryDirectory(prefix="armctl-") as name:
        folder = Path(name)
        program_there = folder / "bin" / "armctl"
        program_there.parent.mkdir()
        program_there.symlink_to(sys.executable)
        for unit in UNITS:
            (folder / unit).write_text(template(unit).replace(TEMPLATE_PREFIX, name), encoding="utf-8")
        for unit in UNITS:
            verify = _analyze("verify", str(folder / unit))
            clean = verify.returncode == 0 and not verify.stderr
            yield {"name": f"{unit}: systemd-analyze verify", "ok": clean, "value": verify.stderr.strip() or "silent"}
            security = _analyze("security", "--offline=true", "--no-pager", str(folder / unit))
            found = re.search(r"exposure level for \S+: ([0-9.]+)", security.stdout)
            exposure = float(found[1]) if found else float("inf")
            yield {
                "name": f"{unit}: exposure at most {EXPOSURE[unit]}",
                "ok": exposure <= EXPOSURE[unit],
                "value": str(exposure),
            }


def _analyze(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(("systemd-analyze", *arguments), capture_output=True, text=True, timeout=60)


def protocol(seed: int) -> Iterator[dict[str, Any]]:
    """The daemon on a simulated arm, from its start to its end, as its service manager hears it."""
    with contextlib.ExitStack() as cleanup:
        folder = Path(cleanup.enter_context(tempfile.TemporaryDirectory(prefix="armctl-")))
        notify = NotifySocket(folder / "notify")
        cleanup.callback(notify.close)
        port, log = folder / "servos", folder / "programs.log"
        cleanup.enter_context(started(log, "sim", "--link", str(port), "--seed", str(seed)))
        environment = {
            **os.environ,
            "NOTIFY_SOCKET": str(notify.path),
            "XDG_DATA_HOME": str(folder),
            "ARMCTL_SOCKET": str(folder / "daemon.sock"),
        }
        with log.open("a") as words:
            daemon = subprocess.Popen(
                (sys.executable, "-m", "armctl", "daemon", "--port", str(port)),
                env=environment,
                stdout=subprocess.DEVNULL,
                stderr=words,
            )
        cleanup.callback(_end, daemon)
        ready = notify.heard("READY=1", 30.0)
        yield {"name": "READY=1 when it serves", "ok": ready and (folder / "daemon.sock").is_socket(), "value": ready}
        fed = notify.heard("WATCHDOG=1", WATCHDOG_S)
        yield {"name": "the watchdog is fed while the loop ticks", "ok": fed, "value": fed}
        [control] = map(int, Path(f"/proc/{daemon.pid}/task/{daemon.pid}/children").read_text().split())
        os.kill(control, signal.SIGSTOP)
        try:
            notify.heard("", 0.3)  # what was under way
            notify.drain()
            quiet = not notify.heard("WATCHDOG=1", QUIET_S)
        finally:
            with contextlib.suppress(ProcessLookupError):  # it hung for so long that it was replaced
                os.kill(control, signal.SIGCONT)
        yield {"name": "and not when it stands still", "ok": quiet, "value": quiet}
        again = notify.heard("WATCHDOG=1", WATCHDOG_S)
        yield {"name": "and again when it goes on, or is replaced", "ok": again, "value": again}
        daemon.terminate()
        stopping = notify.heard("STOPPING=1", WATCHDOG_S)
        yield {"name": "STOPPING=1 on SIGTERM", "ok": stopping, "value": stopping}
        try:
            status: int | str = daemon.wait(10.0)
        except subprocess.TimeoutExpired:
            status = "still running"
        yield {"name": "SIGTERM ends it with status 0", "ok": status == 0, "value": status}


def _end(daemon: subprocess.Popen[bytes]) -> None:
    if daemon.poll() is None:
        daemon.kill()
        daemon.wait()
