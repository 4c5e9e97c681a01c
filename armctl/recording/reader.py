"""What a log holds: message by message, as numpy columns, or in short.

- `read`: decoded messages in file order; `LogFile` (log_file.py) gives them as they are.
- `read_columns`: whole topics as numpy columns (columns.py), many times faster.
- `info`: what is in a file.

Every failure is a LogError.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from pathlib import Path
from typing import NamedTuple

from mcap.reader import make_reader

from armctl.clock import NS_PER_S
from armctl.recording.cdr import Value
from armctl.recording.columns import Table
from armctl.recording.log_file import LogFile


class DecodedMessage(NamedTuple):
    """One message."""

    topic: str
    log_time_ns: int
    sequence: int
    value: Value


class LogInfo(NamedTuple):
    """What a file holds. `complete`: nothing in it is damaged, and stock readers read all of it."""

    messages: int
    start_s: float
    duration_s: float
    topics: dict[str, int]
    complete: bool
    facts: dict[str, str]
    # Whether its end is as it was written; others may refuse a file whose summary has a wrong checksum.
    summary_ok: bool


def read(path: Path, topics: Collection[str] | None = None) -> Iterator[DecodedMessage]:
    """Every message of a log, or of some topics, decoded, in file order.

    Raises:
        LogError: the file is no log, or a message does not fit its schema.
    """
    with LogFile(path) as log:
        for message in log.messages(topics):
            yield tuple.__new__(DecodedMessage, (*message[:3], log.decode(message)))  # half the time of a call


def read_columns(path: Path, topics: Iterable[str] | None = None) -> dict[str, tuple[Table, ...]]:
    """A log, or some topics of it, as numpy columns: by topic a table for each shape its messages come in.

    A topic nearly always has one table; one without messages is left out.

    Raises:
        LogError: the file is no log, or a topic of it is not what its schema says.
    """
    with LogFile(path) as log:
        found = log.payloads(None if topics is None else frozenset(topics))
        return {topic: log.tables(topic, payloads) for topic, payloads in found.items() if len(payloads.size)}


def info(path: Path) -> LogInfo:
    """What a log holds; reads all of it, so that `complete` is true to the last byte.

    Raises:
        LogError: the file is no log.
    """
    topics: Counter[str] = Counter()
    begin_ns, end_ns = 2**64, 0
    with LogFile(path) as log:
        for message in log.messages():
            topics[message.topic] += 1
            begin_ns, end_ns = min(begin_ns, message.log_time_ns), max(end_ns, message.log_time_ns)
        begin_ns = min(begin_ns, end_ns)  # of a file without messages: 0
        return LogInfo(
            messages=topics.total(),
            start_s=begin_ns / NS_PER_S,
            duration_s=(end_ns - begin_ns) / NS_PER_S,
            topics=dict(sorted(topics.items())),
            complete=log.complete or (log.ended and not log.damaged and _stock_reads(log, topics)),
            facts=log.facts,
            summary_ok=log.complete,
        )


def _stock_reads(log: LogFile, topics: Counter[str]) -> bool:
    """Whether the mcap package finds as many messages of every topic by the file's summary."""
    try:
        with log.path.open("rb") as stream:
            reader = make_reader(stream, validate_crcs=True)
            summary = reader.get_summary()
            begins = [] if summary is None else [index.chunk_start_offset for index in summary.chunk_indexes]
            if sorted(begins) != log.begins:
                return False  # it misses chunks, or finds some that have not been seen to be sound
            return Counter(channel.topic for _, channel, _ in reader.iter_messages()) == topics
    except Exception:  # it has no common type of error
        return False
