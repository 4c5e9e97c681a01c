"""What `armctl stop` costs to start from a cold shell, beside `python3 -c pass` in the same run.

Whole processes, one after the other in turn: processor time (user and system) as the kernel accounts it to each child,
and how long it took. The lane that answers is this process's own, and answers at once: what the daemon does is in the
proofs `load` and `hang`. Bytecode is kept, as that of an installation is.
"""

import contextlib
import os
import socket
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from armctl.errors import ArmctlError
from proving.figures import check, row
from proving.rig import installed

ROUNDS = 21
MORE_BOUND_MS = 80.0
PASS = "python3 -c pass"
STOP = "armctl stop"


def bench(seed: int, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to `python3 -c pass`. Beyond the bound counts as a violation."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, installed(Path(name) / "bytecode"):
        path = Path(name) / "daemon.sock"
        script = Path(sys.executable).with_name("armctl")
        command = [str(script)] if script.exists() else [sys.executable, "-m", "armctl"]
        commands = {PASS: [sys.executable, "-c", "pass"], STOP: [*command, "stop", "--socket", str(path)]}
        with _lane(path.with_name(path.name + ".stop")):
            for command in commands.values():
                _run(command)  # leaves the bytecode behind
            taken = [{who: _run(command) for who, command in commands.items()} for _ in range(rounds)]
    rows = []
    for work, index in (("CPU of a whole process, median", 0), ("from start to end, median", 1)):
        ms = {who: statistics.median(one[who][index] for one in taken) for who in commands}
        rows += [row(work, who, value, "ms", value / ms[PASS]) for who, value in ms.items()]
    more_ms = rows[1]["value"] - rows[0]["value"]
    checks = [check(f"CPU of `{STOP}` beyond `{PASS}` [ms]", more_ms, MORE_BOUND_MS)]
    return {"rows": rows, "checks": checks, "violations": int(more_ms > MORE_BOUND_MS), "seed": seed}


def _run(command: list[str]) -> tuple[float, float]:
    """CPU and duration of one process [ms]."""
    begin_s = time.monotonic()
    process = subprocess.Popen(command, stdout=subprocess.PIPE)
    assert process.stdout is not None
    with process.stdout:
        said = process.stdout.read()
    _, status, usage = os.wait4(process.pid, 0)
    process.returncode = os.waitstatus_to_exitcode(status)
    took_s = time.monotonic() - begin_s
    if process.returncode or said not in (b"", b"holding\n"):
        raise ArmctlError(f"{' '.join(command)}: exit status {process.returncode}, said {said!r}")
    return 1e3 * (usage.ru_utime + usage.ru_stime), 1e3 * took_s


@contextlib.contextmanager
def _lane(path: Path) -> Iterator[None]:
    """Somebody who answers every `stop` at once."""
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()

        def answer() -> None:
            with contextlib.suppress(OSError):  # it is over
                while True:
                    caller, _ = listening.accept()
                    with caller:
                        caller.recv(256)
                        caller.sendall(b"ok holding\n")

        answering = threading.Thread(target=answer)
        answering.start()
        try:
            yield
        finally:
            listening.shutdown(socket.SHUT_RDWR)
            answering.join()
