"""Logs beside others in the same run: writing, reading all of it, one topic to numpy, and recovery.

What is counted:
- The log is an hour at 10 Hz of a moving arm: five minutes of the control loop on simulated servos, repeated at later
  times. All write and read the very same messages of it.
- `write, from ticks` is armctl's whole work, from the tick record to the file, forward kinematics for /tf included.
  `encode and write` begins where the others begin, with the values ready: as dicts for mcap-ros2-support, as numbers
  in order for armctl's shapes. foxglove-sdk has no encoder for these schemas: it is given ready CDR, so its figure is
  writing alone.
- `decode all` of armctl gives every number of every message as a contiguous numpy array, and every text as a str;
  without the texts it is told apart. rosbags' gives a dataclass a message, mcap-ros2-support's an object a message.
- Chunks have 1 MiB and zstd everywhere, as a log has after compaction; armctl's figures for a log that was flushed
  every second stand beside it. The level stands beside who writes: 3 is zstd's default, which the others
  use. armctl checks every CRC, rosbags none; mcap is told to.
- Hostile files (hostile.py) are read in several ways; a figure is the mean of them.
- Times are CPU times of this process, the best of some rounds; a peer that takes minutes decodes a part of the log.
- Ratios: of writing to foxglove-sdk's time, of reading to armctl's.
"""

import gc
import tempfile
import time
from collections.abc import Callable
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from armctl.messages import TickRecord
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.channels import JOINT_STATES, TOPICS, Anchor
from armctl.recording.chunks import LEVEL, PROFILE, ChunkWriter
from armctl.recording.columns import Texts
from armctl.recording.compact import compact
from armctl.recording.export import export
from armctl.recording.reader import info, read, read_columns
from armctl.recording.recover import recover
from armctl.recording.schemas import fields, schema_text, short_name
from armctl.recording.shapes import Shape
from armctl.recording.writer import LogWriter
from proving.figures import Row, check, row
from proving.hostile import WAYS, files, read_all
from proving.log_rig import log_context, repeated, simulated_records

HOUR_TICKS = 36_000
SIMULATED_TICKS = 3000
# What is encoded and written for the figures of writing.
WRITTEN_TICKS = 3000
# What mcap-ros2-support decodes.
SLOW_MESSAGES = 20_000
ROUNDS = 5
FLUSH_TICKS = 9
_TICK = (
    channels.SERVOS,
    channels.JOINT_STATES,
    channels.JOINT_COMMANDS,
    channels.TF,
    channels.TCP_POSE,
    channels.CYCLE,
)
HOUR_MB_BOUND = 12.0
DECODE_BOUND_PER_S = 500e3
RECOVER_BOUND_S = 3.0
PARQUET_BOUND_S = 1.5
REFUSE_BOUND_MS = 100.0


def bench(seed: int, *, ticks: int = HOUR_TICKS, written: int = WRITTEN_TICKS, rounds: int = ROUNDS) -> dict[str, Any]:
    """The benchmark; `checks` are for an idle machine."""
    records = simulated_records(seed, min(SIMULATED_TICKS, ticks))
    rows: list[Row] = []
    checks: list[dict[str, Any]] = []
    with tempfile.TemporaryDirectory(prefix="armctl-") as folder:
        root = Path(folder)
        _write(records[:written], root, rounds, rows, checks)
        flushed = root / "flushed.mcap"
        write_log(flushed, records, ticks)
        compacted = root / "compacted.mcap"
        size_MB = _size("an hour of a moving arm", flushed, compacted, rows)
        checks.append(check("an hour of a moving arm, compacted [MB]", size_MB, HOUR_MB_BOUND))
        still = root / "still.mcap"
        write_log(still, simulated_records(seed, min(SIMULATED_TICKS, ticks), moving=False), ticks)
        size_MB = _size("an hour of an arm that holds", still, root / "still-compacted.mcap", rows)
        checks.append(check("an hour of an arm that holds, compacted [MB]", size_MB, HOUR_MB_BOUND))
        _decode(flushed, compacted, rounds, rows, checks)
        _topic(compacted, rounds, rows, checks)
        _parquet(compacted, root / "ticks.parquet", rounds, rows, checks)
        _recovery(flushed, root, rows, checks)
        _refusals(root, rows, checks)
    return {"rows": rows, "checks": checks, "seed": seed}


