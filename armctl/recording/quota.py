"""How much the logs may take: the oldest go when there are too many, and never the newest.

Rules.
1. Only finished logs of the daemon are ever deleted (`armctl-STAMP.mcap`): no take, no snapshot of a fault, no part.
2. The two newest stay whatever the bounds say: if they are too much, logging stops instead.
3. Age is counted from the newest log's own name, not from the clock: a clock that jumps ahead must not delete all.
"""

import calendar
import logging
import re
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from armctl.config import LogConfig
from armctl.recording.disk import DISK, Disk

# What the names of logs and of snapshots begin with.
LOG = "armctl"
FAULT = "fault"
KEPT = 2
_STAMP = re.compile(LOG + r"-(\d{8}T\d{6})Z(?:-\d+)?\.mcap")
_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class StoredLog:
    """A finished log."""

    path: Path
    size_bytes: int
    # Epoch time in its name.
    begin_s: int


def stored_logs(folder: Path) -> tuple[StoredLog, ...]:
    """The finished logs of a folder, oldest first."""
    found = []
    for path in folder.glob(f"{LOG}-*.mcap"):
        match = _STAMP.fullmatch(path.name)
        if match and path.is_file() and not path.is_symlink():
            begin_s = calendar.timegm(time.strptime(match[1], "%Y%m%dT%H%M%S"))
            found.append(StoredLog(path, path.stat().st_size, begin_s))
    return tuple(sorted(found, key=lambda log: (log.begin_s, len(log.path.name), log.path.name)))


def surplus(logs: Sequence[StoredLog], limits: LogConfig, free_bytes: int) -> tuple[StoredLog, ...]:
    """Which logs have to go, oldest first.

    Args:
        logs: Oldest first.
        free_bytes: What is free on their disk now.
    """
    total = sum(log.size_bytes for log in logs)
    gone: list[StoredLog] = []
    for log in logs[:-KEPT]:
        too_old = 0.0 < limits.max_age_s < logs[-1].begin_s - log.begin_s
        if not too_old and total <= limits.quota_bytes and free_bytes >= limits.free_bytes:
            break
        gone.append(log)
        total -= log.size_bytes
        free_bytes += log.size_bytes
    return tuple(gone)


def enforce(folder: Path, limits: LogConfig, *, disk: Disk = DISK) -> tuple[Path, ...]:
    """Delete what is too much; the files deleted.

    Raises:
        OSError: the folder cannot be read, or a file not be deleted.
    """
    gone = surplus(stored_logs(folder), limits, disk.free_bytes(folder))
    for log in gone:
        disk.remove(log.path)
        _log.info("%s: deleted, the logs had outgrown their bounds", log.path)
    return tuple(log.path for log in gone)
