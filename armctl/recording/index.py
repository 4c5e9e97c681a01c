"""An index of a folder of logs: what each one is, what happened in it, and what its servos went through.

Rules.
1. It is a sqlite3 file beside the logs; in the user's cache where the folder cannot be written, or in memory where
   there is no room either. It holds nothing that is not in the logs or in `NOTES`: one that is lost, damaged or of
   another armctl is made anew.
2. A log is read once, and again when its size or its time has changed. What is gone is forgotten.
3. Of new logs the newest `FEW` are read before an answer. What else there is (all of it, where the index was lost) is
   read by a process of its own, one a folder, and `unread` says how many logs an answer lacks. The daemon starts one
   when it starts and when it begins another log (compact.py), a command when it has to.
4. One that is up to date is asked without loading what reads logs (entry.py): that takes longer than the answer.
"""

from __future__ import annotations

import fcntl
import hashlib
import os
import sqlite3
import sys
from collections.abc import Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, suppress
from pathlib import Path
from subprocess import DEVNULL, Popen
from typing import TYPE_CHECKING, Any

from armctl.errors import LogError
from armctl.recording.notes import FIGURES, NOTE, NOTE_LEVEL, notes

if TYPE_CHECKING:
    from armctl.recording.entry import Entry

INDEX = ".index.sqlite3"
# Changes with the tables (index.sql); an index of another number is made anew.
VERSION = 3
FEW = 12
_TABLES = Path(__file__).with_suffix(".sql")


class Index(AbstractContextManager["Index"]):
    """The index of a folder; `catch_up` before asking.

    Raises:
        LogError: there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        # Logs that are there and not in the index, as far as `catch_up` left some.
        self.unread = 0
        if not folder.is_dir():
            raise LogError(f"{folder}: is no folder with logs; name one with --log-dir")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armctl"
        name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
        beside = [folder / INDEX] if os.access(folder, os.W_OK) else []
        for self.path in (*beside, cache / f"index-{name}.sqlite3", Path(":memory:")):
            with suppress(sqlite3.Error, OSError):  # no room, or no right
                self._db = _opened(self.path)
                break

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self._db.close()
        if isinstance(error, sqlite3.Error):
            self.path.unlink(missing_ok=True)
            raise LogError(f"{self.path}: was damaged ({error}) and is gone; the same command makes it anew") from None

    def ask(self, query: str, arguments: Sequence[Any] = ()) -> list[dict[str, Any]]:
        """Rows of its tables."""
        cursor = self._db.execute(query, arguments)
        names = [column[0] for column in cursor.description]
        return [dict(zip(names, row, strict=True)) for row in cursor]

    def new(self) -> list[str]:
        """Forget what is gone or has changed; names of the logs that have to be read, the newest first."""
        there = dict(_files(self.folder))
        known = {name: status for name, *status in self._db.execute("SELECT name, size, mtime_ns FROM logs")}
        if there == known:
            return []
        with self._db:
            self._forget(name for name, status in known.items() if there.get(name) != status)
        new = [name for name, status in there.items() if known.get(name) != status]
        return sorted(new, key=lambda name: (there[name][1], name), reverse=True)

    def read(self, names: Sequence[str]) -> None:
        """Take logs into the index, and all notes."""
        if names:
            from armctl.recording.entry import entries

            for entry in entries([self.folder / name for name in names], in_processes=len(names) > FEW):
                self._add(entry)
        self._add_notes()

    def catch_up(self) -> None:
        """Read what an answer waits for, and have the rest read."""
        new = self.new()
        self.read(new[:FEW])
        self.unread = len(new[FEW:])
        if self.unread:
            command = [sys.executable, "-m", "armctl.recording.index", str(self.folder)]
            Popen(command, stdin=DEVNULL, stdout=DEVNULL, stderr=DEVNULL, start_new_session=True)

    def _forget(self, names: Iterable[str]) -> None:
        gone = [(name,) for name in names]
        for table in ("events", "minutes"):
            self._db.executemany(f"DELETE FROM {table} WHERE log = (SELECT id FROM logs WHERE name = ?)", gone)
        self._db.executemany("DELETE FROM logs WHERE name = ?", gone)

    def _add(self, entry: Entry) -> None:
        about = [getattr(entry, key) for key in _KEPT]
        with self._db:
            self._forget([entry.name])  # another process may have read it meanwhile
            places = ", ".join("?" * len(_KEPT))
            number = self._db.execute(f"INSERT INTO logs({', '.join(_KEPT)}) VALUES({places})", about).lastrowid
            events, minutes = ([(number, *row) for row in rows] for rows in (entry.events, entry.minutes))
            self._db.executemany(f"INSERT INTO events VALUES({', '.join('?' * 6)})", events)
            self._db.executemany(f"INSERT INTO minutes VALUES({', '.join('?' * (4 + len(FIGURES)))})", minutes)

    def _add_notes(self) -> None:
        """Take the notes over as events, at the time their log begins."""
        told = notes(self.folder)
        if len(told) == self.ask("SELECT count(*) AS n FROM events WHERE code = ?", [NOTE])[0]["n"]:
            return
        begun = {row["name"]: (row["id"], row["start_s"]) for row in self.ask("SELECT * FROM logs")}
        rows = [(*begun[name], NOTE_LEVEL, NOTE, None, text) for name, text in told if name in begun]
        with self._db:
            self._db.execute("DELETE FROM events WHERE code = ?", (NOTE,))
            self._db.executemany(f"INSERT INTO events VALUES({', '.join('?' * 6)})", rows)


_KEPT = ("name", "size", "mtime_ns", "start_s", "duration_s", "arm_id", "version", "simulated", "complete", "problem")


def _files(folder: Path) -> Iterator[tuple[str, list[int]]]:
    """Name, size and time of every log in a folder whose name is text."""
    with os.scandir(folder) as found:
        for file in found:
            if file.name.endswith((".mcap", ".mcap.part")) and file.name.encode(errors="replace").decode() == file.name:
                with suppress(OSError):  # gone since
                    status = file.stat()
                    yield file.name, [status.st_size, status.st_mtime_ns]


def _opened(path: Path) -> sqlite3.Connection:
    path.parent.mkdir(parents=True, exist_ok=True)
    try:
        return _connected(path)
    except sqlite3.DatabaseError:  # damaged
        path.unlink()
        return _connected(path)


def _connected(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=10.0)
    if db.execute("PRAGMA user_version").fetchone()[0] != VERSION:
        db.executescript(_TABLES.read_text() + f"PRAGMA user_version = {VERSION};")
    db.execute("PRAGMA synchronous = OFF")  # what a power cut spoils is made anew
    return db


def bring_up_to_date(folder: Path) -> None:
    """Read all that is new in a folder, unless another process is at it.

    Raises:
        LogError: there is no such folder, or no index of it can be kept.
    """
    with Index(folder) as index:
        lock = os.open(folder, os.O_RDONLY)
        with suppress(BlockingIOError):
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            index.read(index.new())
        os.close(lock)


if __name__ == "__main__":
    os.nice(10)
    bring_up_to_date(Path(sys.argv[1]))
