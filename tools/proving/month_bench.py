"""`armctl log list` and `find` over a month of logs, and how long an index that was lost takes to be made anew.

1. The month is one hour of a moving arm, ten hours a day: its file with every stamp shifted, chunk by chunk, by numpy
   and zstandard alone. Of the events that were planted in the hour each file keeps some, drawn at random.
2. The index is made by the program that a command starts in the background; it has lower priority, and its time is
   real time. Commands are programs of their own, and their time is processor time.
3. How many events are found is compared with what was planted: a difference is a violation.
"""

import os
import random
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Iterable, Iterator
from dataclasses import replace
from datetime import UTC, datetime
from json import loads
from pathlib import Path
from typing import Any

import numpy as np
import zstandard

from armctl.messages import Event, TickRecord
from armctl.recording.channels import Anchor
from armctl.recording.writer import LogWriter
from proving.figures import Row, check, row
from proving.log_bench import FLUSH_TICKS, HOUR_TICKS, SIMULATED_TICKS
from proving.log_rig import log_context, repeated, simulated_records

FILES = 240
HOURS_A_DAY = 10
HOUR_NS = 3_600 * 10**9
# Events in the hour, and the same ones with another code of the same length.
PLANTED, CODE, OTHER = 20, b"TRIPPED\0", b"TRAPPED\0"
FIND_BOUND_S, LIST_BOUND_S, REBUILD_BOUND_S = 2.0, 0.5, 60.0
CHUNK, MESSAGE = 6, 5
_RECORD, _CHUNK = struct.Struct("<BQ"), struct.Struct("<QQQII4sQ")
LEVEL = 3


def bench(seed: int, *, files: int = FILES, ticks: int = HOUR_TICKS) -> dict[str, Any]:
    """The benchmark; `checks` are for an idle machine."""
    rows: list[Row] = []
    with tempfile.TemporaryDirectory(prefix="armctl-month-") as name:
        folder = Path(name)
        kept = month(folder, seed, files, ticks)
        size_GB = sum(file.stat().st_size for file in folder.iterdir()) / 1e9
        rows.append(row(f"{files} logs", "armctl", size_GB, "GB", 1.0))
        begun_s, begun_cpu_s = time.monotonic(), _children_s()
        subprocess.run([sys.executable, "-m", "armctl.recording.index", name], check=True)
        rebuilt_s = time.monotonic() - begun_s
        rows.append(row("lost index made anew, real time", "armctl", rebuilt_s, "s", 1.0))
        rows.append(row("lost index made anew, processor", "armctl", _children_s() - begun_cpu_s, "s", 1.0))
        checks = [check("lost index made anew [s]", rebuilt_s, REBUILD_BOUND_S)]
        logs, took_s = _asked(name, "list")
        checks.append(check("log list [s of processor]", took_s, LIST_BOUND_S))
        wrong = [] if len(logs["logs"]) == files and not logs["unread"] else [f"{len(logs['logs'])} logs listed"]
        for words, expected in (("code:TRIPPED", kept), ("code:TRAPPED servo:3", PLANTED * files - kept),
                                ("shut itself down level:error", PLANTED * files), ("load>0.3", None)):  # fmt: skip
            found, took_s = _asked(name, "find", *words.split())
            rows.append(row(f"find {words}", "armctl", len(found["events"]), "found", 1.0))
            checks.append(check(f"find {words} [s of processor]", took_s, FIND_BOUND_S))
            if expected is not None and len(found["events"]) != expected:
                wrong.append(f"find {words}: {len(found['events'])} of {expected}")
    return {"rows": rows, "checks": checks, "seed": seed, "violations": len(wrong), "examples": wrong}


