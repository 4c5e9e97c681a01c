"""An index of a folder of logs: what each one is, what happened in it, and what its servos went through.

Rules.
1. It is a sqlite3 file beside the logs, or in the user's cache where the folder cannot be written. It holds nothing
   that is not in the logs or in `NOTES`: one that is lost, damaged or of another armctl is made anew.
2. A log is read once, and again when its size or its time has changed. What is gone is forgotten.
3. Servos are kept by the minute: the highest temperature and load, the lowest voltage, the mean distance from the goal
   while there is torque.
4. A log that cannot be read is listed with what is wrong with it, and disturbs no other.
"""

import hashlib
import json
import math
import os
import re
import sqlite3
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor, as_completed
from contextlib import suppress
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from armctl.clock import NS_PER_S
from armctl.dynamixel import ax12a
from armctl.errors import LogError
from armctl.recording import channels
from armctl.recording.columns import Payloads, Table
from armctl.recording.log_file import LogFile

INDEX, NOTES = ".index.sqlite3", "notes.jsonl"
# Changes with the tables below; an index of another number is made anew.
VERSION = 1
MINUTE_NS = 60 * NS_PER_S
# Fewer logs are read in this process: others take half a second to start.
FEW = 12
WORKERS = 2
FAULT_LEVEL, NOTE_LEVEL = 40, 20
NOTE = "NOTE"
# Of a minute of a servo, in the order of its columns (see the tables).
FIGURES = ("temperature_degC", "load_ratio", "load_mean_ratio", "voltage_V", "error_deg")
_TABLES = Path(__file__).with_suffix(".sql")
_SERVO = re.compile(r" \(servo (\d+)\): ")
Progress = Callable[[float], None]


@dataclass
class Entry:
    """What the index keeps of one log; times are epoch times."""

    name: str
    size: int
    mtime_ns: int
    start_s: float | None = None
    duration_s: float | None = None
    arm_id: str | None = None
    version: str | None = None
    # None: the log does not say.
    simulated: bool | None = None
    complete: bool = False
    # Why it could not be read.
    problem: str = ""
    # (time_s, level, code, servo_id, text)
    events: list[tuple[float, int, str, int | None, str]] = field(default_factory=list)
    # (time_s, servo_id, joint, *FIGURES)
    minutes: list[tuple[Any, ...]] = field(default_factory=list)


def describe(path: Path) -> Entry:
    """Read one log."""
    entry = Entry(path.name, 0, 0)
    try:
        status = path.stat()
        entry.size, entry.mtime_ns = status.st_size, status.st_mtime_ns
        with LogFile(path) as log:
            entry.arm_id, entry.version = (log.facts.get(key) for key in ("arm_id", "version"))
            if "simulated" in log.facts:
                entry.simulated = log.facts["simulated"] == "true"
            found = log.payloads((channels.SERVOS, channels.ROSOUT, channels.COMMAND))
            entry.complete = log.complete
            if channels.SERVOS in found and (times := found[channels.SERVOS].log_time_ns):
                entry.start_s, entry.duration_s = times[0] / NS_PER_S, (times[-1] - times[0]) / NS_PER_S
                for table in log.tables(channels.SERVOS, found[channels.SERVOS]):
                    entry.minutes += _minutes(table)
            for topic in (channels.ROSOUT, channels.COMMAND):
                told = found.get(topic, Payloads())
                for time_ns, data in zip(told.log_time_ns, told.data, strict=True):
                    if topic == channels.ROSOUT or b'"event"' in data:
                        entry.events += _event(time_ns / NS_PER_S, topic, log.codec(topic).decode(data))
    except (LogError, OSError) as error:
        entry.problem = str(error)
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:  # a file from elsewhere may hold anything
        entry.problem = f"{path}: is not as armctl writes it: {error!r}"
    return entry


def _event(time_s: float, topic: str, value: dict[str, Any]) -> Iterator[tuple[float, int, str, int | None, str]]:
    if topic == channels.ROSOUT:
        servo = _SERVO.search(value["msg"])
        yield time_s, value["level"], value["function"], int(servo[1]) if servo else None, value["msg"]
    elif isinstance(code := (note := channels.parse_note(value["data"])).get("event"), str):
        yield time_s, NOTE_LEVEL, code, None, str(note.get("text") or note.get("name") or "")


