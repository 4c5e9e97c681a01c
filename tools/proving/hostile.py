"""MCAP files that mean harm: small, and asking for gigabytes, for hours, or for what is not there.

Each is to be refused, or read as far as it is true, in under 100 ms and 256 MiB. `read_all` does with a file whatever
armctl does with any.
"""

import io
import json
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path

import zstandard
from mcap.records import Attachment

from armctl.errors import LogError
from armctl.recording import reader, recordings, timeline
from armctl.recording.cdr import HEADER
from armctl.recording.chunks import CHUNK, MAGIC, MAX_CHUNK_BYTES, RECORD, ChunkWriter
from armctl.recording.writer import SEED

SIZE = 65_000
# In which `read_all` reads a file.
WAYS = 5
CHUNK_OPCODE, ATTACHMENT_OPCODE, HEADER_OPCODE, MESSAGE_OPCODE = 6, 9, 1, 5
_END = RECORD.pack(15, 4) + bytes(4)


def read_all(path: Path) -> int:
    """The messages of a file, read in every way there is; 0 if it is refused."""
    count = 0
    with suppress(LogError):
        count = reader.info(path).messages
    readings: tuple[Callable[[], object], ...] = (
        lambda: reader.read_columns(path),
        lambda: timeline.load(path),
        lambda: recordings.load(path),
        lambda: sum(1 for _ in reader.read(path)),
    )
    for reading in readings:
        with suppress(LogError):
            reading()
    return count


def files() -> Iterator[tuple[str, bytes]]:
    """Name and content of every hostile file."""
    zeros = _packed(MAX_CHUNK_BYTES)
    yield "a chunk that claims a terabyte", _file(_chunk(b"x" * 100, 2**40))
    yield "a chunk that claims 16 MiB and yields a gigabyte", _file(_chunk(_packed(2**30), MAX_CHUNK_BYTES))
    yield "a chunk that claims 1000 bytes and yields a gigabyte", _file(_chunk(_packed(2**30), 1000))
    claims = struct.pack("<IBQ", 0xFD2FB528, 0xE0, 2**40) + bytes(100)  # a zstd frame that says so itself
    yield "a zstd frame that claims a terabyte", _file(_chunk(claims, MAX_CHUNK_BYTES))
    yield "a zstd frame that wants a window of gigabytes", _file(_chunk(b"\x28\xb5\x2f\xfd\x00\xa8" + bytes(100), 1000))
    yield "many chunks of 16 MiB", _file(_chunk(zeros, MAX_CHUNK_BYTES) * (SIZE // len(zeros)))
    records = RECORD.pack(HEADER_OPCODE, 0) * (2**20)
    yield "a million records of nothing", _file(_chunk(zstandard.compress(records), len(records), zlib.crc32(records)))
    yield "lengths beyond the file", MAGIC + RECORD.pack(CHUNK_OPCODE, 2**63) + bytes(SIZE)
    name = CHUNK.pack(0, 1, 10, 0, 2**32 - 1)
    yield "a name of gigabytes", _file(RECORD.pack(CHUNK_OPCODE, len(name) + 60) + name + bytes(60))
    overlapping = RECORD.pack(CHUNK_OPCODE, 60) + CHUNK.pack(0, 1, MAX_CHUNK_BYTES, 0, 4) + b"zstd"
    yield "chunks inside chunks", MAGIC + overlapping * (SIZE // len(overlapping))
    yield "records inside records", MAGIC + RECORD.pack(ATTACHMENT_OPCODE, RECORD.size) * (SIZE // RECORD.size)
    yield "a deep seed", _seeded(b"[" * SIZE)
    yield "a seed of wrong types", _seeded(json.dumps({"schemas": [{"id": []}], "channels": 7, "armctl": [1]}).encode())
    yield "types 1000 deep", _schema(_types(1000, 1), HEADER + b"\1")
    yield "types that double 16 times", _schema(_types(16, 2), HEADER + bytes(SIZE))
    yield "types that double 40 times, in sequences", _schema(_types(40, 2, "[]"), HEADER + bytes(SIZE))
    yield "a type that contains itself", _schema("pkg/T0 a\npkg/T0[] b", HEADER + bytes(SIZE))
    yield (
        "a type of 5000 fields in one of 1000",
        _schema(
            "\n".join(f"pkg/T1 a{i}" for i in range(1000))
            + _section("T1", "\n".join(f"uint8 a{i}" for i in range(5000))),
            HEADER + bytes(100),
        ),
    )
    yield "sequences of billions", _schema("float64[] a\nstring[] b\nuint8[] c", HEADER + b"\xff" * 100)
    yield "texts of billions", _schema("string a\nstring b", HEADER + b"\xff" * 100)


def _packed(size: int) -> bytes:
    """So many zeros, packed; their size is not in the frame."""
    stream, packer = io.BytesIO(), zstandard.ZstdCompressor(level=1, write_content_size=False).compressobj()
    for _ in range(size // 2**20):
        stream.write(packer.compress(bytes(2**20)))
    return stream.getvalue() + packer.flush()


def _chunk(packed: bytes, size: int, crc: int = 0) -> bytes:
    head = CHUNK.pack(0, 1, size, crc, 4) + b"zstd" + struct.pack("<Q", len(packed))
    return RECORD.pack(CHUNK_OPCODE, len(head) + len(packed)) + head + packed


def _file(records: bytes) -> bytes:
    return MAGIC + records + _END + MAGIC


def _seeded(seed: bytes) -> bytes:
    stream = io.BytesIO()
    writer = ChunkWriter(stream)
    writer.add_attachment(Attachment(0, 0, SEED, "application/json", seed))
    writer.finish()
    return stream.getvalue()


def _schema(text: str, data: bytes) -> bytes:
    """A log with one message of a type T0."""
    stream = io.BytesIO()
    writer = ChunkWriter(stream)
    for topic in ("/joint_states", "/rosout"):
        channel = writer.add_channel(topic, "cdr", writer.add_schema("pkg/msg/T0", "ros2msg", text.encode()), {})
        writer.add_message(channel, 1, 1, data)
    writer.finish()
    return stream.getvalue()


def _types(depth: int, width: int, brackets: str = "") -> str:
    fields = ["\n".join(f"pkg/T{level + 1}{brackets} a{i}" for i in range(width)) for level in range(depth)]
    sections = (_section(f"T{level}", text) for level, text in enumerate([*fields[1:], "uint8 a"], start=1))
    return fields[0] + "".join(sections)


def _section(name: str, text: str) -> str:
    return f"\n{'=' * 80}\nMSG: pkg/{name}\n{text}\n"
