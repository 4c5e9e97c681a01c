"""The container of a log, MCAP with chunks: its bytes, written here and inflated here.

Rules.
1. Messages stand in chunks only, each with a CRC over its inflated records and, behind it, an index a channel.
2. Each chunk goes to the stream in one write, together with its indexes.
3. A chunk is never inflated beyond what it claims, nor beyond `MAX_CHUNK_BYTES`.

The rare records are put into bytes by the mcap package; messages, being thousands a second, are not.
"""

import mmap
import struct
import zlib
from collections.abc import Mapping, Sequence
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap import records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from armctl import __version__
from armctl.errors import LogError

PROFILE = "ros2"
LIBRARY = f"armctl {__version__}"
MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 2**20
MAX_CHUNK_BYTES = 16 * 2**20
# zstd level of a log while it is written: its chunks of a second are no smaller at 3, and take longer.
LEVEL = 1
RECORD = struct.Struct("<BQ")  # opcode, length
FOOTER = struct.Struct("<BQQQI")  # opcode, length, where the summary and its offsets begin, CRC
CHUNK_INDEX = struct.Struct("<BQQQQ")  # opcode, length, start, end, where the chunk begins; and more
CHUNK = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of the compression's name
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
MESSAGE_OPCODE = int(Opcode.MESSAGE)  # comparing enumeration members costs more than all the rest
_ZSTD = b"zstd"
# The groups of records that a file ends with, in their order.
_SUMMARY = {
    "schema": Opcode.SCHEMA, "channel": Opcode.CHANNEL, "statistics": Opcode.STATISTICS, "chunk": Opcode.CHUNK_INDEX,
    "attachment": Opcode.ATTACHMENT_INDEX, "metadata": Opcode.METADATA_INDEX,
}  # fmt: skip