def write_log(path: Path, records: list[TickRecord], ticks: int) -> None:
    """A log as the daemon writes it, a chunk for every flush."""
    writer = LogWriter(path, log_context(), anchor=Anchor.now())
    for record in repeated(records, ticks):
        writer.write_tick(record)
        if record.inputs.tick % FLUSH_TICKS == 0:
            writer.flush()
    writer.close()


def _write(records: list[TickRecord], root: Path, rounds: int, rows: list[Row], checks: list[Row]) -> None:
    context, anchor = log_context(), Anchor.now()
    path = root / "written.mcap"

    def whole() -> None:
        writer = LogWriter(path, context, anchor=anchor)
        for record in records:
            writer.write_tick(record)
        writer.close()

    whole()
    count = info(path).messages
    path.unlink()
    whole_s = _best_s(whole, rounds, path)
    messages = _Messages()
    for record in records:
        rows_of_tick = [channels.servos_row(record, anchor, context.arm), channels.cycle_row(record, anchor)]
        rows_of_tick += channels.output_rows(record, anchor, context.arm, context.robot)
        time_ns = anchor.epoch_ns(record.inputs.sample.time_ns)
        for one in rows_of_tick:
            messages.add(one.topic, time_ns, one.value())
    ours, foxglove, ros2 = f"armctl, zstd {LEVEL}", "foxglove-sdk, CDR given, zstd 3", "mcap-ros2-support, zstd 3"
    peers: dict[str, Callable[[], None]] = {
        ours: lambda: _write_armctl(path, messages, LEVEL),
        "armctl, zstd 3": lambda: _write_armctl(path, messages, 3),
        foxglove: lambda: _write_foxglove(path, messages),
        ros2: lambda: _write_ros2(path, messages),
    }
    seconds = dict.fromkeys(peers, float("inf"))
    for _ in range(2 * rounds):  # in turn, so that what else the machine does hits all of them
        for who, work in peers.items():
            seconds[who] = min(seconds[who], _best_s(work, 1, path))
    count_ready, foxglove_s = len(messages.ready), seconds[foxglove]
    whole_us, foxglove_us = 1e6 * whole_s / count, 1e6 * foxglove_s / count_ready
    rows.append(row("write, from ticks", ours, whole_us, "us/message", whole_us / foxglove_us))
    for who, took_s in seconds.items():
        rows.append(row("encode and write", who, 1e6 * took_s / count_ready, "us/message", took_s / foxglove_s))
    ours_s, ros2_s = seconds[ours], seconds[ros2]
    checks.append(check("encode and write, times foxglove-sdk's", ours_s / foxglove_s, 1.6))
    checks.append(check("encode and write, times faster than mcap-ros2-support", ros2_s / ours_s, 5.0, least=True))


class _Messages:
    """The six messages of every tick, ready for each peer."""

    def __init__(self) -> None:
        self.values: list[tuple[str, int, Value]] = []
        self.ready: list[tuple[str, int, bytes]] = []
        self.numbers: list[tuple[str, int, Callable[[list[Any]], bytes], list[Any]]] = []
        # By what makes up their shapes here.
        self._shapes: dict[tuple[str, int, str | None], Shape | None] = {}

    def add(self, topic: str, time_ns: int, value: Value) -> None:
        codec, numbers = TOPICS[topic].codec, message_numbers(short_name(TOPICS[topic].type), value)
        data = codec.encode(value)
        key = topic, len(data), value.get("mode")
        shape = self._shapes.setdefault(key, None if key in self._shapes else codec.shape(value))
        assert shape is not None, topic
        assert shape.pack(numbers) == data, topic
        self.values.append((topic, time_ns, value))
        self.ready.append((topic, time_ns, data))
        self.numbers.append((topic, time_ns, shape.pack, numbers))


def message_numbers(name: str, value: Value) -> list[Any]:
    """What a shape packs: every number of a message in order."""
    found: list[Any] = []
    for item in fields(name):
        content = value[item.name]
        if item.is_array and item.type == "uint8":
            found.append(content)
            continue
        for one in content if item.is_array else (content,):
            if isinstance(one, dict):
                found += message_numbers(item.type, one)
            elif not isinstance(one, str):
                found.append(one)
    return found


