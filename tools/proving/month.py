"""A month of logs to measure an index of them with: `python -m proving.month FOLDER`.

A month is 266 hours of work and 2.5 GB: the log of an hour in which the arm moves and of one in which it holds, by
turns, each rewritten at later times; every 24th has a servo that trips. Making it takes minutes of two processors: it
is measured once in a while, and no part of a bench.
"""

import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from functools import partial
from pathlib import Path

from armctl.clock import NS_PER_S
from armctl.recording.channels import ROSOUT
from armctl.recording.chunks import ChunkWriter
from armctl.recording.compact import CHUNK_BYTES, compact
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.rewrite import Rewrite
from proving.log_bench import HOUR_TICKS, SIMULATED_TICKS, write_log
from proving.log_rig import simulated_records

HOURS = 266
# A day has 9 hours of work.
LATER_NS = 24 * 3600 * NS_PER_S // 9
TRIPPED = {"level": 40, "function": "TRIPPED", "msg": "elbow (servo 3): shut itself down"}
TRIPPING_HOURS = 24


def month(folder: Path, hours: int = HOURS, ticks: int = HOUR_TICKS) -> None:
    """Write the logs of so many hours, each of so many ticks."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as kept, ProcessPoolExecutor(2) as pool:
        made = [Path(kept) / "moving.mcap", Path(kept) / "still.mcap"]
        for hour in made:
            write_log(hour, simulated_records(1, min(SIMULATED_TICKS, ticks), moving=hour == made[0]), ticks)
            compact(hour)
        list(pool.map(partial(_later, folder), [made[number % 2] for number in range(hours)], range(hours)))


def _later(folder: Path, hour: Path, number: int) -> None:
    """The log of one hour, at a later time."""
    path = folder / f"armctl-20250615T000000Z-{number:06d}.mcap"
    with LogFile(hour) as log, path.open("wb") as stream:
        writer = ChunkWriter(stream, chunk_bytes=CHUNK_BYTES)
        rewrite = Rewrite(log, writer)
        rewrite.add(_shifted(log, number * LATER_NS, tripping=number % TRIPPING_HOURS == 0))
        rewrite.keep()
        writer.finish()


def _shifted(log: LogFile, by_ns: int, *, tripping: bool) -> Iterator[LogMessage]:
    for message in log.messages():
        shifted = message._replace(log_time_ns=message.log_time_ns + by_ns)
        yield shifted
        if tripping and message.topic == ROSOUT:
            yield shifted._replace(data=log.codec(ROSOUT).encode(log.decode(message) | TRIPPED))
            tripping = False


if __name__ == "__main__":
    month(Path(sys.argv[1]))