class ChunkWriter:
    """Writes one MCAP file to a stream, from its first byte to its last.

    Args:
        stream: Where to; errors of its `write` come through, and nothing can be written after one.
        level: zstd level.
        chunk_bytes: A chunk is ended when it holds this much, inflated; below `MAX_CHUNK_BYTES`.
    """

    def __init__(self, stream: BinaryIO, *, level: int = LEVEL, chunk_bytes: int = CHUNK_BYTES) -> None:
        self._stream, self._chunk_bytes = stream, chunk_bytes
        self._compress = zstandard.ZstdCompressor(level=level).compress
        # Bytes written so far.
        self.offset = 0
        # As bytes: a log of an hour has 3,600 chunks, and as objects their places would take 5 MB.
        self._summary: dict[str, list[bytes]] = {kind: [] for kind in _SUMMARY}
        self._counts: dict[int, int] = {}
        self._body = bytearray()
        self._entries: dict[int, list[int]] = {}
        self._begin_ns, self._end_ns = 2**64 - 1, 0
        self._write(MAGIC + _bytes(records.Header(PROFILE, LIBRARY)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a new schema."""
        schemas = self._summary["schema"]
        schemas.append(_bytes(records.Schema(id=len(schemas) + 1, data=data, encoding=encoding, name=name)))
        self._body += schemas[-1]
        return len(schemas)

    def add_channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """Number of a new channel."""
        channels = self._summary["channel"]
        number = len(channels) + 1
        channels.append(_bytes(records.Channel(number, topic, encoding, dict(metadata), schema_id)))
        self._entries[number] = []
        self._body += channels[-1]
        return number

    def add_attachment(self, attachment: records.Attachment) -> None:
        """Attach a file; it stands before the chunk in progress."""
        a, record = attachment, _bytes(attachment)
        about = a.log_time, a.create_time, len(a.data), a.name, a.media_type
        self._summary["attachment"].append(_bytes(records.AttachmentIndex(self.offset, len(record), *about)))
        self._write(record)

    def add_metadata(self, name: str, facts: Mapping[str, str]) -> None:
        """Add a metadata record; it stands before the chunk in progress."""
        record = _bytes(records.Metadata(name, dict(facts)))
        self._summary["metadata"].append(_bytes(records.MetadataIndex(self.offset, len(record), name)))
        self._write(record)

    def add_message(self, channel_id: int, time_ns: int, sequence: int, data: bytes) -> None:
        """One message; its log and publish times are the same."""
        body = self._body
        self._entries[channel_id].extend((time_ns, len(body)))
        body += MESSAGE.pack(MESSAGE_OPCODE, len(data) + 22, channel_id, sequence, time_ns, time_ns)
        body += data
        if len(body) > self._chunk_bytes:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk in progress, if a message is in it."""
        entries = {number: entry for number, entry in self._entries.items() if entry}
        if not entries:
            return
        data = self._body
        packed = self._compress(data)
        begin_ns = min(min(entry[::2]) for entry in entries.values())
        end_ns = max(max(entry[::2]) for entry in entries.values())
        head = CHUNK.pack(begin_ns, end_ns, len(data), zlib.crc32(data), len(_ZSTD)) + _ZSTD
        head += struct.pack("<Q", len(packed))
        chunk = RECORD.pack(Opcode.CHUNK, len(head) + len(packed)) + head + packed
        places, indexes = {}, bytearray()
        for number, entry in entries.items():
            size = 8 * len(entry)
            places[number] = self.offset + len(chunk) + len(indexes)
            indexes += struct.pack(f"<BQHI{len(entry)}Q", Opcode.MESSAGE_INDEX, 6 + size, number, size, *entry)
            self._counts[number] = self._counts.get(number, 0) + len(entry) // 2
            self._entries[number] = []
        index = records.ChunkIndex(
            chunk_length=len(chunk),
            chunk_start_offset=self.offset,
            compression="zstd",
            compressed_size=len(packed),
            message_end_time=end_ns,
            message_index_length=len(indexes),
            message_index_offsets=places,
            message_start_time=begin_ns,
            uncompressed_size=len(data),
        )
        self._summary["chunk"].append(_bytes(index))
        self._begin_ns, self._end_ns = min(self._begin_ns, begin_ns), max(self._end_ns, end_ns)
        self._body = bytearray()
        self._write(chunk + indexes)

    def finish(self) -> None:
        """End the file: the summary that lets others seek in it."""
        self.end_chunk()
        self._write(_bytes(records.DataEnd(0)))
        statistics = records.Statistics(
            channel_message_counts=self._counts,
            message_count=sum(self._counts.values()),
            message_end_time=self._end_ns,
            message_start_time=self._begin_ns if self._counts else 0,
            **{f"{kind}_count": len(group) for kind, group in self._summary.items() if kind != "statistics"},
        )
        self._summary["statistics"].append(_bytes(statistics))
        begin, summary, offsets = self.offset, b"", b""
        for kind, group in self._summary.items():
            if data := b"".join(group):
                offsets += _bytes(records.SummaryOffset(_SUMMARY[kind], begin + len(summary), len(data)))
            summary += data
        summary += offsets + _bytes(records.Footer(begin, begin + len(summary), summary_crc=0))[:-4]
        self._write(summary + struct.pack("<I", zlib.crc32(summary)) + MAGIC)

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self.offset += len(data)


def _bytes(record: records.McapRecord) -> bytes:
    builder = RecordBuilder()
    record.write(builder)
    return bytes(builder.end())  # type: ignore[no-untyped-call]


def inflate(body: memoryview) -> bytes:
    """The records inside a chunk.

    Args:
        body: The chunk record without opcode and length.
    Raises:
        LogError: they are larger than allowed or than said, or not what the checksum says.
    """
    _, _, size, crc, name_length = CHUNK.unpack_from(body)
    name_end = CHUNK.size + name_length
    compression = bytes(body[CHUNK.size : min(name_end, CHUNK.size + 8)])
    (length,) = struct.unpack_from("<Q", body, name_end)
    packed = body[name_end + 8 :]
    if size > MAX_CHUNK_BYTES or length != len(packed):
        raise LogError(f"a chunk of {size} bytes; {MAX_CHUNK_BYTES} is the bound")
    if compression == _ZSTD:
        inflater = zstandard.ZstdDecompressor(max_window_size=MAX_CHUNK_BYTES)
        if zstandard.frame_content_size(packed) == size:
            data = inflater.decompress(packed)  # at once: the frame claims what the chunk claims
        else:
            data = inflater.stream_reader(packed).read(size + 1)
    elif compression == b"lz4":
        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size + 1)
    elif compression == b"":
        data = bytes(packed)
    else:
        raise LogError(f"unknown compression {compression!r}")
    if len(data) != size or crc not in (0, zlib.crc32(data)):
        raise LogError("a chunk's checksum does not hold")
    return data


def ends_well(data: mmap.mmap, begins: Sequence[int]) -> bool:
    """Whether a file has its end, with a summary that is as it was written and leads to the chunks that begin there."""
    footer = len(data) - len(MAGIC) - FOOTER.size
    opcode, length, begin, _, crc = FOOTER.unpack_from(data, max(footer, 0)) if footer > 0 else (0,) * 5
    if (opcode, length, data[-len(MAGIC) :]) != (Opcode.FOOTER, 20, MAGIC) or begin > footer:
        return False
    if begin == 0:
        return True  # without a summary others read from the beginning, as we do
    if crc not in (0, zlib.crc32(data[begin : footer + FOOTER.size - 4])):
        return False
    found = []
    while begin < footer:
        opcode, length, _, _, chunk = CHUNK_INDEX.unpack_from(data, begin)
        if opcode == Opcode.CHUNK_INDEX:
            found.append(chunk)
        begin += RECORD.size + length
    return begin == footer and (not found or sorted(found) == [*begins])


def next_chunk(data: mmap.mmap, after: int) -> int:
    """Where the next chunk of ours seems to begin, behind the record at `after`; where the data end if none does."""
    # A zstd chunk's header has the name of its compression in its middle, and two lengths that fit each other.
    name = struct.pack("<I", len(_ZSTD)) + _ZSTD
    at = after
    while (found := data.find(name, at + RECORD.size + CHUNK.size - 3)) >= 0:
        at = found + 4 - CHUNK.size - RECORD.size
        length_at = found + len(name)
        if length_at + 8 <= len(data) and at > after:
            opcode, length = RECORD.unpack_from(data, at)
            (inner,) = struct.unpack_from("<Q", data, length_at)
            if opcode == Opcode.CHUNK and length == CHUNK.size + 4 + 8 + inner:
                return at
    return len(data)


def is_record(data: mmap.mmap, at: int, following: int) -> bool:
    """Whether a record may stand there, and so many more behind it."""
    if at + RECORD.size > len(data):
        return False
    opcode, length = RECORD.unpack_from(data, at)
    behind = at + RECORD.size + length
    fits = 0 < opcode <= Opcode.DATA_END and behind <= len(data)
    return fits and (following == 0 or is_record(data, behind, following - 1))
