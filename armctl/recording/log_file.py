"""Reading logs, whole or cut, ours or from elsewhere.

Rules.
1. One pass over the records in file order; no index is needed, so a file without an end reads as well.
2. Only what a checksum confirms is used: a chunk whose CRC does not hold is skipped, and so is whatever cannot
   be parsed; the search goes on at the next chunk, and `complete` tells.
3. The channels come from the seed attachment if there is one, so that a damaged first chunk costs only itself.
4. A chunk is never inflated beyond `MAX_CHUNK_BYTES`, whatever it claims, and a file whose chunks together claim
   more than `FREE_BYTES` and `MAX_RATIO` times its size is refused, or one that declares over `MAX_DECLARED` channels.
   Every failure is a LogError.
"""

import io
import json
import mmap
import struct
import zlib
from collections.abc import Callable, Collection, Generator, Iterator
from contextlib import AbstractContextManager, contextmanager, suppress
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Channel, Header, Metadata, Schema

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.recording import chunks, columns
from armctl.recording.cdr import Codec, Value, schema_codec
from armctl.recording.chunks import CHUNK, MAGIC, MAX_CHUNK_BYTES, MESSAGE, MESSAGE_OPCODE, RECORD
from armctl.recording.columns import Block, Payloads, Table
from armctl.recording.schemas import parse_schema, short_name
from armctl.recording.writer import SEED

# Bound on what the chunks of a file may claim to inflate to: this many bytes, and this many for each of its own.
FREE_BYTES = MAX_CHUNK_BYTES
MAX_RATIO = 256
MAX_SEED_BYTES = 2**20
MAX_DECLARED = 10_000
MAX_RECORD_BYTES = MAX_CHUNK_BYTES + 2**16
MAX_CHUNK_NS = 3600 * NS_PER_S
# What is taken apart together: less takes longer, more takes memory.
BLOCK_BYTES = 4 * 2**20
_CHUNK, _MESSAGE_INDEX, _DATA_END = int(Opcode.CHUNK), int(Opcode.MESSAGE_INDEX), int(Opcode.DATA_END)
_PRIVATE = 0x80
# Records whose content is kept; messages and chunks are read apart.
_KINDS: dict[int, type[Header | Attachment | Metadata | Schema | Channel]] = {
    Opcode.HEADER: Header, Opcode.ATTACHMENT: Attachment, Opcode.METADATA: Metadata, Opcode.SCHEMA: Schema,
    Opcode.CHANNEL: Channel,
}  # fmt: skip
Progress = Callable[[float], None]


class LogMessage(NamedTuple):
    """One message, still encoded."""

    topic: str
    log_time_ns: int
    sequence: int
    data: bytes