def _write_armctl(path: Path, messages: _Messages, level: int) -> None:
    with path.open("wb") as stream:
        writer = ChunkWriter(stream, level=level)
        ids = {
            topic: writer.add_channel(
                topic, "cdr", writer.add_schema(TOPICS[topic].type, "ros2msg", _schema(topic)), {}
            )
            for topic in _TICK
        }
        add_message = writer.add_message
        for topic, time_ns, encode, numbers in messages.numbers:
            add_message(ids[topic], time_ns, 0, encode(numbers))
        writer.finish()


def _write_foxglove(path: Path, messages: _Messages) -> None:
    import foxglove
    from foxglove.mcap import MCAPWriteOptions

    context = foxglove.Context()
    # No further threads: what they do would not be this process's alone to wait for, but it is its CPU time.
    options = MCAPWriteOptions(profile=PROFILE, compression_threads=0)
    with foxglove.open_mcap(path, allow_overwrite=True, context=context, writer_options=options):
        log = {
            topic: foxglove.Channel(
                topic,
                schema=foxglove.Schema(name=TOPICS[topic].type, encoding="ros2msg", data=_schema(topic)),
                message_encoding="cdr",
                context=context,
            ).log
            for topic in _TICK
        }
        for topic, time_ns, data in messages.ready:
            log[topic](data, log_time=time_ns)


def _write_ros2(path: Path, messages: _Messages) -> None:
    from mcap_ros2.writer import Writer

    with path.open("wb") as stream:
        writer = Writer(stream)
        schemas = {topic: writer.register_msgdef(TOPICS[topic].type, _schema(topic).decode()) for topic in _TICK}
        for topic, time_ns, value in messages.values:
            writer.write_message(topic, schemas[topic], value, time_ns, time_ns)
        writer.finish()  # type: ignore[no-untyped-call]


def _size(work: str, flushed: Path, compacted: Path, rows: list[Row]) -> float:
    """Sizes before and after compaction; the latter in MB."""
    compacted.write_bytes(flushed.read_bytes())
    begun_s = time.process_time()
    assert compact(compacted)
    took_s = time.process_time() - begun_s
    before_MB, after_MB = flushed.stat().st_size / 1e6, compacted.stat().st_size / 1e6
    per_message = 1e6 * after_MB / info(compacted).messages
    rows.append(row(f"{work}, flushed every second", "armctl", before_MB, "MB", before_MB / after_MB))
    rows.append(row(f"{work}, compacted", "armctl", after_MB, "MB", 1.0))
    rows.append(row(f"{work}, compacted", "armctl", per_message, "B/message", 1.0))
    rows.append(row(f"{work}, compacting", "armctl", took_s, "s", 1.0))
    return after_MB


def _decode(flushed: Path, compacted: Path, rounds: int, rows: list[Row], checks: list[Row]) -> None:
    def ours(path: Path, texts: bool) -> int:
        count = 0
        for tables in read_columns(path).values():
            for table in tables:
                count += len(table.sequence)
                if texts:
                    for column in table.columns.values():
                        if isinstance(column, Texts):
                            column.tolist()
        return count

    rates = {
        "armctl": _rate(lambda: ours(compacted, True), rounds),
        "armctl, texts left alone": _rate(lambda: ours(compacted, False), rounds),
        "armctl, of a log flushed every second": _rate(lambda: ours(flushed, True), rounds),
        "armctl, message by message": _rate(lambda: sum(1 for _ in read(compacted)), min(2, rounds)),
        "rosbags": _rate(lambda: _decode_rosbags(compacted), min(2, rounds)),
        "mcap-ros2-support": _rate(lambda: _decode_ros2(compacted), 1),
    }
    for who, rate in rates.items():
        rows.append(row("decode all", who, rate, "messages/s", rates["armctl"] / rate))
    held = info(compacted)
    real_time = rates["armctl"] * held.duration_s / held.messages
    checks.append(check("decode all [messages/s]", rates["armctl"], DECODE_BOUND_PER_S, least=True))
    checks.append(check("decode all, times real time", real_time, 9000.0, least=True))
    checks.append(check("decode all, times rosbags", rates["armctl"] / rates["rosbags"], 9.0, least=True))
    one_by_one = rates["armctl, message by message"] / rates["rosbags"]
    checks.append(check("decode message by message, times rosbags", one_by_one, 3.0, least=True))


