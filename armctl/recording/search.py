"""What people ask of a folder of logs, answered from its index (index.py)."""

import json
import os
import re
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from armctl.errors import ConfigError
from armctl.recording.index import Index
from armctl.recording.notes import FIGURES, LEVELS

Row = dict[str, Any]
# What may stand before a comparison, and its column of a minute.
READINGS = {"temperature": "temperature_degC", "load": "load_ratio", "voltage": "voltage_V", "error": "error_deg"}
# What may stand before a colon, and its condition.
_TERMS = {
    "code": "code = ?", "servo": "servo_id = ?", "level": "level >= ?", "arm": "arm_id = ?", "log": "name GLOB ?",
    "after": "time_s >= ?", "before": "time_s < ?",
}  # fmt: skip
_COMPARED = re.compile(rf"({'|'.join(READINGS)})([<>])(-?\d+(?:\.\d+)?)")
_LIKE_COMPARED = re.compile(r"\w+[<>]")
# Beyond it sqlite3 refuses a query, as it refuses numbers beyond 64 bits and halves of surrogate pairs.
MOST_WORDS = 100
SERVO_IDS = range(254)
# What becomes of each figure of a minute in a longer time.
_OF_A_PERIOD = ("max", "max", "avg", "min", "avg")
PERIODS_S = {"day": 86_400, "week": 604_800, "month": 2_629_746}


def listing(index: Index) -> list[Row]:
    """Every log, the oldest first; `faults`: codes of those that came up in it."""
    kept = "duration_s, arm_id, version, problem, simulated, complete, faults, notes"
    logs = index.ask(f"SELECT name AS path, start_s AS start, size AS size_bytes, {kept} FROM listed")
    folder = os.path.join(index.folder, "")
    for log in logs:
        log["path"] = folder + log["path"]
        log["start"] = None if log["start"] is None else iso(log["start"])
        log["simulated"] = None if log["simulated"] is None else bool(log["simulated"])
        log["complete"] = bool(log["complete"])
        for key in ("faults", "notes"):
            log[key] = json.loads(log[key]) if log[key] else []
    return logs


def find(index: Index, expression: str) -> list[Row]:
    """Events, or minutes of servos, that fulfil every word of an expression, in the order of time.

    A word is `code:HOT`, `servo:3`, `level:error`, `arm:ID`, `log:GLOB`, `after:` or `before:` and a time (ISO 8601,
    UTC unless it says otherwise), a comparison such as `load>0.8` or `temperature<60`, or any part of an event's text.

    Raises:
        ConfigError: a word cannot be understood, or there are over `MOST_WORDS`.
    """
    words = expression.split()
    if len(words) > MOST_WORDS:
        raise _misunderstood(f"{len(words)} words", f"give {MOST_WORDS} at most")
    compared = [match for word in words if (match := _COMPARED.fullmatch(word))]
    where, arguments = ["1"], list[Any]()
    for word in words:
        key, colon, value = word.partition(":")
        if match := _COMPARED.fullmatch(word):
            where.append(f"{READINGS[match[1]]} {match[2]} ?")
            arguments.append(float(match[3]))
        elif _LIKE_COMPARED.match(word) or not word.isprintable():
            raise _misunderstood(word, f"compared are {', '.join(READINGS)}, by < or >, with a number such as 0.8")
        elif colon and key in _TERMS:
            where.append(_TERMS[key])
            arguments.append(_value(key, value))
        else:
            where.append("instr(lower(text), ?)")
            arguments.append(word.lower())
    if compared and any("text" in one or "code" in one or "level" in one for one in where):
        raise _misunderstood(expression, "a comparison is of servos, and a code or text of events; ask twice")
    source = f"{'minutes' if compared else 'events'} JOIN logs ON logs.id = log"
    query = f"SELECT *, coalesce(time_s, mtime_ns / 1e9) AS at_s FROM {source} WHERE {' AND '.join(where)}"
    return [_found(index, row, compared) for row in index.ask(f"{query} ORDER BY at_s", arguments)]


def _found(index: Index, row: Row, compared: Sequence[re.Match[str]]) -> Row:
    if compared:
        figures = ", ".join(f"{match[1]} {row[READINGS[match[1]]]:.4g}" for match in compared)
        row |= {"code": compared[0][1].upper(), "text": f"servo {row['servo_id']} ({row['joint']}): {figures}"}
    since_s = row["at_s"] - (row["start_s"] or row["at_s"])
    return {
        "log": str(index.folder / row["name"]), "time_s": since_s, "time": iso(row["at_s"]), "code": row["code"],
        "servo_id": row["servo_id"], "text": row["text"],
    }  # fmt: skip


def _value(key: str, text: str) -> Any:
    try:
        if key in ("after", "before"):
            time = datetime.fromisoformat(text)
            return (time if time.tzinfo else time.replace(tzinfo=UTC)).timestamp()
        return LEVELS[text] if key == "level" else SERVO_IDS.index(int(text)) if key == "servo" else text
    except (ValueError, KeyError, OverflowError):
        known = "a servo is a number from 0 to 253, a level info, warning or error, a time such as 2025-06-15T12:00"
        raise _misunderstood(f"{key}:{text}", known) from None


def _misunderstood(words: str, remedy: str) -> ConfigError:
    return ConfigError("armctl log find", ascii(words)[1:-1][:80], "cannot be understood", remedy)


def stats(index: Index, period: str) -> list[Row]:
    """What each joint went through in every period, an hour of it being 60 minutes with the servo answering.

    `change`: slope of each figure over the joint's periods, a period, by least squares; None of fewer than three.
    """
    selected = ", ".join(f"{of}({name}) AS {name}" for name, of in zip(FIGURES, _OF_A_PERIOD, strict=True))
    periods = "CAST(time_s / ? AS INTEGER) AS period, count(*) / 60.0 AS hours"
    grouped = "GROUP BY arm_id, servo_id, joint, period ORDER BY arm_id, servo_id, period"
    query = f"SELECT arm_id, joint, servo_id, {periods}, {selected} FROM served {grouped}"
    rows = index.ask(query, [PERIODS_S[period]])
    joints: dict[tuple[Any, ...], list[Row]] = {}
    for row in rows:
        joints.setdefault((row["arm_id"], row["servo_id"]), []).append(row)
    for row in rows:
        row["from"] = iso(row["period"] * PERIODS_S[period])
        points = joints[row["arm_id"], row["servo_id"]]
        row["change"] = {name: _slope([(one["period"], one[name]) for one in points]) for name in FIGURES}
    return rows


def _slope(points: Sequence[tuple[int, float | None]]) -> float | None:
    import numpy as np

    known = np.array([point for point in points if point[1] is not None], dtype=float)
    return float(np.polyfit(known[:, 0] - known[0, 0], known[:, 1], 1)[0]) if len(known) >= 3 else None


def iso(time_s: float) -> str:
    """An epoch time as people and programs read it."""
    return datetime.fromtimestamp(time_s, UTC).isoformat(timespec="milliseconds")