def month(folder: Path, seed: int, files: int, ticks: int) -> int:
    """Fill a folder; how many of the planted events kept their code."""
    rng, kept, begun_ns = random.Random(seed), 0, time.time_ns() - 31 * 24 * HOUR_NS
    with tempfile.TemporaryDirectory(prefix="armctl-hour-") as elsewhere:
        hour = Path(elsewhere) / "hour.mcap"
        writer = LogWriter(hour, log_context(), anchor=Anchor(begun_ns, 5 * 10**9))
        for record in _with_events(repeated(simulated_records(seed, min(SIMULATED_TICKS, ticks)), ticks), ticks):
            writer.write_tick(record)
            if record.inputs.tick % (100 * FLUSH_TICKS) == 0:
                writer.flush()  # so few that its chunks are as large as those of a log that was compacted
        writer.close()
        parts = list(_parts(hour.read_bytes()))
    for number in range(files):
        later_ns = (number // HOURS_A_DAY * 24 + number % HOURS_A_DAY) * HOUR_NS
        stamp = datetime.fromtimestamp((begun_ns + later_ns) / 1e9, UTC)
        with (folder / f"armctl-{stamp:%Y%m%dT%H%M%SZ}-{number:06}.mcap").open("wb") as file:
            for part in parts:
                data, count = part if isinstance(part, bytes) else None, 0
                if data is None:
                    data, count = _shifted(part, later_ns, rng)
                kept += count
                file.write(data)
    return kept


def _with_events(records: Iterable[TickRecord], ticks: int) -> Iterator[TickRecord]:
    tripped = Event("error", "TRIPPED", "servo 3 (elbow): shut itself down", 3)
    for tick, record in enumerate(records):
        planted = (tick + 1) * PLANTED // ticks > tick * PLANTED // ticks
        yield replace(record, outputs=replace(record.outputs, events=(tripped,))) if planted else record


def _parts(data: bytes) -> Iterator[Any]:
    """What stands before the summary of an MCAP file: chunks as (bytes, places of their stamps), the rest as it is."""
    yield data[:8]
    at = 8
    while True:
        opcode, length = _RECORD.unpack_from(data, at)
        end = at + _RECORD.size + length
        if opcode == CHUNK:
            sizes = _CHUNK.unpack_from(data, at + _RECORD.size)
            text = zstandard.ZstdDecompressor().decompress(data[at + _RECORD.size + _CHUNK.size : end], sizes[2])
            yield text, np.array(list(_stamps(text)))
        elif opcode != 7:  # an index of messages
            yield data[at:end]
        if opcode == 15:  # the end of the data; no summary, and the end of the file
            yield _RECORD.pack(2, 20) + bytes(20) + data[:8]
            return
        at = end


def _stamps(text: bytes) -> Iterator[int]:
    """Where the two times of each message stand in a chunk."""
    at = 0
    while at < len(text):
        opcode, length = _RECORD.unpack_from(text, at)
        if opcode == MESSAGE:
            yield at + _RECORD.size + 6
        at += _RECORD.size + length


def _shifted(part: tuple[bytes, Any], later_ns: int, rng: random.Random) -> tuple[bytes, int]:
    """A chunk at a later time with some of its events of another code; how many kept theirs."""
    text, places = part
    pieces = text.split(CODE)
    drawn = [rng.choice((CODE, OTHER)) for _ in pieces[1:]]
    buffer = np.frombuffer(bytearray(b"".join(a + b for a, b in zip(pieces, [*drawn, b""], strict=True))), np.uint8)
    where = places[:, None] + np.arange(16)
    times = np.ascontiguousarray(buffer[where]).view("<u8") + np.uint64(later_ns)
    buffer[where] = times.view(np.uint8)
    made = buffer.tobytes()
    body = zstandard.ZstdCompressor(LEVEL).compress(made)
    head = (int(times.min()), int(times.max()), len(made), zlib.crc32(made), 4, b"zstd", len(body))
    return _RECORD.pack(CHUNK, _CHUNK.size + len(body)) + _CHUNK.pack(*head) + body, drawn.count(CODE)


def asked(folder: str, *words: str) -> tuple[str, float]:
    """What a command of `armctl log` prints, and its processor time."""
    begun_s = _children_s()
    command = [sys.executable, "-m", "armctl", "log", *words, "--log-dir", folder]
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=os.environ)
    return done.stdout, _children_s() - begun_s


def _asked(folder: str, *words: str) -> tuple[dict[str, Any], float]:
    """What it answers as JSON."""
    told, took_s = asked(folder, *words, "--json")
    answer: dict[str, Any] = loads(told)
    return answer, took_s


def _children_s() -> float:
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime
