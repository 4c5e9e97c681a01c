"""Reading logs, whole or cut, ours or from elsewhere.

Rules.
1. One pass over the records in file order; no index is needed, so a file without an end reads as well.
2. Only what a checksum vouches for is used: a chunk whose CRC does not hold is skipped, and so is whatever cannot
   be parsed; the search goes on at the next chunk, and `complete` tells.
3. The channels come from the seed attachment if there is one, so that a damaged first chunk costs only itself.
4. A chunk is never inflated beyond `MAX_CHUNK_BYTES`, whatever it claims. Every failure is a LogError.
"""

from __future__ import annotations

import io
import json
import mmap
import struct
import zlib
from collections.abc import Collection, Generator, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import lz4.frame  # type: ignore[import-untyped]
import numpy as np
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.recording.cdr import Codec, Value, schema_codec
from armctl.recording.channels import JOINT_STATES
from armctl.recording.writer import SEED

MAGIC = b"\x89MCAP0\r\n"
MAX_CHUNK_BYTES = 16 * 2**20
MAX_RECORD_BYTES = 64 * 2**20
MAX_CHUNK_NS = 3600 * NS_PER_S
_STAMP_END = 12
_RECORD = struct.Struct("<BQ")
_CHUNK = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of the compression's name
_MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
_MESSAGE_OPCODE = int(Opcode.MESSAGE)  # comparing enumeration members costs more than all the rest


class LogMessage(NamedTuple):
    """One message, still encoded."""

    topic: str
    log_time_ns: int
    sequence: int
    data: bytes


class DecodedMessage(NamedTuple):
    """One message."""

    topic: str
    log_time_ns: int
    sequence: int
    value: Value


@dataclass(frozen=True)
class LogInfo:
    """What a file holds. `complete`: it has its end, and nothing in it is damaged."""

    messages: int
    start_s: float
    duration_s: float
    topics: dict[str, int]
    complete: bool
    facts: dict[str, str]


@dataclass(frozen=True)
class JointTrack:
    """/joint_states as arrays; `time_s` counts from the first message, arrays have shape (m,) and (m, n)."""

    names: tuple[str, ...]
    start_ns: int
    time_s: FloatArray
    position_rad: FloatArray
    velocity_rad_s: FloatArray
    load_ratio: FloatArray


