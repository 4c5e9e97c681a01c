"""A busy machine is no hung daemon: nothing is told silent, or replaced, that only waits for a processor or the disk.

Four processes compute, and every fdatasync of the daemon takes two seconds longer, as on a worn card. The arm goes to
and fro. Judged: no message of the log tells of a silent host, the control process stays the one it was, and every
motion ends where it was to. The log is read by the mcap package.
"""

import contextlib
import math
import os
import signal
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

from mcap.exceptions import EndOfFile
from mcap.records import Message
from mcap.stream_reader import StreamReader

from armctl.client import Client
from armctl.errors import ArmctlError
from proving.jitter_bench import busy
from proving.rig import Rig, hold, rig

HOURS = 2.0
HOGS = 4
SYNC_S = 2.0
# A motion is answered once its recording is complete, which waits for the disk some times.
PATIENCE_S = 60.0
SWING_S = 3.0
SWING_DEG = ((-20.0, 130.0, -115.0, 60.0, 0.0, 0.0), (20.0, 130.0, -115.0, 60.0, 0.0, 0.0))
NEAR_RAD = math.radians(10.0)
TELL_EVERY_S = 60.0
WORD = b"HOST_SILENT"
# What Python runs in every program that is started meanwhile; a letter in a file for each sync.
SLOW_SYNC = """
import os, time
_fdatasync = os.fdatasync
def _slowly(fd):
    time.sleep({seconds})
    _fdatasync(fd)
    with open({counted!r}, "a") as stream:
        stream.write(".")
os.fdatasync = _slowly
"""


def watch(seed: int, hours: float = HOURS, tell: Callable[[str], None] = lambda _: None) -> dict[str, Any]:
    """Keep a daemon on a simulated arm busy for so long.

    Returns:
        `hours`, `motions`, `syncs` of the disk, `messages` read in the log, `violations` (texts).
    """
    violations: list[str] = []
    seconds, motions = hours * 3600.0, 0
    with _slow_disk() as syncs, contextlib.ExitStack() as hogs:
        # Begun before the rig, which ends when every program does that was started after it; and ended before it: the
        # daemon's logs are compacted only where nothing else wants the processor.
        hogs.enter_context(busy(HOGS, seconds + PATIENCE_S))
        with rig(seed=seed) as running:
            running.stop_watching()
            client = hogs.enter_context(Client(running.socket, timeout_s=PATIENCE_S))
            hold(client, PATIENCE_S)
            control = client.call("status")["pids"]["control"]
            begin_s = told_s = time.monotonic()
            while (now_s := time.monotonic()) - begin_s < seconds:
                goal = [math.radians(q) for q in SWING_DEG[motions % 2]]
                motions += 1
                try:
                    client.call("move", joints_rad=goal, duration_s=SWING_S)
                except ArmctlError as error:
                    violations.append(f"motion {motions} after {now_s - begin_s:.0f} s: {error}")
                    tell(violations[-1])
                    hold(client, PATIENCE_S)
                truth = running.simulator.state()["joints_rad"]
                if max(abs(q - wanted) for q, wanted in zip(truth, goal, strict=True)) > NEAR_RAD:
                    violations.append(f"motion {motions} ended elsewhere")
                if (pid := client.call("status")["pids"]["control"]) != control:
                    violations.append(f"control process {control} was replaced by {pid}")
                    control = pid
                if now_s - told_s >= TELL_EVERY_S:
                    told_s = now_s
                    tell(f"{now_s - begin_s:.0f} of {seconds:.0f} s, {motions} motions, {len(violations)} violations")
            _end(running)
            hogs.close()
            messages, words = _log(running.socket.parent)
            tell(f"{messages} messages of the log, {words} of them tell of {WORD.decode()}")
            synced = syncs()
    if words:
        violations.append(f"{words} messages of the log tell of {WORD.decode()}")
    if not (messages and synced):
        violations.append(f"{messages} messages in {synced} syncs: no log, or no slow disk")
    return {"hours": hours, "motions": motions, "syncs": synced, "messages": messages, "violations": violations}


@contextlib.contextmanager
def _slow_disk() -> Iterator[Callable[[], int]]:
    """Programs of Python started meanwhile wait for the disk longer; yields what tells how often they did."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as folder:
        counted = Path(folder, "syncs")
        counted.touch()
        Path(folder, "sitecustomize.py").write_text(
            SLOW_SYNC.format(seconds=SYNC_S, counted=str(counted)), encoding="utf-8"
        )
        path = os.pathsep.join(filter(None, (folder, os.environ.get("PYTHONPATH"))))
        with mock.patch.dict(os.environ, PYTHONPATH=path):
            yield lambda: counted.stat().st_size


def _end(running: Rig) -> None:
    """End the daemon, which completes its log."""
    os.kill(running.daemon_pid, signal.SIGTERM)
    os.waitid(os.P_PID, running.daemon_pid, os.WEXITED | os.WNOWAIT)


def _log(folder: Path) -> tuple[int, int]:
    """Messages of all logs under a folder, and how many of them hold the word."""
    messages = words = 0
    for path in folder.rglob("*.mcap*"):
        with path.open("rb") as stream, contextlib.suppress(EndOfFile):
            for record in StreamReader(stream).records:
                if isinstance(record, Message):
                    messages += 1
                    words += WORD in record.data
    return messages, words
