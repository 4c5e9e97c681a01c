"""What a log holds: message by message, as numpy columns, or in short.

- `read`: decoded messages in file order; `LogFile` (log_file.py) gives them as they are.
- `read_columns`: whole topics as numpy columns (columns.py), many times faster.
- `info`, `ticks`: what is in a file; /joint_states as arrays.

Every failure is a LogError.
"""

from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from mcap.reader import make_reader

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.recording.cdr import Value
from armctl.recording.channels import JOINT_STATES, QUANTITIES
from armctl.recording.columns import Payloads, Table
from armctl.recording.log_file import LogFile


class DecodedMessage(NamedTuple):
    """One message."""

    topic: str
    log_time_ns: int
    sequence: int
    value: Value


@dataclass(frozen=True)
class LogInfo:
    """What a file holds. `complete`: nothing in it is damaged, and stock readers read all of it."""

    messages: int
    start_s: float
    duration_s: float
    topics: dict[str, int]
    complete: bool
    facts: dict[str, str]
    # Whether its end is as it was written; others may refuse a file whose summary has a wrong checksum.
    summary_ok: bool


@dataclass(frozen=True)
class JointTrack:
    """/joint_states as arrays; `time_s` counts from the first message, arrays have shape (m,) and (m, n)."""

    names: tuple[str, ...]
    start_ns: int
    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    load_ratio: FloatArray


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


def ticks(path: Path) -> JointTrack:
    """/joint_states of a log as arrays.

    Raises:
        LogError: the file is no log or holds none.
    """
    with LogFile(path) as log:
        return joint_track(log, log.payloads((JOINT_STATES,))[JOINT_STATES])


def joint_track(log: LogFile, payloads: Payloads) -> JointTrack:
    """Those messages of /joint_states that name the most joints, as arrays.

    Raises:
        LogError: there are none.
    """
    found = [_named(table) for table in log.tables(JOINT_STATES, payloads)] if len(payloads.size) else []
    named = [kind for kind in found if kind is not None]
    if not named:
        raise LogError(f"{log.path}: holds no joint states")
    names, table = max(named, key=lambda kind: len(kind[0]))
    time_ns = table.log_time_ns.astype(np.int64)
    return JointTrack(
        names=names,
        start_ns=int(time_ns[0]),
        time_s=(time_ns - time_ns[0]) / NS_PER_S,
        **{quantity: table.numbers(path) for path, quantity in QUANTITIES.items()},
    )


def _named(table: Table) -> tuple[tuple[str, ...], Table] | None:
    """The joints of a table, if it has a number of each kind for each of them."""
    names = tuple(path for path in table.columns if path.startswith("name["))
    shapes = {table.numbers(path).shape[-1] for path in QUANTITIES}
    if not names or shapes != {len(names)}:
        return None
    return tuple(str(table.columns[path][0]) for path in names), table