class LogFile:
    """One pass over a file: attachments and facts are known at once, messages come from `messages`.

    Raises:
        LogError: the file cannot be opened or is no MCAP file.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.library = ""
        self.attachments: dict[str, Attachment] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        self.complete = False
        """Known when the messages are exhausted."""
        self.damaged = 0
        """Places that had to be skipped so far."""
        self.lost_ns = 0
        """Log time covered by chunks that could not be read, as far as their headers tell."""
        self._end_ns = 0
        self._codecs: dict[int, Codec] = {}
        try:
            with path.open("rb") as file:
                self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            reason = "it is empty" if isinstance(error, ValueError) else getattr(error, "strerror", error)
            raise LogError(f"{path}: cannot be read: {reason}") from None
        if self._data[:8] != MAGIC:
            raise LogError(f"{path}: is no MCAP file")
        self._at = 8
        self._records = self._scan()
        self._first = next(self._records, None)

    @property
    def progress(self) -> float:
        """Fraction of the file read so far."""
        return self._at / len(self._data)

    @property
    def facts(self) -> dict[str, str]:
        """What armctl says of its own file, preferably where a checksum vouches for it; empty for others' files."""
        facts = self.seed().get("armctl", self.metadata.get("armctl"))
        return {str(key): str(value) for key, value in facts.items()} if isinstance(facts, dict) else {}

    def seed(self) -> dict[str, Any]:
        """The seed attachment (see writer.py); empty for others' files."""
        attachment = self.attachments.get(SEED)
        if attachment is None:
            return {}
        try:
            seed = json.loads(attachment.data)
        except (ValueError, RecursionError):
            return {}
        return seed if isinstance(seed, dict) else {}

    def text(self, name: str) -> str:
        """An attachment as text.

        Raises:
            LogError: there is none of that name: the file was not written by armctl, or begins damaged.
        """
        if name not in self.attachments:
            raise LogError(f"{self.path}: holds no {name}; it was not written by armctl, or its beginning is damaged")
        try:
            return self.attachments[name].data.decode()
        except UnicodeDecodeError:
            raise LogError(f"{self.path}: {name} is not UTF-8 text") from None

    def messages(self, topics: Collection[str] | None = None) -> Iterator[LogMessage]:
        """Messages in file order, of some topics or all; once."""
        chunk = self._first
        while chunk is not None:
            yield from self._chunk_messages(chunk, topics)
            chunk = next(self._records, None)

    def codec(self, topic: str) -> Codec:
        """The codec of a topic as this file declares it.

        Raises:
            LogError: no such topic, or its encoding is not CDR with a ros2msg schema.
        """
        for channel in self.channels.values():
            if channel.topic != topic:
                continue
            if channel.id not in self._codecs:
                schema = self.schemas.get(channel.schema_id)
                if channel.message_encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
                    raise LogError(f"{self.path}: topic {topic} is not CDR with a ros2msg schema")
                try:
                    self._codecs[channel.id] = schema_codec(schema.name, schema.data.decode())
                except (UnicodeDecodeError, RecursionError) as error:
                    raise LogError(f"{self.path}: schema {schema.name} is damaged: {error}") from None
            return self._codecs[channel.id]
        raise LogError(f"{self.path}: no topic {topic}; known: {', '.join(sorted(self.topics)) or 'none'}")

    @property
    def topics(self) -> frozenset[str]:
        return frozenset(channel.topic for channel in self.channels.values())

    def close(self) -> None:
        self._records.close()
        self._data.close()

    def __enter__(self) -> LogFile:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # ------------------------------------------------------------------------------------------- records

    def _scan(self) -> Generator[bytes, None, None]:
        """Inflated chunks with a good checksum; everything else is taken note of on the way."""
        data, size = self._data, len(self._data)
        while self._at + _RECORD.size <= size:
            opcode, length = _RECORD.unpack_from(data, self._at)
            begin = self._at + _RECORD.size
            if opcode == Opcode.DATA_END and length == 4:
                self.complete = self.damaged == 0 and data[size - 8 :] == MAGIC
                break
            try:
                if not 0 < opcode < Opcode.DATA_END or length > min(MAX_RECORD_BYTES, size - begin):
                    raise LogError("no record, or one that was cut")
                chunk = self._record(opcode, data[begin : begin + length])
            except Exception:  # the packages that parse and inflate share no type of error
                self._skip_damage(opcode, begin, length)
                continue
            self._at = begin + length
            if chunk is not None:
                yield chunk
        self._at = size

    def _record(self, opcode: int, body: bytes) -> bytes | None:
        """Take note of one record; the inflated data if it is a chunk."""
        stream = ReadDataStream(io.BytesIO(body))
        if opcode == Opcode.CHUNK:
            return _inflate(body)
        if opcode == Opcode.HEADER:
            self.library = Header.read(stream).library
        elif opcode == Opcode.ATTACHMENT:
            (crc,) = struct.unpack_from("<I", body, len(body) - 4)
            if crc not in (0, zlib.crc32(body[:-4])):
                raise LogError("the attachment's checksum does not hold")
            attachment = Attachment.read(stream)
            self.attachments[attachment.name] = attachment
            if attachment.name == SEED:
                self._take_seed()
        elif opcode == Opcode.METADATA:
            metadata = Metadata.read(stream)
            self.metadata[metadata.name] = metadata.metadata
        elif opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            self.schemas.setdefault(schema.id, schema)
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            self.channels.setdefault(channel.id, channel)
        elif opcode == Opcode.MESSAGE:
            raise LogError("a message outside a chunk has no checksum")
        return None

    def _take_seed(self) -> None:
        seed = self.seed()
        for entry in seed["schemas"]:
            self.schemas[entry["id"]] = Schema(entry["id"], entry["text"].encode(), "ros2msg", entry["name"])
        for entry in seed["channels"]:
            metadata = {str(key): str(value) for key, value in entry["metadata"].items()}
            self.channels[entry["id"]] = Channel(entry["id"], entry["topic"], "cdr", metadata, entry["schema"])

    def _skip_damage(self, opcode: int, begin: int, length: int) -> None:
        """Go on behind a small record if another follows it, else at the next place that looks like a chunk."""
        self.damaged += 1
        data = self._data
        behind = begin + length
        if opcode != Opcode.CHUNK and behind + _RECORD.size <= len(data):
            next_opcode, next_length = _RECORD.unpack_from(data, behind)
            if 0 < next_opcode <= Opcode.DATA_END and behind + _RECORD.size + next_length <= len(data):
                self._at = behind
                return
        if opcode == Opcode.CHUNK and begin + _CHUNK.size <= len(data):
            _, end_ns, _, _, _ = _CHUNK.unpack_from(data, begin)
            if 0 < end_ns - self._end_ns < MAX_CHUNK_NS:
                self.lost_ns += end_ns - self._end_ns
                self._end_ns = end_ns
        at = self._at
        name = b"\x04\x00\x00\x00zstd"  # what stands in the middle of the header of every chunk of ours
        while True:
            found = data.find(name, at + _RECORD.size + _CHUNK.size - 3)
            if found < 0:
                self._at = len(data)
                return
            at = found + 4 - _CHUNK.size - _RECORD.size
            length_at = found + len(name)
            if length_at + 8 <= len(data) and at > self._at:
                opcode, length = _RECORD.unpack_from(data, at)
                (inner,) = struct.unpack_from("<Q", data, length_at)
                if opcode == Opcode.CHUNK and length == _CHUNK.size + 4 + 8 + inner:
                    self._at = at
                    return

    def _chunk_messages(self, chunk: bytes, topics: Collection[str] | None) -> Iterator[LogMessage]:
        size = len(chunk)
        padded = chunk + bytes(_MESSAGE.size)  # so that a short record at the end unpacks as a message, too
        unpack, header, at = _MESSAGE.unpack_from, _MESSAGE.size, 0
        names = self._names()
        while at < size:
            opcode, length, number, sequence, log_time_ns, _ = unpack(padded, at)
            begin, end = at + _RECORD.size, at + _RECORD.size + length
            if end > size:
                self.damaged += 1
                return
            if opcode != _MESSAGE_OPCODE or end < at + header:
                self._chunk_record(opcode, chunk[begin:end])
                names = self._names()
            elif (name := names.get(number)) is None:
                self.damaged += 1
            else:
                self._end_ns = log_time_ns
                if topics is None or name in topics:
                    yield LogMessage(name, log_time_ns, sequence, chunk[at + header : end])
            at = end

    def _names(self) -> dict[int, str]:
        return {channel.id: channel.topic for channel in self.channels.values()}

    def _chunk_record(self, opcode: int, body: bytes) -> None:
        stream = ReadDataStream(io.BytesIO(body))
        try:
            if opcode == Opcode.SCHEMA:
                schema = Schema.read(stream)
                self.schemas[schema.id] = schema
            elif opcode == Opcode.CHANNEL:
                channel = Channel.read(stream)
                self.channels[channel.id] = channel
            else:
                self.damaged += 1
        except Exception:  # as in _scan
            self.damaged += 1


