"""CDR messages of one topic to numpy columns, all messages at once.

Rules.
1. A type is walked once for all messages: at each field the numbers of every message are copied into one
   contiguous array. Where all messages have one size, that is a strided copy, else a gather.
2. A field's column is named by its path: `header.stamp.sec`, `position`, `servos[2].registers`. A number has shape
   (n,), an array of k numbers (n, k); texts stay where they are until they are asked for (`Texts`).
3. Messages whose sequences have differing counts fit no common columns: they make a `Table` for each shape.
4. What does not fit its schema is a LogError, as it is for the codec (cdr.py), which these columns agree with.
"""

import struct
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import groupby
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from armctl.errors import LogError
from armctl.recording.cdr import HEADER, MAX_DEPTH
from armctl.recording.chunks import RECORD
from armctl.recording.schemas import PRIMITIVES, fields

# Bounds on what a topic may fall into; beyond them it is read message by message.
MAX_COLUMNS = 15_000
MAX_TABLES = 256
# Longest text [bytes] that is looked at for being the same in every message.
MAX_REPEATED = 64

IntArray = NDArray[np.int64]
Column = NDArray[Any]
_At = int | IntArray  # where a field begins, counted from each message's beginning


@dataclass(frozen=True)
class Texts:
    """A text field of n messages, not yet made into strings."""

    _buffer: bytes
    _begin: IntArray
    # In bytes; one number if they are all of one size.
    _size: int | IntArray

    def __len__(self) -> int:
        return len(self._begin)

    def __getitem__(self, index: int) -> str:
        begin = int(self._begin[index])
        return self._text(begin, begin + int(self._size if isinstance(self._size, int) else self._size[index]))

    def tolist(self) -> list[str]:
        """The texts.

        Raises:
            LogError: one is not UTF-8.
        """
        if isinstance(self._size, int) and len(self) and self._are_one():
            return [self[0]] * len(self)
        ends = (self._begin + self._size).tolist()
        return [self._text(begin, end) for begin, end in zip(self._begin.tolist(), ends, strict=True)]

    def _are_one(self) -> bool:
        """Whether they are all the same, as names and frame ids are in every message."""
        assert isinstance(self._size, int)
        if self._size == 0 or self._size > MAX_REPEATED:
            return self._size == 0
        steps = np.diff(self._begin)
        stride = int(steps[0]) if len(steps) else 0
        if (steps == stride).all():
            shape, first = (len(self), self._size), int(self._begin[0])
            characters = np.ndarray(shape, np.uint8, self._buffer, first, (stride, 1))
        else:
            characters = np.frombuffer(self._buffer, np.uint8)[self._begin[:, None] + np.arange(self._size)]
        return bool((characters == characters[0]).all())

    def _text(self, begin: int, end: int) -> str:
        try:
            return str(self._buffer[begin:end], "utf-8")
        except UnicodeDecodeError as error:
            raise LogError(f"a text is not UTF-8 ({error.reason})") from None


class Table(NamedTuple):
    """Messages of one topic that have one shape, in file order."""

    log_time_ns: NDArray[np.uint64]
    sequence: NDArray[np.uint32]
    # As in `Payloads`.
    place: IntArray
    columns: dict[str, Column | Texts]

    def numbers(self, path: str) -> NDArray[np.float64]:
        """A column of numbers, as floating point.

        Raises:
            LogError: there is no such column of numbers; the message lists the known ones.
        """
        column = self.columns.get(path)
        if isinstance(column, np.ndarray):
            return column.astype(np.float64)
        raise LogError(f"no column {path} of numbers; known: {', '.join(self.columns)}")


@dataclass(frozen=True)
class Payloads:
    """Encoded messages of one topic in file order, as arrays of shape (n,), and their bytes one behind the other."""

    log_time_ns: NDArray[np.uint64]
    sequence: NDArray[np.uint32]
    # Rises from message to message, of all topics of a file.
    place: IntArray
    size: IntArray
    data: bytes

    def __iter__(self) -> Iterator[tuple[int, bytes]]:
        """Log time and bytes of each."""
        ends = np.cumsum(self.size)
        columns = (column.tolist() for column in (self.log_time_ns, ends - self.size, ends))
        yield from ((time_ns, self.data[begin:end]) for time_ns, begin, end in zip(*columns, strict=True))

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """All of these, one after the other."""
        kinds = {"log_time_ns": np.uint64, "sequence": np.uint32, "place": np.int64, "size": np.int64}
        arrays = {key: [np.empty(0, kind), *(getattr(part, key) for part in parts)] for key, kind in kinds.items()}
        joined: dict[str, Column] = {key: np.concatenate(columns) for key, columns in arrays.items()}
        return cls(**joined, data=b"".join([part.data for part in parts]))


