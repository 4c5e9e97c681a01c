"""How much the logs may take: the oldest go when there are too many, and never the newest.

Rules.
1. Only finished logs of the daemon and snapshots of faults are ever deleted (`armctl-STAMP-NUMBER.mcap`,
   `fault-STAMP-CODE-NUMBER.mcap`): no take, and no part. Parts count.
2. The order is that of the numbers, which only rise, whatever the wall clock does. Files of an armctl without numbers
   are older than all that have one, in the order of their stamps.
3. The two newest of each kind stay whatever the bounds say: if they are too much, logging stops instead.
4. A log's age is counted along the numbers up to the newest one, and not from the clock. Where a stamp lies before the
   one before it, or further behind it than the bound on age, the clock may have been set: that time is no age.
5. The folder is read once, and again when it has changed, but at most once in `SCAN_NS` unless something is to go. The
   size of a finished log is asked once, since such files are replaced and never written again; and again before any
   of them goes.
"""

import calendar
import logging
import os
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

from armctl.clock import NS_PER_S
from armctl.config import LogConfig
from armctl.recording.disk import DISK, PART, Disk

# What the names of logs and of snapshots begin with.
LOG = "armctl"
FAULT = "fault"
KEPT = 2
SCAN_NS = 60 * NS_PER_S
# Digits of a number. With fewer it only tells files of the same second apart, as before there were numbers.
DIGITS = 6
_NAME = re.compile(rf"({LOG}|{FAULT})-(\d{{8}}T\d{{6}})Z(?:-[A-Z][A-Z0-9_]*)?(?:-(\d{{1,18}}))?\.mcap")
_log = logging.getLogger(__name__)


class StoredLog(NamedTuple):
    """A finished log, or a snapshot."""

    folder: Path
    name: str
    size_bytes: int
    # Epoch time in its name.
    begin_s: int
    # 0: it has none.
    number: int = 0
    inode: int = 0

    @property
    def path(self) -> Path:
        # Made where it is asked for: of ten thousand logs these would take half the time.
        return self.folder / self.name


# Each oldest first.
Logs = tuple[StoredLog, ...]


@dataclass(frozen=True)
class Stock:
    """What is in a folder."""

    logs: Logs = ()
    snapshots: Logs = ()
    part_bytes: int = 0
    # The highest number of any file.
    number: int = 0


def stock(folder: Path, before: Stock = Stock()) -> Stock:
    """What is in a folder.

    Args:
        before: What was: a file of it that is still the same has the same size.
    Raises:
        OSError: it cannot be read.
    """
    found: dict[str, list[StoredLog]] = {LOG: [], FAULT: []}
    known = {log.name: log for log in before.logs + before.snapshots}
    part_bytes = highest = 0
    with os.scandir(folder) as entries:
        for entry in entries:
            if (log := known.get(entry.name)) and log.inode == entry.inode():
                found[log.name.partition("-")[0]].append(log)
                highest = max(highest, log.number)
                continue
            part = f".mcap{PART}" in entry.name
            match = _NAME.fullmatch(entry.name.partition(PART)[0])
            if not (match or part) or not entry.is_file(follow_symlinks=False):
                continue
            try:
                size = entry.stat(follow_symlinks=False).st_size
            except FileNotFoundError:
                continue  # gone since
            part_bytes += size * part
            if match:
                number = int(match[3]) if len(match[3] or "") >= DIGITS else 0
                highest = max(highest, number)
                if not part:
                    log = StoredLog(folder, entry.name, size, _epoch_s(match[2]), number, entry.inode())
                    found[match[1]].append(log)
    for logs in found.values():
        logs.sort(key=_order)
    return Stock(tuple(found[LOG]), tuple(found[FAULT]), part_bytes, highest)


@lru_cache(2**14)
def _epoch_s(stamp: str) -> int:
    try:
        parts = stamp[:4], stamp[4:6], stamp[6:8], stamp[9:11], stamp[11:13], stamp[13:]
        return calendar.timegm(tuple(map(int, parts)))  # a tenth of what strptime takes
    except ValueError:  # digits that are no time
        return 0


def _order(log: StoredLog) -> tuple[int, int, int, str]:
    return log.number, log.begin_s, len(log.name), log.name


