"""The container: what is written is what the mcap package reads, and no chunk is inflated beyond its claim."""

import io
import random
import struct
import tracemalloc
import zlib
from pathlib import Path

import lz4.frame  # type: ignore[import-untyped]
import pytest
import zstandard
from mcap.reader import make_reader
from mcap.records import Attachment

from armctl.recording import chunks
from armctl.recording.chunks import CHUNK, CHUNK_BYTES, MAX_CHUNK_BYTES, ChunkWriter, inflate
from armctl.recording.log_file import LogFile
from tests.recording.refusals import cannot


def test_the_mcap_package_reads_what_was_written_and_seeks_in_it(tmp_path: Path) -> None:
    rng, path = random.Random(1), tmp_path / "a.mcap"
    written = []
    with path.open("wb") as stream:
        writer = ChunkWriter(stream)
        schema = writer.add_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
        numbers = [writer.add_channel(f"/c{i}", "cdr", schema, {"key": str(i)}) for i in range(3)]
        writer.add_attachment(Attachment(7, 7, "a.txt", "text/plain", b"attached"))
        writer.add_metadata("facts", {"a": "b"})
        for index in range(4000):
            number, data = rng.choice(numbers), rng.randbytes(rng.randrange(1200))
            writer.add_message(number, 10**9 + index * 1000 + rng.randrange(900), index, data)
            written.append((f"/c{number - 1}", index, data))
            if rng.random() < 0.01:
                writer.end_chunk()
                writer.end_chunk()
        writer.finish()
        assert writer.offset == path.stat().st_size == stream.tell()
    with path.open("rb") as stream:
        stock = make_reader(stream, validate_crcs=True)
        summary = stock.get_summary()
        assert summary is not None
        assert summary.statistics is not None
        assert (summary.statistics.message_count, summary.statistics.channel_count) == (4000, 3)
        assert summary.statistics.chunk_count == len(summary.chunk_indexes) > 5
        assert max(index.uncompressed_size for index in summary.chunk_indexes) < CHUNK_BYTES + 1300
        found = [(c.topic, m.sequence, m.data) for _, c, m in stock.iter_messages(log_time_order=False)]
        some = [
            m.sequence for _, _, m in stock.iter_messages(starting_at=10**9 + 500_000, ending_before=10**9 + 600_000)
        ]
        assert [(a.name, a.data) for a in stock.iter_attachments()] == [("a.txt", b"attached")]
        assert [(m.name, m.metadata) for m in stock.iter_metadata()] == [("facts", {"a": "b"})]
    assert found == written
    assert some == list(range(500, 600))
    with LogFile(path) as log:
        assert [(m.topic, m.sequence, m.data) for m in log.messages()] == written
        assert log.complete


def test_an_open_file_keeps_little_of_each_chunk() -> None:
    class Nowhere(io.BytesIO):
        def write(self, data: object) -> int:
            return 0

    writer = ChunkWriter(Nowhere())
    schema = writer.add_schema("std_msgs/msg/String", "ros2msg", b"string data\n")
    numbers = [writer.add_channel(f"/c{i}", "cdr", schema, {}) for i in range(12)]

    def chunked(count: int) -> int:
        """What is kept of so many chunks [bytes]."""
        begin = tracemalloc.get_traced_memory()[0]
        for index in range(count):
            for number in numbers:
                writer.add_message(number, index, index, b"data")
            writer.end_chunk()
        return tracemalloc.get_traced_memory()[0] - begin

    tracemalloc.start()
    try:
        chunked(20)
        assert chunked(400) < 400 * 500
    finally:
        tracemalloc.stop()


def test_a_file_without_messages_is_a_file() -> None:
    stream = io.BytesIO()
    ChunkWriter(stream).finish()
    stream.seek(0)
    assert list(make_reader(stream, validate_crcs=True).iter_messages()) == []


def body(data: bytes, packed: bytes, name: bytes, size: int | None = None, crc: int | None = None) -> memoryview:
    size, crc = len(data) if size is None else size, zlib.crc32(data) if crc is None else crc
    return memoryview(CHUNK.pack(0, 1, size, crc, len(name)) + name + struct.pack("<Q", len(packed)) + packed)


DATA = bytes(range(256)) * 40


@pytest.mark.parametrize(
    ("name", "packed"),
    [
        (b"", DATA),
        (b"lz4", lz4.frame.compress(DATA)),
        (b"zstd", zstandard.compress(DATA)),
        (b"zstd", zstandard.ZstdCompressor(write_content_size=False).compress(DATA)),
    ],
)
def test_a_chunk_inflates_to_what_it_claims_and_to_nothing_else(name: bytes, packed: bytes) -> None:
    assert inflate(body(DATA, packed, name)) == DATA
    for size, crc in ((len(DATA) - 1, None), (len(DATA) + 1, None), (2**40, None), (None, 1)):
        cannot(inflate, body(DATA, packed, name, size, crc))


def test_what_a_chunk_yields_beyond_its_claim_is_never_inflated() -> None:
    bomb = zstandard.ZstdCompressor(level=1, write_content_size=False).compress(bytes(MAX_CHUNK_BYTES * 8))
    assert len(bomb) < 2**16
    cannot(inflate, body(b"", bomb, b"zstd", size=1000), why="checksum")
    cannot(inflate, body(DATA, DATA, b"brotli"), why="unknown compression")
    cannot(inflate, body(DATA, bomb, b"zstd", size=chunks.MAX_CHUNK_BYTES + 1), why="is the bound")