# A message's record but for its data.
_HEAD = np.dtype([("opcode", "u1"), ("length", "<u8"), ("channel", "<u2"), ("sequence", "<u4"), ("times_ns", "<u8", 2)])


class Block:
    """Messages of some chunks.

    Args:
        data: Their records, among others.
        begins: Where each message's record begins.
        channels: The topic of every channel; messages of others are left out.
    """

    def __init__(self, data: bytes, begins: Sequence[int], channels: Mapping[int, str]) -> None:
        self.data = data
        begin = np.array(begins, np.int64)
        places = np.ndarray((max(0, len(data) - _HEAD.itemsize + 1),), f"V{_HEAD.itemsize}", data, 0, (1,))
        heads = places[begin].view(_HEAD)
        numbers = np.unique(heads["channel"]).tolist()
        self._topics = {number: channels[number] for number in numbers if number in channels}
        known = np.isin(heads["channel"], [*self._topics])
        # How many messages are left out.
        self.unknown = int((~known).sum())
        self._heads, self._begin = heads[known], begin[known] + _HEAD.itemsize
        self._end = self._begin + self._heads["length"].astype(np.int64) - (_HEAD.itemsize - RECORD.size)

    def __iter__(self) -> Iterator[tuple[str, int, int, bytes]]:
        """Topic, log time, sequence number and bytes of each."""
        heads, data, topics = self._heads, self.data, self._topics
        columns = (heads["channel"], heads["times_ns"][:, 0], heads["sequence"], self._begin, self._end)
        for number, time_ns, sequence, begin, end in zip(*(column.tolist() for column in columns), strict=True):
            yield topics[number], time_ns, sequence, data[begin:end]

    def payloads(self, topics: Collection[str] | None, base: int) -> Iterator[tuple[str, Payloads]]:
        """The messages of some topics, or of all; `base`: place of the block in its file."""
        asked = (number for number, topic in self._topics.items() if topics is None or topic in topics)
        for topic, numbers in groupby(sorted(asked, key=self._topics.__getitem__), self._topics.__getitem__):
            rows = np.isin(self._heads["channel"], [*numbers])
            heads, begin, end = self._heads[rows], self._begin[rows], self._end[rows]
            size, data = end - begin, self.data
            if (least := int(size[0])) and (size == least).all():
                content = np.ndarray((len(data) - least + 1,), f"V{least}", data, 0, (1,))[begin].tobytes()
            else:
                content = b"".join([data[a:b] for a, b in zip(begin.tolist(), end.tolist(), strict=True)])
            times_ns, sequence = (np.ascontiguousarray(one) for one in (heads["times_ns"][:, 0], heads["sequence"]))
            yield topic, Payloads(times_ns, sequence, base + begin, size, content)


class _Differ(Exception):
    """Counts that differ from message to message."""

    def __init__(self, counts: Column) -> None:
        self.counts = counts


def tables(name: str, messages: Mapping[str, str], payloads: Payloads) -> tuple[Table, ...]:
    """All messages of a topic as columns, one table for each shape they come in.

    Args:
        name: Short name of the type.
        messages: Declarations of the types (see schemas.py).
    Raises:
        LogError: a message does not fit the type, or they come in too many shapes.
    """
    n, sizes = len(payloads.size), payloads.size
    starts = np.cumsum(sizes) - sizes
    found: list[Table] = []
    pending = [np.arange(n)] if n else []
    while pending:
        rows = pending.pop(0)
        whole = len(rows) == n
        walk = _Walk(name, messages, payloads.data, starts if whole else starts[rows], sizes if whole else sizes[rows])
        try:
            columns = walk.columns()
        except _Differ as differ:
            kinds, first = np.unique(differ.counts, return_index=True)
            pending += [rows[differ.counts == kind] for kind in kinds[np.argsort(first)]]
            if len(found) + len(pending) > MAX_TABLES:
                raise LogError(f"{name}: over {MAX_TABLES} shapes of messages; read them one by one") from None
            continue
        found.append(Table(payloads.log_time_ns[rows], payloads.sequence[rows], payloads.place[rows], columns))
    return tuple(found)