class LogFile(AbstractContextManager["LogFile"]):
    """One pass over a file: attachments and facts are known at once, messages come from `messages`.

    Args:
        progress: Called now and then with the fraction of the file that was read.
    Raises:
        LogError: the file cannot be opened or is no MCAP file.
    """

    def __init__(self, path: Path, progress: Progress | None = None) -> None:
        self.path, self._progress = path, progress
        self.attachments: dict[str, Attachment] = {}
        self.metadata: dict[str, dict[str, str]] = {}
        self.schemas: dict[int, Schema] = {}
        self.channels: dict[int, Channel] = {}
        # Whether the file has no damage, and its end; or at least its messages have theirs. Known after the last one.
        self.complete = self.ended = False
        # Places that had to be skipped so far.
        self.damaged = 0
        self._end_ns = self._lost_ns = self._tail_ns = 0
        self._bridged = 0  # damaged places whose cost in log time is known
        self._kept = self._claimed = self._declarations = 0
        self.begins: list[int] = []  # of chunks
        self._names: dict[int, str] = {}
        self._by_topic: dict[str, Channel] = {}
        self._declared: dict[tuple[int, bytes], bytes] = {}
        self._codecs: dict[str, Codec] = {}
        try:
            with path.open("rb") as file:
                self._data = mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ)
        except (OSError, ValueError) as error:
            reason = "it is empty" if isinstance(error, ValueError) else getattr(error, "strerror", error)
            raise LogError(f"{path}: cannot be read: {reason}") from None
        if self._data[:8] != MAGIC:
            raise LogError(f"{path}: is no MCAP file")
        self._at = 8
        self._scanning = self._scan()
        # Everything before the first chunk is known from here on: attachments, facts, channels.
        self._first = next(self._scanning, None)

    @property
    def lost_ns(self) -> int:
        """Log time `messages` found missing so far: between intact chunks, and of a last one as its header tells."""
        return self._lost_ns + self._tail_ns

    @property
    def facts(self) -> dict[str, str]:
        """What armctl says of its own file, preferably where a checksum confirms it; empty for others' files."""
        facts = self.seed().get("armctl", self.metadata.get("armctl"))
        return {str(key): str(value) for key, value in facts.items()} if isinstance(facts, dict) else {}

    def seed(self) -> dict[str, Any]:
        """The seed attachment (see writer.py); empty for others' files."""
        attachment, seed = self.attachments.get(SEED), None
        if attachment is not None and len(attachment.data) <= MAX_SEED_BYTES:
            with suppress(ValueError, RecursionError):
                seed = json.loads(attachment.data)
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
        """Messages in file order, of some topics or all; once.

        Raises:
            LogError: the file claims to inflate to more than is ever read (rule 4).
        """
        for block in self._blocks():
            for message in block:
                if topics is None or message[0] in topics:
                    yield tuple.__new__(LogMessage, message)  # half the time of a call

    def payloads(self, topics: Collection[str] | None = None) -> dict[str, Payloads]:
        """The same messages by topic, some MiB of them at once; of the topics that are named also those without any."""
        parts: dict[str, list[Payloads]] = {topic: [] for topic in topics or ()}
        base = 0
        for block in self._blocks():
            for topic, payloads in block.payloads(topics, base):
                parts.setdefault(topic, []).append(payloads)
            base += len(block.data)
        return {topic: Payloads.joined(pieces) for topic, pieces in parts.items()}

    def tables(self, topic: str, payloads: Payloads) -> tuple[Table, ...]:
        """Messages of one topic as columns, a table for each shape they come in (see columns.py).

        Raises:
            LogError: they do not fit the topic's schema, or it is none armctl reads.
        """
        with self._schema(topic) as (name, text):
            return columns.tables(short_name(name), parse_schema(name, text), payloads)

    def codec(self, topic: str) -> Codec:
        """The codec of a topic as this file declares it.

        Raises:
            LogError: no such topic, or its encoding is not CDR with a ros2msg schema.
        """
        if topic not in self._codecs:
            with self._schema(topic) as (name, text):
                self._codecs[topic] = schema_codec(name, text)
        return self._codecs[topic]

    def decode(self, message: LogMessage) -> Value:
        """What a message says.

        Raises:
            LogError: as `codec`, or it does not fit its schema.
        """
        return self.codec(message.topic).decode(message.data)

    @contextmanager
    def as_written(self, topic: str) -> Iterator[None]:
        """Turn the errors of reading armctl's own messages into one: a file from elsewhere may have anything in them.

        Raises:
            LogError: a message of this topic has.
        """
        try:
            yield
        except (TypeError, ValueError, AttributeError, LookupError, ArithmeticError) as error:
            raise LogError(f"{self.path}: {topic} is not as armctl writes it: {error!r}") from None

    @contextmanager
    def _schema(self, topic: str) -> Iterator[tuple[str, str]]:
        """Full name and text of a topic's schema; what goes wrong with them becomes a LogError."""
        if (channel := self._by_topic.get(topic)) is None:
            raise LogError(f"{self.path}: no topic {topic}; known: {', '.join(sorted(self.topics)) or 'none'}")
        schema = self.schemas.get(channel.schema_id)
        if channel.message_encoding != "cdr" or schema is None or schema.encoding != "ros2msg":
            raise LogError(f"{self.path}: topic {topic} is not CDR with a ros2msg schema")
        try:
            yield schema.name, schema.data.decode()
        except (UnicodeDecodeError, RecursionError) as error:
            raise LogError(f"{self.path}: schema {schema.name} is damaged: {error}") from None

    @property
    def declarations(self) -> dict[str, bytes]:
        """The text of every topic's schema, as far as they are known."""
        declared = [(channel.topic, self.schemas.get(channel.schema_id)) for channel in self.channels.values()]
        return {topic: schema.data for topic, schema in declared if schema is not None}

    @property
    def topics(self) -> frozenset[str]:
        return frozenset(self._by_topic)

    def __exit__(self, *_: object) -> None:
        self._scanning.close()
        self._data.close()

    def _blocks(self) -> Iterator[Block]:
        """The messages of all chunks, some MiB together."""
        pieces, begins, size = list[bytes](), list[int](), 0
        for chunk in chain([self._first or b""], self._scanning, [b""]):
            self._take_chunk(chunk, size, begins)
            pieces.append(chunk)
            size += len(chunk)
            if size >= BLOCK_BYTES or chunk is self._first or not chunk:  # what the first one declares the others hold
                block = Block(b"".join(pieces), begins, self._names)
                self.damaged += block.unknown
                yield block
                pieces, begins, size = [], [], 0

    def _scan(self) -> Generator[bytes, None, None]:
        """Inflated chunks with a good checksum; everything else is taken note of on the way."""
        data, size, unpack = self._data, len(self._data), RECORD.unpack_from
        while self._at + RECORD.size <= size:
            opcode, length = unpack(data, self._at)
            begin = self._at + RECORD.size
            if opcode == _DATA_END and length == 4:
                self.ended = True
                self.complete = self.damaged == 0 and chunks.ends_well(data, self.begins)
                break
            try:
                if not 0 < opcode < _DATA_END or length > min(MAX_RECORD_BYTES, size - begin):
                    raise LogError("no record, or one that was cut")
                if opcode == _CHUNK:
                    self._claim(begin)
                chunk = self._record(opcode, data[begin : begin + length])
            except _Refused:
                raise
            except Exception:  # the packages that parse and inflate share no type of error
                self._skip_damage(opcode, begin, length)
                continue
            self._at = begin + length
            if chunk is not None:
                begin_ns, end_ns = CHUNK.unpack_from(data, begin)[:2]
                if self.damaged > self._bridged and self._end_ns:
                    self._lost_ns += max(0, begin_ns - self._end_ns)
                self._end_ns, self._tail_ns, self._bridged = end_ns, 0, self.damaged
                if self._progress is not None:
                    self._progress(self._at / size)
                yield chunk
        self._at = size

    def _claim(self, begin: int) -> None:
        """Count what a chunk claims to inflate to, before it is."""
        claim = CHUNK.unpack_from(self._data, begin)[2]
        self._claimed += claim if claim <= MAX_CHUNK_BYTES else 0
        bound = FREE_BYTES + MAX_RATIO * len(self._data)
        if self._claimed > bound:
            claims = f"{len(self._data)} bytes that inflate to over {bound}"
            raise _Refused(f"{self.path}: {claims}; such a file is not read")

    def _record(self, opcode: int, body: bytes) -> bytes | None:
        """Take note of one record; the inflated data if it is a chunk."""
        if opcode == _CHUNK:
            self.begins.append(self._at)  # and if it cannot be inflated the file is damaged anyway
            return chunks.inflate(memoryview(body))
        if opcode == Opcode.MESSAGE:
            raise LogError("a message outside a chunk has no checksum")
        if opcode == _MESSAGE_INDEX and int.from_bytes(body[2:6], "little") != len(body) - 6:
            raise LogError("an index of another length")
        if opcode in _KINDS:
            self._kept += len(body)
            # Attachments of gigabytes are not armctl's, and would fill the memory.
            if self._kept <= MAX_CHUNK_BYTES:
                self._take(opcode, body)
        return None

    def _take(self, opcode: int, body: bytes, *, in_chunk: bool = False) -> None:
        """Take note of a record that is no message. A chunk's checksum confirms what is in it."""
        record = _KINDS[opcode].read(stream := ReadDataStream(io.BytesIO(body)))
        if isinstance(record, Attachment):
            (crc,) = struct.unpack_from("<I", body, len(body) - 4)
            if crc not in (0, zlib.crc32(body[:-4])):
                raise LogError("the attachment's checksum does not hold")
            self.attachments[record.name] = record
            if record.name == SEED:
                self._take_seed()
        elif isinstance(record, Metadata):
            self.metadata[record.name] = record.metadata
        elif isinstance(record, Schema) and (in_chunk or record.id not in self.schemas):
            self.schemas[record.id] = record
        elif isinstance(record, Channel) and (in_chunk or record.id not in self.channels):
            self._declare(record)
        if stream.count != len(body) and not in_chunk:
            raise LogError("a record of another length")

    def _take_seed(self) -> None:
        seed = self.seed()
        for entry in seed["schemas"]:
            number, name = int(entry["id"]), str(entry["name"])
            self.schemas[number] = Schema(number, str(entry["text"]).encode(), "ros2msg", name)
        for entry in seed["channels"]:
            metadata = {str(key): str(value) for key, value in entry["metadata"].items()}
            number, topic = int(entry["id"]), str(entry["topic"])
            self._declare(Channel(number, topic, "cdr", metadata, int(entry["schema"])))

    def _declare(self, channel: Channel) -> None:
        self.channels[channel.id], self._names[channel.id] = channel, channel.topic
        if self._by_topic.setdefault(channel.topic, channel).id == channel.id:
            self._by_topic[channel.topic] = channel

    def _skip_damage(self, opcode: int, begin: int, length: int) -> None:
        """Go on behind an attachment if records follow it, else at the next place that looks like a chunk."""
        self.damaged += 1
        data = self._data
        if opcode == Opcode.ATTACHMENT and chunks.is_record(data, begin + length, 2):
            self._at = begin + length
            return
        if opcode == _CHUNK and begin + CHUNK.size <= len(data):
            begin_ns, end_ns, _, _, _ = CHUNK.unpack_from(data, begin)
            begin_ns = self._end_ns or begin_ns
            self._tail_ns = end_ns - begin_ns if 0 < end_ns - begin_ns < MAX_CHUNK_NS else 0
        self._at = chunks.next_chunk(data, self._at)

    def _take_chunk(self, chunk: bytes, base: int, begins: list[int]) -> None:
        """Add where the messages of a chunk begin, the chunk itself at `base`; take note of what else stands in it."""
        at, size, unpack = 0, len(chunk), RECORD.unpack_from
        while at < size:
            opcode, length = unpack(chunk, at) if at + RECORD.size <= size else (0, 0)
            end = at + RECORD.size + length
            if opcode == MESSAGE_OPCODE and at + MESSAGE.size <= end <= size:
                begins.append(base + at)
            elif end > size or not self._chunk_record(opcode, chunk[at + RECORD.size : end]):
                self.damaged += 1
                break  # where the next record begins is not known any more
            at = end

    def _chunk_record(self, opcode: int, body: bytes) -> bool:
        """Take note of a record inside a chunk that is no message; False if it does not belong there."""
        if opcode not in (Opcode.SCHEMA, Opcode.CHANNEL):
            return opcode >= _PRIVATE
        if self._declared.get((opcode, body[:2])) == body:
            return True  # many writers say it again in every chunk
        self._declared[opcode, body[:2]] = body
        self._declarations += 1
        if self._declarations > MAX_DECLARED:
            raise _Refused(f"{self.path}: declares over {MAX_DECLARED} channels and schemas; such a file is not read")
        try:
            self._take(opcode, body, in_chunk=True)
        except Exception:  # as in _scan
            return False
        return True


class _Refused(LogError):
    """The file is not worth reading on."""