def remedy(folder: Path) -> str:
    """What helps where too little is free on the disk of this folder of logs."""
    act = "delete old logs" if any(folder.glob("*.mcap")) else "make room"
    return f"{act} in {folder}, or set log.free_bytes lower"


def ages_s(logs: Sequence[StoredLog], max_age_s: float) -> list[float]:
    """How old each log is, the oldest first (rule 4)."""
    ages = [0.0]
    for newer, older in pairwise(reversed(logs)):
        since_s = newer.begin_s - older.begin_s
        ages.append(ages[-1] + (since_s if 0 < since_s <= max_age_s else 0.0))
    return ages[: len(logs)][::-1]


def surplus(logs: Sequence[StoredLog], limits: LogConfig, free_bytes: int, more_bytes: int = 0) -> Logs:
    """Which logs have to go, oldest first.

    Args:
        logs: Oldest first.
        free_bytes: What is free on their disk now.
        more_bytes: What else counts: parts, and the file being written.
    """
    total = sum(log.size_bytes for log in logs) + more_bytes
    gone: list[StoredLog] = []
    for log, age_s in zip(logs[:-KEPT], ages_s(logs, limits.max_age_s), strict=False):
        too_old = 0.0 < limits.max_age_s < age_s
        if not too_old and total <= limits.quota_bytes and free_bytes >= limits.free_bytes:
            break
        gone.append(log)
        total -= log.size_bytes
        free_bytes += log.size_bytes
    return tuple(gone)


class Retention:
    """Keeps a folder within bounds.

    Args:
        now_ns: Monotonic time.
    """

    def __init__(self, folder: Path, limits: LogConfig, now_ns: Callable[[], int], disk: Disk = DISK) -> None:
        self._folder, self._limits, self._now_ns, self._disk = folder, limits, now_ns, disk
        self._stock = Stock()
        self._number = 0
        # State of the folder when it was read, and until when it is not read again; None: it never was.
        self._seen: tuple[int, ...] | None = None
        self._until_ns = 0
        # What may come to the files that were found before anything has to go; -1: something has to.
        self._spare_bytes = -1

    def next_number(self) -> int:
        """The number of a new file.

        Raises:
            OSError: the folder cannot be read.
        """
        self._number = max(self._number, self._read().number) + 1
        return self._number

    def enforce(self, more_bytes: int = 0) -> tuple[Path, ...]:
        """Delete what is too much; the files deleted.

        Args:
            more_bytes: What counts beside the finished files and the parts.
        Raises:
            OSError: the folder cannot be read, or a file not be deleted.
        """
        stock = self._read()
        fits = more_bytes <= self._spare_bytes and self._disk.free_bytes(self._folder) >= self._limits.free_bytes
        if fits or not self._surplus(stock, more_bytes):
            return ()
        gone = self._surplus(self._read(at_once=True), more_bytes)
        for log in gone:
            self._disk.remove(log.path)
            _log.info("%s: deleted, the logs had outgrown their bounds", log.path)
        self._read(at_once=True)
        return tuple(log.path for log in gone)

    def _surplus(self, stock: Stock, more_bytes: int) -> Logs:
        gone = surplus(stock.logs, self._limits, self._disk.free_bytes(self._folder), stock.part_bytes + more_bytes)
        bound = {"quota_bytes": self._limits.snapshots_bytes, "free_bytes": 0, "max_age_s": 0.0}
        return gone + surplus(stock.snapshots, self._limits.model_copy(update=bound), 0)

    def _read(self, *, at_once: bool = False) -> Stock:
        status = os.stat(self._folder)
        seen = status.st_dev, status.st_ino, status.st_mtime_ns
        moved = self._seen is None or seen[:2] != self._seen[:2]
        if at_once or moved or (seen != self._seen and self._now_ns() >= self._until_ns):
            self._stock = stock(self._folder, Stock() if at_once or moved else self._stock)
            self._seen, self._until_ns = seen, self._now_ns() + SCAN_NS
            logs, more = self._stock.logs, self._stock.part_bytes
            self._spare_bytes = self._limits.quota_bytes - sum(log.size_bytes for log in logs) - more
            if self._surplus(self._stock, 0):
                self._spare_bytes = -1
        return self._stock