class _Walk:
    """One way through a type, for messages of one shape."""

    def __init__(self, name: str, messages: Mapping[str, str], data: bytes, starts: IntArray, sizes: IntArray) -> None:
        self._name, self._messages, self._buffer = name, messages, data
        self._starts, self._sizes, self._least = starts, sizes, int(sizes.min())
        self._stride = self._least if (sizes == self._least).all() and (np.diff(starts) == self._least).all() else 0
        self._columns: dict[str, Column | Texts] = {}
        self._fields = 0

    def columns(self) -> dict[str, Column | Texts]:
        if (self._numbers("B", 0, len(HEADER)) != np.frombuffer(HEADER, np.uint8)).any():
            raise LogError(f"{self._name}: not little-endian CDR")
        self._message(self._name, "", len(HEADER), 0)
        return self._columns

    def _message(self, name: str, path: str, at: _At, depth: int) -> _At:
        if depth > MAX_DEPTH:
            raise LogError(f"message type {name}: nested deeper than {MAX_DEPTH}")
        for item in fields(name, self._messages):
            place = path + item.name
            self._fields += 1
            if max(self._fields, len(self._columns)) > MAX_COLUMNS:
                raise LogError(f"{self._name}: over {MAX_COLUMNS} columns; read the messages one by one")
            count = 1
            if item.is_array:
                count, at = self._count(at)
            if item.type in PRIMITIVES:
                at = self._primitive(place, PRIMITIVES[item.type], at, count if item.is_array else None)
                continue
            for index in range(count):
                path_here = f"{place}[{index}]" if item.is_array else place
                if item.type == "string":
                    at = self._text(path_here, at)
                else:
                    at = self._message(item.type, f"{path_here}.", at, depth + 1)
        return at

    def _primitive(self, path: str, character: str, at: _At, count: int | None) -> _At:
        size = struct.calcsize(character)
        if count != 0:
            at = _aligned(at, size)
        column = self._numbers("B" if character == "?" else character, at, 1 if count is None else count)
        if character == "?":
            column = column != 0
        self._columns[path] = column[:, 0] if count is None else column
        return at + size * (1 if count is None else count)

    def _text(self, path: str, at: _At) -> _At:
        at = _aligned(at, 4)
        length: Column = self._numbers("I", at, 1)[:, 0]
        first = int(length[0])
        size: int | IntArray = first if (length == first).all() else length.astype(np.int64)
        if self._beyond(at + 4 + size):
            raise LogError(f"{self._name}: a text ends beyond its message")
        shown = max(0, size - 1) if isinstance(size, int) else np.maximum(size - 1, 0)
        self._columns[path] = Texts(self._buffer, self._starts + (at + 4), shown)
        return at + 4 + size

    def _count(self, at: _At) -> tuple[int, _At]:
        at = _aligned(at, 4)
        counts = self._numbers("I", at, 1)[:, 0]
        first = int(counts[0])
        if (counts != first).any():
            raise _Differ(counts)
        if first > self._least:  # no element is smaller than a byte
            raise LogError(f"{self._name}: {first} values end beyond the message")
        return first, at + 4

    def _beyond(self, end: _At) -> bool:
        return end > self._least if isinstance(end, int) else bool((end > self._sizes).any())

    def _numbers(self, character: str, at: _At, count: int) -> Column:
        """`count` numbers of every message, shape (n, count)."""
        dtype = np.dtype(f"<{character}")
        size, n = dtype.itemsize, len(self._starts)
        if self._beyond(at + size * count):
            raise LogError(f"{self._name}: damaged message, it ends before its fields do")
        if count == 0:
            return np.zeros((n, 0), dtype)
        if isinstance(at, int) and self._stride:
            return np.ndarray((n, count), dtype, self._buffer, int(self._starts[0]) + at, (self._stride, size)).copy()
        places = np.ndarray((len(self._buffer) - size + 1,), dtype, self._buffer, 0, (1,))
        return np.asarray(places[(self._starts + at)[:, None] + np.arange(0, size * count, size)])


def _aligned(at: _At, size: int) -> _At:
    return at + -(at - len(HEADER)) % size
