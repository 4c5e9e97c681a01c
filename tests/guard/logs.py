"""Logs of every kind, made of one episode's records on its virtual clock, and digests of what another reader finds.

`python -m tests.guard.logs` writes `logs.json` anew. Do that only in a commit that says why the digests change.
What the program, its packages and the machine are is masked (`VOLATILE`). All else is fixed; keyframes stand apart.
"""

import hashlib
import re
import shutil
import tempfile
import threading
from collections import defaultdict
from collections.abc import Iterator, Sequence
from contextlib import redirect_stdout
from functools import partial
from io import StringIO
from pathlib import Path

from mcap import records as mcap_records
from mcap.reader import make_reader
from mcap.stream_reader import StreamReader

from armctl.cli import main
from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import Config, LogConfig
from armctl.messages import TickRecord
from armctl.recording.compact import compact
from armctl.recording.recorder import Recorder
from armctl.recording.writer import LogContext
from tests.guard.episodes import context, records
from tests.guard.kept import digest, save

FILE = "logs.json"
# Its arm moves, jogs, parks, grows hot on the way (a fault, and a snapshot) and is switched on again.
EPISODE = 7
# Ticks at which a take begins and ends.
TAKE = (30, 150)
WALL_NS = 1_750_000_000 * NS_PER_S
LIMITS = LogConfig(free_bytes=0, rotate_s=12.0, snapshot_s=3.0)
KEYFRAMES = "/armctl/state"
# Of the facts about a log: which armctl wrote it, and on which machine.
VOLATILE = ("version", "host", "commit", "sources", "python", "numpy", "dynamixel_sdk", "clock", "rtc")


def recorded(folder: Path, ticks: Sequence[TickRecord], about: LogContext) -> None:
    """What a daemon writes: running logs, a take and a snapshot around a fault."""
    clock = VirtualClock()
    recorder = Recorder(
        about,
        folder / "logs",
        folder / "recordings",
        clock=clock,
        wall_ns=lambda: clock.now_ns() + WALL_NS,
        queue_records=9 * len(ticks),
        compactor=lambda _: None,  # rotated logs stay as they are
    )

    def settle() -> None:
        done = threading.Event()
        recorder._queue.put(done.set)
        assert done.wait(60.0)

    for number, record in enumerate(ticks):
        if number == TAKE[0]:
            settle()
            recorder.begin_take("take")
        if number == TAKE[1]:
            recorder.end_take()
        now_ns = record.inputs.now_ns
        # The recorder's own thread moves the clock, or a flush would come before or after a tick by chance.
        recorder._queue.put(partial(clock.sleep_until_ns, now_ns))
        recorder.put(record)
        recorder.note(f'{{"number":{number}}}', now_ns)
    settle()
    recorder.close()
    assert not recorder.dropped_records


def build(folder: Path) -> dict[str, Path]:
    """A file of each kind in a folder, by a name for the kind."""
    recorded(folder, records(EPISODE), context(Config(log=LIMITS)))
    running = sorted((folder / "logs").glob("armctl-*.mcap"))
    (snapshot,) = (folder / "logs").glob("fault-*.mcap")
    take = folder / "recordings" / "take.mcap"
    made = {name: folder / f"{name}.mcap" for name in ("compacted", "trimmed", "merged", "cut", "damaged")}
    shutil.copy(running[0], made["compacted"])
    assert compact(made["compacted"])
    quiet("log", "trim", running[0], "--from", "2.05", "--to", "7", "--out", made["trimmed"])
    quiet("log", "merge", *running, "--out", made["merged"])
    whole, at = running[0].read_bytes(), fifth_chunk(running[0])
    Path(f"{made['cut']}.part").write_bytes(whole[: at + 100])
    quiet("log", "recover", f"{made['cut']}.part")
    made["damaged"].write_bytes(whole[: at + 100] + bytes(20) + whole[at + 120 :])
    quiet("log", "recover", made["damaged"])
    made["damaged"] = folder / "damaged-recovered.mcap"
    csv = {}
    for name, topics in {"ticks": (), "cycle": ("--topic", "/armctl/cycle")}.items():
        csv[f"csv-{name}"] = folder / f"{name}.csv"
        quiet("log", "export", running[0], "--format", "csv", "--out", csv[f"csv-{name}"], *topics)
    return {f"running-{i}": path for i, path in enumerate(running)} | {"snapshot": snapshot, "take": take} | made | csv


def quiet(*command: str | Path) -> None:
    """One command that must succeed."""
    with redirect_stdout(StringIO()) as said:
        assert main([*map(str, command), "--json"]) == 0, said.getvalue()


def fifth_chunk(path: Path) -> int:
    """Where it begins in a file."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return sorted(chunk.chunk_start_offset for chunk in summary.chunk_indexes)[4]


def masked(attachment: bytes) -> bytes:
    return re.sub(rb'"(%b)":"[^"]*"' % "|".join(VOLATILE).encode(), rb"\1", attachment)


def parts(path: Path) -> Iterator[tuple[str, bytes]]:
    """What stands in a log, piece by piece, each with the name of the entry that it belongs to."""
    with path.open("rb") as stream:
        for record in StreamReader(stream, emit_chunks=True).records:
            # How messages are spread over chunks; a chunk's size on disk depends on the compressor's version.
            size = record.uncompressed_size if isinstance(record, mcap_records.Chunk) else ""
            yield "shape", f"{type(record).__name__} {size}\n".encode()
    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True)
        for attachment in reader.iter_attachments():
            name = f"{attachment.name} {attachment.media_type} {attachment.log_time} "
            yield "attachments", name.encode() + masked(attachment.data)
        for metadata in reader.iter_metadata():
            facts = {name: value for name, value in metadata.metadata.items() if name not in VOLATILE}
            yield "metadata", f"{metadata.name} {sorted(facts.items())}".encode()
        for schema, channel, message in reader.iter_messages(log_time_order=False):
            assert schema is not None
            about = f"{schema.name} {schema.encoding} {channel.message_encoding} {sorted(channel.metadata.items())}"
            times = f"{message.log_time} {message.publish_time} {message.sequence}"
            yield channel.topic, f"{about} {digest(schema.data)} {times} ".encode() + message.data
            yield "order", f"{channel.topic} {message.log_time}\n".encode()


def digests(path: Path) -> dict[str, str]:
    """The entries of one file: of a log a digest for each topic and part, with the number of pieces."""
    if path.suffix == ".csv":
        return {"text": digest(path.read_bytes())}
    hashes: defaultdict[str, hashlib.blake2b] = defaultdict(lambda: hashlib.blake2b(digest_size=8))
    count: dict[str, int] = defaultdict(int)
    for name, data in parts(path):
        hashes[name].update(data)
        count[name] += 1
    return {name: f"{count[name]} x {found.hexdigest()}" for name, found in hashes.items()}


def of_every_kind() -> dict[str, dict[str, str]]:
    """The entries of every kind of log, made anew."""
    with tempfile.TemporaryDirectory() as folder:
        return {name: digests(path) for name, path in build(Path(folder)).items()}


if __name__ == "__main__":
    save(FILE, of_every_kind())