def _decode_rosbags(path: Path) -> int:
    from rosbags.highlevel import AnyReader

    with AnyReader([path]) as bag:
        return sum(1 for one, _, data in bag.messages() if bag.deserialize(data, one.msgtype))


def _decode_ros2(path: Path) -> int:
    from mcap.reader import make_reader
    from mcap_ros2.decoder import DecoderFactory

    with path.open("rb") as stream:
        reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        decoded = reader.iter_decoded_messages(log_time_order=False)
        return sum(1 for _ in islice(decoded, SLOW_MESSAGES))


def _topic(path: Path, rounds: int, rows: list[Row], checks: list[Row]) -> None:
    def ours() -> NDArray[np.float64]:
        return np.concatenate(
            [table.numbers("position") for table in read_columns(path, (JOINT_STATES,))[JOINT_STATES]]
        )

    def ros2() -> NDArray[np.float64]:
        from mcap.reader import make_reader
        from mcap_ros2.decoder import DecoderFactory

        with path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            decoded = reader.iter_decoded_messages(topics=[JOINT_STATES], log_time_order=False)
            return np.array([one.decoded_message.position for one in decoded])

    assert (ours() == ros2()).all()
    ours_s, ros2_s = _best_s(ours, rounds), _best_s(ros2, 1)
    rows.append(row("one topic to numpy", "armctl", ours_s, "s", 1.0))
    rows.append(row("one topic to numpy", "mcap-ros2-support", ros2_s, "s", ros2_s / ours_s))
    checks.append(check("one topic to numpy, times mcap-ros2-support", ros2_s / ours_s, 10.0, least=True))


def _parquet(path: Path, out: Path, rounds: int, rows: list[Row], checks: list[Row]) -> None:
    """The table of ticks."""
    took_s = _best_s(lambda: export(path, out, "parquet"), rounds, out)
    rows.append(row("an hour to Parquet", "armctl", took_s, "s", 1.0))
    checks.append(check("an hour to Parquet [s]", took_s, PARQUET_BOUND_S))


def _recovery(flushed: Path, root: Path, rows: list[Row], checks: list[Row]) -> None:
    cut = root / "cut.mcap"
    data = flushed.read_bytes()
    cut.write_bytes(data[: len(data) * 9 // 10])
    begun_s = time.process_time()
    result = recover(cut)
    took_s = time.process_time() - begun_s
    rows.append(row("recover a 90 % cut", "armctl", took_s, "s", 1.0))
    rows.append(row("recover a 90 % cut, messages", "armctl", result.recovered_messages, "messages", 1.0))
    checks.append(check("recover a 90 % cut [s]", took_s, RECOVER_BOUND_S))


def _refusals(root: Path, rows: list[Row], checks: list[Row]) -> None:
    """Hostile files, each read in every way armctl has."""
    path, worst_ms = root / "hostile.mcap", 0.0
    for name, data in files():
        path.write_bytes(data)
        begun_s = time.process_time()
        read_all(path)
        took_ms = 1e3 * (time.process_time() - begun_s) / WAYS
        rows.append(row(f"refuse {name}", "armctl", took_ms, "ms", 1.0))
        worst_ms = max(worst_ms, took_ms)
    checks.append(check("refuse a hostile file [ms]", worst_ms, REFUSE_BOUND_MS))


def _schema(topic: str) -> bytes:
    return schema_text(short_name(TOPICS[topic].type)).encode()


def _rate(count: Callable[[], int], rounds: int) -> float:
    """Messages a second."""
    found = 0

    def work() -> None:
        nonlocal found
        found = count()

    seconds = _best_s(work, rounds)
    return found / seconds


def _best_s(work: Callable[[], object], rounds: int, path: Path | None = None) -> float:
    """Least CPU time of some rounds; the file each of them writes is removed."""
    best_s = float("inf")
    for _ in range(rounds):
        gc.collect()
        begun_s = time.process_time()
        work()
        best_s = min(best_s, time.process_time() - begun_s)
        if path is not None:
            path.unlink()
    return best_s