def _inflate(body: bytes) -> bytes:
    """The records inside a chunk.

    Raises:
        LogError: they are larger than allowed or than said, or not what the checksum says.
    """
    _, _, size, crc, name_length = _CHUNK.unpack_from(body)
    name_end = _CHUNK.size + name_length
    compression = body[_CHUNK.size : name_end]
    (length,) = struct.unpack_from("<Q", body, name_end)
    packed = body[name_end + 8 :]
    if size > MAX_CHUNK_BYTES or length != len(packed):
        raise LogError(f"a chunk of {size} bytes; {MAX_CHUNK_BYTES} is the bound")
    if compression == b"zstd":
        inflater = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        data = inflater.stream_reader(packed).read(size + 1)
    elif compression == b"lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression == b"":
        data = packed
    else:
        raise LogError(f"unknown compression {compression!r}")
    if len(data) != size or crc not in (0, zlib.crc32(data)):
        raise LogError("a chunk's checksum does not hold")
    return data


class TrackBuilder:
    """Collects /joint_states messages into arrays.

    Most messages of a file differ only in stamp and numbers: those are recognised by their other bytes and copied
    as they are, the first of each kind is decoded.
    """

    def __init__(self) -> None:
        self._offsets: dict[int, int] = {}
        self._kinds: dict[bytes, tuple[tuple[str, ...], list[int], list[bytes]]] = {}

    def add(self, message: LogMessage, codec: Codec) -> None:
        """Take one message.

        Raises:
            LogError: it cannot be decoded.
        """
        data = message.data
        offset = self._offsets.get(len(data))
        kind = None if offset is None else self._kinds.get(data[_STAMP_END:offset])
        if kind is None:
            value = codec.decode(data)
            n = len(value["name"])
            if n == 0 or {len(value[key]) for key in ("position", "velocity", "effort")} != {n}:
                return
            offset = len(data) - 24 * n - 16
            self._offsets[len(data)] = offset
            kind = self._kinds.setdefault(data[_STAMP_END:offset], (tuple(value["name"]), [], []))
        kind[1].append(message.log_time_ns)
        kind[2].append(data[offset:])

    def build(self, path: Path) -> JointTrack:
        """The messages that name the most joints, as arrays.

        Raises:
            LogError: there are none.
        """
        if not self._kinds:
            raise LogError(f"{path}: holds no joint states")
        names, times, tails = max(self._kinds.values(), key=lambda kind: len(kind[0]))
        n = len(names)
        # After the positions: a count and its padding, the velocities, another count, the efforts.
        block = np.frombuffer(b"".join(tails), dtype="<f8").reshape(len(times), 3 * n + 2)
        counts = np.ascontiguousarray(block[:, [n, 2 * n + 1]]).view("<u4")[:, ::2]
        if (counts != n).any():
            raise LogError(f"{path}: joint states with differing numbers of positions, velocities and efforts")
        time_ns = np.array(times, dtype=np.int64)
        return JointTrack(
            names=names,
            start_ns=times[0],
            time_s=(time_ns - times[0]) / NS_PER_S,
            position_rad=block[:, :n].astype(np.float64),
            velocity_rad_s=block[:, n + 1 : 2 * n + 1].astype(np.float64),
            load_ratio=block[:, 2 * n + 2 :].astype(np.float64),
        )


