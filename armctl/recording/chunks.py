"""The container of a log, MCAP with chunks: its bytes, written here and inflated here.

Rules.
1. Messages stand in chunks only, each with a CRC over its inflated records and, behind it, an index a channel.
2. Each chunk goes to the stream in one write, together with its indexes.
3. A chunk is never inflated beyond what it claims, nor beyond `MAX_CHUNK_BYTES`.

The rare records are put into bytes by the mcap package; messages, being thousands a second, are not.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Mapping
from typing import BinaryIO

import lz4.frame  # type: ignore[import-untyped]
import zstandard
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode
from mcap.records import (
    Attachment,
    AttachmentIndex,
    Channel,
    ChunkIndex,
    DataEnd,
    Footer,
    Header,
    McapRecord,
    Metadata,
    MetadataIndex,
    Schema,
    Statistics,
    SummaryOffset,
)

from armctl.errors import LogError

MAGIC = b"\x89MCAP0\r\n"
CHUNK_BYTES = 2**20
MAX_CHUNK_BYTES = 16 * 2**20
LEVEL = 1
"""zstd level of a log while it is written: its chunks of a second are no smaller at 3, and take longer."""
RECORD = struct.Struct("<BQ")  # opcode, length
CHUNK = struct.Struct("<QQQII")  # start, end, inflated size, CRC, length of the compression's name
MESSAGE = struct.Struct("<BQHIQQ")  # opcode, length, channel, sequence, log time, publish time
MESSAGE_OPCODE = int(Opcode.MESSAGE)  # comparing enumeration members costs more than all the rest
_ZSTD = b"zstd"


class ChunkWriter:
    """Writes one MCAP file to a stream, from its first byte to its last.

    Args:
        stream: Where to; errors of its `write` come through, and nothing can be written after one.
        level: zstd level.
        chunk_bytes: A chunk is ended when it holds this much, inflated; below `MAX_CHUNK_BYTES`.
    """

    def __init__(
        self, stream: BinaryIO, profile: str, library: str, *, level: int = LEVEL, chunk_bytes: int = CHUNK_BYTES
    ) -> None:
        self._stream, self._chunk_bytes = stream, chunk_bytes
        self._pack = MESSAGE.pack
        self._compress = zstandard.ZstdCompressor(level=level).compress
        self.offset = 0
        """Bytes written so far."""
        self._schemas: list[Schema] = []
        self._channels: list[Channel] = []
        self._chunks: list[ChunkIndex] = []
        self._attachments: list[AttachmentIndex] = []
        self._metadata: list[MetadataIndex] = []
        self._counts: dict[int, int] = {}
        self._body = bytearray()
        self._entries: dict[int, list[int]] = {}
        self._begin_ns, self._end_ns = 2**64 - 1, 0
        self._write(MAGIC + _bytes(Header(profile, library)))

    def add_schema(self, name: str, encoding: str, data: bytes) -> int:
        """Number of a new schema."""
        schema = Schema(id=len(self._schemas) + 1, data=data, encoding=encoding, name=name)
        self._schemas.append(schema)
        self._body += _bytes(schema)
        return schema.id

    def add_channel(self, topic: str, encoding: str, schema_id: int, metadata: Mapping[str, str]) -> int:
        """Number of a new channel."""
        channel = Channel(
            id=len(self._channels) + 1,
            topic=topic,
            message_encoding=encoding,
            metadata=dict(metadata),
            schema_id=schema_id,
        )
        self._channels.append(channel)
        self._entries[channel.id] = []
        self._body += _bytes(channel)
        return channel.id

    def add_attachment(self, time_ns: int, name: str, media_type: str, data: bytes) -> None:
        """Attach a file; it stands before the chunk in progress."""
        record = _bytes(Attachment(create_time=time_ns, log_time=time_ns, name=name, media_type=media_type, data=data))
        self._attachments.append(
            AttachmentIndex(
                offset=self.offset,
                length=len(record),
                create_time=time_ns,
                log_time=time_ns,
                data_size=len(data),
                name=name,
                media_type=media_type,
            )
        )
        self._write(record)

    def add_metadata(self, name: str, facts: Mapping[str, str]) -> None:
        """Add a metadata record; it stands before the chunk in progress."""
        record = _bytes(Metadata(name, dict(facts)))
        self._metadata.append(MetadataIndex(offset=self.offset, length=len(record), name=name))
        self._write(record)

    def add_message(self, channel_id: int, time_ns: int, sequence: int, data: bytes) -> None:
        """One message; its log and publish times are the same."""
        body = self._body
        self._entries[channel_id].extend((time_ns, len(body)))
        body += self._pack(MESSAGE_OPCODE, len(data) + 22, channel_id, sequence, time_ns, time_ns)
        body += data
        if len(body) > self._chunk_bytes:
            self.end_chunk()

    def end_chunk(self) -> None:
        """Write the chunk in progress, if a message is in it."""
        entries = {number: list_ for number, list_ in self._entries.items() if list_}
        if not entries:
            return
        data = self._body
        packed = self._compress(data)
        begin_ns = min(min(entry[::2]) for entry in entries.values())
        end_ns = max(max(entry[::2]) for entry in entries.values())
        head = CHUNK.pack(begin_ns, end_ns, len(data), zlib.crc32(data), len(_ZSTD)) + _ZSTD
        head += struct.pack("<Q", len(packed))
        chunk = RECORD.pack(Opcode.CHUNK, len(head) + len(packed)) + head + packed
        places, indexes, at = {}, [], self.offset + len(chunk)
        for number, entry in entries.items():
            index = struct.pack(
                f"<BQHI{len(entry)}Q", Opcode.MESSAGE_INDEX, 6 + 8 * len(entry), number, 8 * len(entry), *entry
            )
            places[number] = at
            indexes.append(index)
            at += len(index)
            self._counts[number] = self._counts.get(number, 0) + len(entry) // 2
            self._entries[number] = []
        self._chunks.append(
            ChunkIndex(
                chunk_length=len(chunk),
                chunk_start_offset=self.offset,
                compression="zstd",
                compressed_size=len(packed),
                message_end_time=end_ns,
                message_index_length=at - self.offset - len(chunk),
                message_index_offsets=places,
                message_start_time=begin_ns,
                uncompressed_size=len(data),
            )
        )
        self._begin_ns, self._end_ns = min(self._begin_ns, begin_ns), max(self._end_ns, end_ns)
        self._body = bytearray()
        self._write(chunk + b"".join(indexes))

    def finish(self) -> None:
        """End the file: the summary that lets others seek in it."""
        self.end_chunk()
        self._write(_bytes(DataEnd(0)))
        statistics = Statistics(
            attachment_count=len(self._attachments),
            channel_count=len(self._channels),
            channel_message_counts=self._counts,
            chunk_count=len(self._chunks),
            message_count=sum(self._counts.values()),
            message_end_time=self._end_ns,
            message_start_time=self._begin_ns if self._chunks else 0,
            metadata_count=len(self._metadata),
            schema_count=len(self._schemas),
        )
        groups: tuple[tuple[Opcode, list[McapRecord]], ...] = (
            (Opcode.SCHEMA, [*self._schemas]),
            (Opcode.CHANNEL, [*self._channels]),
            (Opcode.STATISTICS, [statistics]),
            (Opcode.CHUNK_INDEX, [*self._chunks]),
            (Opcode.ATTACHMENT_INDEX, [*self._attachments]),
            (Opcode.METADATA_INDEX, [*self._metadata]),
        )
        begin, summary, offsets = self.offset, b"", b""
        for opcode, records in groups:
            group = b"".join(map(_bytes, records))
            if group:
                offsets += _bytes(
                    SummaryOffset(group_opcode=opcode, group_start=begin + len(summary), group_length=len(group))
                )
            summary += group
        footer = _bytes(Footer(summary_start=begin, summary_offset_start=begin + len(summary), summary_crc=0))[:-4]
        summary += offsets + footer
        self._write(summary + struct.pack("<I", zlib.crc32(summary)) + MAGIC)

    def _write(self, data: bytes) -> None:
        self._stream.write(data)
        self.offset += len(data)


def _bytes(record: McapRecord) -> bytes:
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
