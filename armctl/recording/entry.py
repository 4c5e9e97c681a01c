"""What is kept of one log in an index of many (index.py), and two logs side by side.

Rules.
1. Servos are kept by the minute: the highest temperature and load, the lowest voltage, the mean distance from the goal
   while there is torque.
2. A log that cannot be read is kept with what is wrong with it, and disturbs no other.
"""

import math
import re
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.dynamixel import ax12a
from armctl.errors import LogError
from armctl.recording import channels
from armctl.recording.columns import Table
from armctl.recording.log_file import LogFile
from armctl.recording.notes import FIGURES, LEVELS, NOTE_LEVEL, parse_note
from armctl.recording.reader import info

MINUTE_NS = 60 * NS_PER_S
WORKERS = 2
_REGISTERS = (
    ax12a.TORQUE_ENABLE, ax12a.PRESENT_LOAD, ax12a.PRESENT_POSITION, ax12a.GOAL, ax12a.PRESENT_TEMPERATURE,
    ax12a.PRESENT_VOLTAGE,
)  # fmt: skip
_SERVO = re.compile(r" \(servo (\d{1,3})\): ")


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
            # Where the end alone is damaged, others may read it all the same.
            entry.complete = log.complete or (log.ended and info(path).complete)
            if times_ns := found[channels.SERVOS].log_time_ns.tolist():
                entry.start_s, entry.duration_s = times_ns[0] / NS_PER_S, (times_ns[-1] - times_ns[0]) / NS_PER_S
                for table in log.tables(channels.SERVOS, found[channels.SERVOS]):
                    entry.minutes += _minutes(table)
            for topic in (channels.ROSOUT, channels.COMMAND):
                for time_ns, data in found[topic]:
                    if topic == channels.ROSOUT or b'"event"' in data:
                        entry.events += _event(time_ns / NS_PER_S, topic, log.codec(topic).decode(data))
    except LogError as error:
        entry.problem = str(error)
    except OSError as error:
        entry.problem = f"{path}: cannot be read: {error.strerror}"
    except (LookupError, TypeError, ValueError, ArithmeticError) as error:  # a file from elsewhere may hold anything
        entry.problem = f"{path}: is not as armctl writes it: {error!r}"
    return entry


def _event(time_s: float, topic: str, value: dict[str, Any]) -> Iterator[tuple[float, int, str, int | None, str]]:
    if topic == channels.ROSOUT:
        servo = _SERVO.search(value["msg"])
        yield time_s, value["level"], value["function"], int(servo[1]) if servo else None, value["msg"]
    elif isinstance(code := (note := parse_note(value["data"])).get("event"), str):
        yield time_s, NOTE_LEVEL, code, None, str(note.get("text") or note.get("name") or "")


def _minutes(table: Table) -> Iterator[tuple[Any, ...]]:
    """Every servo by the minute, of messages of one shape."""
    time_ns = table.log_time_ns.astype(np.int64)
    for index in range(sum(path.endswith("].registers") for path in table.columns)):
        registers, name = table.columns[f"servos[{index}].registers"], table.columns[f"servos[{index}].name"]
        if not isinstance(registers, np.ndarray) or registers.ndim != 2 or registers.shape[1] < ax12a.STATUS_SIZE:
            continue  # it never answered
        kept = table.numbers(f"servos[{index}].fresh") > 0
        times, blocks = time_ns[kept], registers[kept]
        if not len(times):
            continue
        torque, load, position, goal, heat, voltage = (channels.register_column(blocks, one) for one in _REGISTERS)
        begins = np.flatnonzero(np.diff(times // MINUTE_NS, prepend=-1))
        load, under_torque = (load & 1023) / 1023.0, np.add.reduceat((torque > 0).astype(float), begins)
        error_deg = np.abs(position - goal) * (torque > 0) * math.degrees(ax12a.TICK_RAD)
        columns = (
            times[begins] / NS_PER_S,
            np.maximum.reduceat(heat, begins),
            np.maximum.reduceat(load, begins),
            np.add.reduceat(load, begins) / np.diff(begins, append=len(times)),
            np.minimum.reduceat(voltage, begins) / 10.0,
            # Of no tick with torque: no figure.
            np.add.reduceat(error_deg, begins) / np.where(under_torque, under_torque, np.nan),
        )
        servo_id, joint = int(table.numbers(f"servos[{index}].id")[0]), name[0]
        for time_s, *figures in zip(*(column.tolist() for column in columns), strict=True):
            yield time_s, servo_id, joint, *figures


def entries(paths: list[Path], *, in_processes: bool) -> Iterable[Entry]:
    """Read logs, in processes of their own where they are many: those take half a second to start."""
    if not in_processes:
        yield from map(describe, paths)
        return
    with ProcessPoolExecutor(WORKERS, mp_context=get_context("spawn")) as pool:
        yield from pool.map(describe, paths)


def diff(a: Path, b: Path) -> list[dict[str, Any]]:
    """Two logs side by side, quantity by quantity.

    Raises:
        LogError: one cannot be read.
    """
    ours, theirs = _quantities(a), _quantities(b)
    rows = []
    for name in dict.fromkeys([*ours, *theirs]):
        one, other = ours.get(name), theirs.get(name)
        change = other - one if isinstance(one, int | float) and isinstance(other, int | float) else None
        rows.append({"quantity": name, "a": one, "b": other, "difference": change})
    return rows


def _quantities(path: Path) -> dict[str, Any]:
    entry = describe(path)
    if entry.problem:
        raise LogError(entry.problem)
    found: dict[str, Any] = {key: getattr(entry, key) for key in ("arm_id", "version", "duration_s")}
    found |= {f"events, {level}": sum(event[1] == number for event in entry.events) for level, number in LEVELS.items()}
    worst: tuple[Callable[[Any], Any], ...] = (np.max, np.max, np.mean, np.min, np.nanmean)
    for joint in dict.fromkeys(row[2] for row in entry.minutes):
        minutes = np.array([row[3:] for row in entry.minutes if row[2] == joint])
        for name, of, values in zip(FIGURES, worst, minutes.T, strict=True):
            found[f"{joint}.{name}"] = None if np.isnan(values).all() else float(of(values))
    return found
