"""Log files for tests: written from tick records, and read back as they are."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from types import MappingProxyType
from typing import Any

from mcap.writer import CompressionType, Writer

from armctl.messages import TickRecord
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.reader import read
from armctl.recording.replay import check
from armctl.recording.schemas import schema_text
from armctl.recording.writer import LogContext, LogWriter
from proving.damage import UnsyncedDisk
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
    **options: Any,
) -> Path:
    """A file of these records, flushed every so many ticks; the part that is left where it is not finished.

    Args:
        notes: What is noted after a tick, by its number.
    """
    arguments: dict[str, Any] = {"anchor": ANCHOR, "disk": DISK} | options
    writer = LogWriter(path, context, **arguments)
    writer.begin(keyframe, inputs_only)
    for record in records:
        writer.write_tick(record)
        for text in notes.get(record.inputs.tick, ()):
            writer.write_note("/armctl/command", text, record.inputs.now_ns)
        if record.inputs.tick % flush_ticks == flush_ticks - 1:
            writer.flush()
    if finish:
        writer.close()
        return writer.path
    writer.flush()
    writer.abandon()
    return writer.part


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


def add_string_channel(writer: Writer, topic: str = "/chatter") -> int:
    """Number of a new channel of std_msgs/String."""
    schema = writer.register_schema("std_msgs/msg/String", "ros2msg", schema_text("std_msgs/String").encode())
    return writer.register_channel(topic, "cdr", schema)