def read(path: Path, topics: Collection[str] | None = None) -> Iterator[DecodedMessage]:
    """Every message of a log, or of some topics, decoded, in file order.

    Raises:
        LogError: the file is no log, or a message does not fit its schema.
    """
    with LogFile(path) as log:
        for message in log.messages(topics):
            value = log.codec(message.topic).decode(message.data)
            yield DecodedMessage(message.topic, message.log_time_ns, message.sequence, value)


def info(path: Path) -> LogInfo:
    """What a log holds; reads all of it, so that `complete` is true to the last byte.

    Raises:
        LogError: the file is no log.
    """
    topics: dict[str, int] = {}
    begin_ns, end_ns = 2**64, 0
    with LogFile(path) as log:
        for message in log.messages():
            topics[message.topic] = topics.get(message.topic, 0) + 1
            begin_ns, end_ns = min(begin_ns, message.log_time_ns), max(end_ns, message.log_time_ns)
        if not topics:
            begin_ns = end_ns = 0
        return LogInfo(
            messages=sum(topics.values()),
            start_s=begin_ns / NS_PER_S,
            duration_s=(end_ns - begin_ns) / NS_PER_S,
            topics=dict(sorted(topics.items())),
            complete=log.complete,
            facts=log.facts,
        )


def ticks(path: Path) -> JointTrack:
    """/joint_states of a log as arrays.

    Raises:
        LogError: the file is no log or holds none.
    """
    builder = TrackBuilder()
    with LogFile(path) as log:
        for message in log.messages((JOINT_STATES,)):
            builder.add(message, log.codec(JOINT_STATES))
    return builder.build(path)
