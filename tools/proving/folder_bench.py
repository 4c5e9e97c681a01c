"""What a folder of ten thousand logs costs, and what a daemon waits for that finds the hour a crash has left in it.

1. Retention, a look a second, while something in the folder changes every ten seconds; processor time of this process.
2. `armctl log list`, the index being there: processor time of the whole program as installed, as a table and as JSON;
   the best of some, since the first finds no bytecode.
3. `ready` of a daemon: real time from its start until it serves clients, the part of an hour being in its folder; best
   of some. The part has to become a log afterwards.

The logs are one short log under ten thousand names.
"""

import contextlib
import os
import subprocess
import sys
import tempfile
import time
from datetime import UTC, datetime
from operator import itemgetter
from pathlib import Path
from typing import Any
from unittest import mock

from armctl.clock import NS_PER_S
from armctl.config import LogConfig
from armctl.lab.demo import started
from armctl.recording.disk import PART
from armctl.recording.quota import Retention
from proving.figures import Row, check, row
from proving.log_bench import HOUR_TICKS, SIMULATED_TICKS, write_log
from proving.log_rig import simulated_records
from proving.month_bench import asked
from proving.rig import installed

FILES, TICKS, BEGUN_S = 10_000, 30, 1_700_000_000
SECONDS, CHANGE_S = 600, 10
STARTS, RECOVERED_S, LISTINGS = 3, 60.0, 3
RETENTION_BOUND_MS, LIST_BOUND_S, READY_BOUND_S = 1.0, 0.5, 2.0


def bench(seed: int, *, files: int = FILES, ticks: int = HOUR_TICKS) -> dict[str, Any]:
    """The benchmark; `checks` are for an idle machine."""
    rows: list[Row] = []
    checks: list[Row] = []
    wrong: list[str] = []
    with tempfile.TemporaryDirectory(prefix="armctl-folder-") as name:
        logs = Path(name) / "logs"
        fill(logs, seed, files)
        kept_ms = retention_ms(logs)
        rows.append(row(f"retention, {files} logs", "armctl", kept_ms, "ms a second", 1.0))
        checks.append(check("retention [ms a second]", kept_ms, RETENTION_BOUND_MS))
        subprocess.run([sys.executable, "-m", "armctl.recording.index", logs], check=True)
        for words, text in ((["--json"], "JSON"), ([], "a table")):
            with installed(Path(name) / "bytecode"):
                listed, took_s = min((asked(str(logs), "list", *words) for _ in range(LISTINGS)), key=itemgetter(1))
            rows.append(row(f"log list of {files}, {text}", "armctl", took_s, "s", 1.0))
            checks.append(check(f"log list, {text} [s of processor]", took_s, LIST_BOUND_S))
            if listed.count("armctl-") < files:
                wrong.append(f"{listed.count('armctl-')} logs listed")
        ready_s = _ready_s(Path(name), seed, ticks, wrong)
        rows.append(row("ready after a crash with an hour in its part", "armctl", ready_s, "s", 1.0))
        checks.append(check("ready after a crash [s]", ready_s, READY_BOUND_S))
    return {"rows": rows, "checks": checks, "seed": seed, "violations": len(wrong), "examples": wrong}


def fill(logs: Path, seed: int, files: int) -> None:
    """A folder of so many logs."""
    logs.mkdir()
    one = logs.with_name("one.mcap")
    write_log(one, simulated_records(seed, TICKS), TICKS)
    for number in range(files):
        stamp = datetime.fromtimestamp(BEGUN_S + 3600 * number, UTC)
        os.link(one, logs / f"armctl-{stamp:%Y%m%dT%H%M%SZ}-{number + 1:06}.mcap")


def retention_ms(logs: Path, seconds: int = SECONDS) -> float:
    """What keeping a folder within bounds takes each second, when nothing is too much."""
    now_ns = 0
    limits = LogConfig(quota_bytes=2**50, free_bytes=0, max_age_s=1e9)
    retention = Retention(logs, limits, lambda: now_ns)
    retention.enforce()
    begun_s = time.process_time()
    for second in range(seconds):
        now_ns = second * NS_PER_S
        if second % CHANGE_S == 0:
            (logs / "another").touch()
            (logs / "another").unlink()
        assert retention.enforce(1) == ()
    return 1e3 * (time.process_time() - begun_s) / seconds


def _ready_s(folder: Path, seed: int, ticks: int, wrong: list[str]) -> float:
    hour, port, words = folder / "hour.mcap", folder / "port", folder / "words"
    write_log(hour, simulated_records(seed, min(SIMULATED_TICKS, ticks)), ticks)
    data, best_s = hour.read_bytes(), float("inf")
    places = {f"XDG_{kind}_HOME": str(folder / kind) for kind in ("DATA", "CONFIG", "CACHE")}
    with installed(folder / "bytecode"), mock.patch.dict(os.environ, places), contextlib.ExitStack() as running:
        running.enter_context(started(words, "sim", "--link", str(port), "--seed", str(seed)))
        for number in range(STARTS):
            logs = folder / f"crashed-{number}"
            logs.mkdir()
            part = logs / f"armctl-20250615T120000Z-000001.mcap{PART}"
            part.write_bytes(data[: len(data) * 99 // 100])
            begun_s = time.monotonic()
            options = ["--port", str(port), "--socket", str(folder / "socket"), "--log-dir", str(logs)]
            with started(words, "daemon", *options):
                best_s = min(best_s, time.monotonic() - begun_s)
                while part.exists() and time.monotonic() < begun_s + RECOVERED_S:
                    time.sleep(0.1)
            if part.exists() or not part.with_suffix("").exists():
                wrong.append(f"{part.name} was not recovered within {RECOVERED_S:.0f} s")
    return best_s
