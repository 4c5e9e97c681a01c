"""Log files for tests: written from tick records, and read back as they are."""

import json
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mcap.writer import CompressionType, Writer

from armctl.messages import TickRecord
from armctl.recording.cdr import schema_codec
from armctl.recording.channels import CYCLE, TOPICS, WRITES
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.reader import read
from armctl.recording.replay import check
from armctl.recording.schemas import fields, parse_schema, schema_text, short_name
from armctl.recording.writer import SEED, LogContext, LogWriter
from proving.damage import UnsyncedDisk, chunk_places
from tests.recording.factory import ANCHOR, CONTEXT

DISK = UnsyncedDisk()


def write(
    path: Path,
    records: Iterable[TickRecord] = (),
    *,
    notes: Mapping[int, Sequence[str]] = MappingProxyType({}),
    flush_ticks: int = 10,
    finish: bool = True,
    context: LogContext = CONTEXT,
    keyframe: str = "",
    inputs_only: Sequence[TickRecord] = (),
    wire_ticks: int = 0,
    **options: Any,
) -> Path:
    """A file of these records, flushed every so many ticks; the part that is left where it is not finished.

    Args:
        notes: What is noted after a tick, by its number.
        wire_ticks: Every so many ticks what went over the wire; 0: never.
    """
    arguments: dict[str, Any] = {"anchor": ANCHOR, "disk": DISK} | options
    writer = LogWriter(path, context, **arguments)
    writer.begin(keyframe, inputs_only)
    for record in records:
        writer.write_tick(record)
        if wire_ticks and record.inputs.tick % wire_ticks == 0:
            writer.write_wire(record.wire, record.inputs.sample.time_ns)
        for text in notes.get(record.inputs.tick, ()):
            writer.write_note(text, record.inputs.now_ns)
        if record.inputs.tick % flush_ticks == flush_ticks - 1:
            writer.flush()
    if finish:
        writer.close()
        return writer.path
    writer.flush()
    writer.abandon()
    return writer.part


def spoilt(data: bytes, *chunks: int) -> bytes:
    """The bytes of a log with a bit flipped in the middle of some chunks; the first one is the head."""
    found = bytearray(data)
    for begin, end in map(chunk_places(data).__getitem__, chunks):
        found[(begin + end) // 2] ^= 1
    return bytes(found)


def messages(path: Path) -> list[LogMessage]:
    """Every message of a file, still encoded."""
    with LogFile(path) as log:
        return list(log.messages())


def ticks(path: Path) -> list[int]:
    """Numbers of the ticks that are a file's own."""
    return [m.value["tick"] for m in read(path, ["/armctl/cycle"]) if not m.value["inputs_only"]]


def recorder_lines(path: Path) -> list[dict[str, Any]]:
    """What the recorder itself says on /rosout."""
    return [m.value for m in read(path, ["/rosout"]) if m.value["name"] == "armctl.recording"]


def replayed(path: Path) -> tuple[int, int]:
    """How many ticks of a log were replayed, and how many of their messages differ."""
    result = check(path)
    return result.ticks, result.mismatches


@contextmanager
def foreign(path: Path, compression: CompressionType = CompressionType.NONE, **options: Any) -> Iterator[Writer]:
    """The writer of a file that is not armctl's."""
    with path.open("wb") as stream:
        writer = Writer(stream, compression=compression, **options)
        writer.start("ros2", "somebody")
        yield writer
        writer.finish()  # type: ignore[no-untyped-call]


def of_an_older_build(log: Path, path: Path) -> Path:
    """The log as a build would have written it that knew of no register writes, and of neither mode nor faults."""
    new = schema_text("armctl_msgs/Cycle")
    begin, end = new.index("bool goal_sent"), new.index("=" * 80)
    text = new[:begin] + new[end:]
    cycle = schema_codec("armctl_msgs/Cycle", text)
    kept = [field.name for field in fields("armctl_msgs/Cycle", parse_schema("armctl_msgs/Cycle", text))]
    with foreign(path) as writer, LogFile(log) as source:
        ids = {}
        seed: dict[str, Any] = {"schemas": [], "channels": []}
        for topic in TOPICS.values():
            if topic.name != WRITES:
                declared = text if topic.name == CYCLE else schema_text(short_name(topic.type))
                schema = writer.register_schema(topic.type, "ros2msg", declared.encode())
                number = ids[topic.name] = writer.register_channel(topic.name, "cdr", schema, topic.metadata)
                seed["schemas"].append({"id": schema, "name": topic.type, "text": declared})
                about = {"id": number, "topic": topic.name, "schema": schema, "metadata": topic.metadata}
                seed["channels"].append(about)
        for attachment in source.attachments.values():
            own = json.dumps(source.seed() | seed).encode() if attachment.name == SEED else attachment.data
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, own)
        for message in source.messages(ids):
            data = message.data
            if message.topic == CYCLE:
                value = source.decode(message)
                data = cycle.encode({key: value[key] for key in kept})
            time_ns = message.log_time_ns
            writer.add_message(ids[message.topic], time_ns, data, time_ns, message.sequence)
    return path


def add_string_channel(writer: Writer, topic: str = "/chatter") -> int:
    """Number of a new channel of std_msgs/String."""
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", schema_text("std_msgs/String").encode())
    return writer.register_channel(topic, "cdr", schema)