def _minutes(table: Table) -> Iterator[tuple[Any, ...]]:
    """Every servo by the minute, of messages of one shape."""
    time_ns = table.log_time_ns.astype(np.int64)
    for index in range(sum(path.endswith("].registers") for path in table.columns)):
        registers, name = table.columns[f"servos[{index}].registers"], table.columns[f"servos[{index}].name"]
        if not isinstance(registers, np.ndarray) or registers.ndim != 2 or registers.shape[1] < ax12a.STATUS_SIZE:
            continue  # it never answered
        kept = table.numbers(f"servos[{index}].fresh") > 0
        blocks, times = registers[kept].astype(np.int32), time_ns[kept]
        if not len(times):
            continue
        torque = blocks[:, ax12a.TORQUE_ENABLE.address - ax12a.STATUS_BEGIN] > 0
        load = (_word(blocks, ax12a.PRESENT_LOAD) & 1023) / 1023.0
        off_tick = np.abs(_word(blocks, ax12a.PRESENT_POSITION) - _word(blocks, ax12a.GOAL))
        error_deg = off_tick * math.degrees(ax12a.TICK_RAD)
        begins = np.flatnonzero(np.diff(times // MINUTE_NS, prepend=-1))
        counts = np.diff(begins, append=len(times))
        under_torque = np.add.reduceat(torque.astype(float), begins)
        columns = (
            times[begins] / NS_PER_S,
            np.maximum.reduceat(blocks[:, ax12a.PRESENT_TEMPERATURE.address - ax12a.STATUS_BEGIN], begins),
            np.maximum.reduceat(load, begins),
            np.add.reduceat(load, begins) / counts,
            np.minimum.reduceat(blocks[:, ax12a.PRESENT_VOLTAGE.address - ax12a.STATUS_BEGIN], begins) / 10.0,
            # Of no tick with torque: no figure.
            np.add.reduceat(error_deg * torque, begins) / np.where(under_torque, under_torque, np.nan),
        )
        servo_id, joint = int(table.numbers(f"servos[{index}].id")[0]), name[0]
        for time_s, *figures in zip(*(column.tolist() for column in columns), strict=True):
            yield time_s, servo_id, joint, *figures


def _word(blocks: NDArray[np.int32], register: ax12a.Register) -> NDArray[np.int32]:
    low = register.address - ax12a.STATUS_BEGIN
    return blocks[:, low] + 256 * blocks[:, low + 1]


class Index:
    """The index of a folder; `update` before asking.

    Raises:
        LogError: there is no such folder.
    """

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        if not folder.is_dir():
            raise LogError(f"{folder}: is no folder with logs; name one with --log-dir")
        cache = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "armctl"
        name = hashlib.sha256(str(folder.resolve()).encode()).hexdigest()[:16]
        self.path = folder if os.access(folder, os.W_OK) else cache
        self.path /= INDEX if self.path == folder else f"index-{name}.sqlite3"
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            try:
                self._db = _opened(self.path)
            except sqlite3.DatabaseError:  # damaged
                self.path.unlink()
                self._db = _opened(self.path)
        except (sqlite3.Error, OSError) as error:
            raise LogError(f"{self.path}: the index cannot be kept there: {error}") from None

    def __enter__(self) -> Self:
        return self

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

    def update(self, progress: Progress | None = None) -> int:
        """Read what is new or has changed; how many logs were read.

        Args:
            progress: Called with the fraction done.
        """
        there = dict(_files(self.folder))
        known = {row["name"]: (row["size"], row["mtime_ns"], row["id"]) for row in self.ask("SELECT * FROM logs")}
        gone = [known[name][2] for name in known if name not in there or known[name][:2] != there[name]]
        new = sorted(name for name in there if name not in known or known[name][:2] != there[name])
        with self._db:
            for table, key in (("logs", "id"), ("events", "log"), ("minutes", "log")):
                self._db.executemany(f"DELETE FROM {table} WHERE {key} = ?", [(number,) for number in gone])
        for count, entry in enumerate(_described([self.folder / name for name in new]), 1):
            self._add(entry)
            if progress is not None:
                progress(count / len(new))
        self._add_notes()
        return len(new)

    def _add(self, entry: Entry) -> None:
        about = [getattr(entry, key) for key in _KEPT]
        with self._db:
            places = ", ".join("?" * len(_KEPT))
            added = self._db.execute(f"INSERT OR REPLACE INTO logs({', '.join(_KEPT)}) VALUES({places})", about)
            number = added.lastrowid
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


def add_note(log: Path, text: str) -> None:
    """Keep a note about a log, beside it.

    Raises:
        LogError: there is no such log, or the note cannot be written.
    """
    if not log.is_file():
        raise LogError(f"{log}: there is no such log")
    line = json.dumps({"log": log.name, "text": text}) + "\n"
    try:
        with (log.parent / NOTES).open("a", encoding="utf-8") as file:
            file.write(line)  # in one write, so that two who note at once do not mix
    except OSError as error:
        raise LogError(f"{log.parent / NOTES}: cannot be written: {error.strerror}") from None


def notes(folder: Path) -> list[tuple[str, str]]:
    """Name of a log and text of every note in a folder; lines that are none are passed over."""
    found = []
    with suppress(OSError):
        for line in (folder / NOTES).read_text(encoding="utf-8", errors="replace").splitlines():
            note = channels.parse_note(line)
            if isinstance(note.get("log"), str) and isinstance(note.get("text"), str):
                found.append((note["log"], note["text"]))
    return found


def _files(folder: Path) -> Iterator[tuple[str, tuple[int, int]]]:
    """Name, size and time of every log in a folder."""
    with os.scandir(folder) as entries:
        for entry in entries:
            if entry.name.endswith((".mcap", ".mcap.part")):
                with suppress(OSError):  # gone since
                    status = entry.stat()
                    yield entry.name, (status.st_size, status.st_mtime_ns)


def _described(paths: list[Path]) -> Iterable[Entry]:
    if len(paths) <= FEW:
        yield from map(describe, paths)
        return
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        for future in as_completed([pool.submit(describe, path) for path in paths]):
            yield future.result()


def _opened(path: Path) -> sqlite3.Connection:
    db = sqlite3.connect(path, timeout=10.0)
    if db.execute("PRAGMA user_version").fetchone()[0] != VERSION:
        db.executescript(_TABLES.read_text() + f"PRAGMA user_version = {VERSION};")
    db.execute("PRAGMA synchronous = OFF")  # what a power cut spoils is made anew
    return db
