"""Files made to do harm are refused, and quickly."""

import io
import struct
import sys
import time
from pathlib import Path

import pytest
from mcap.writer import Writer

from armctl.recording import reader
from armctl.recording.chunks import MAGIC, ChunkWriter
from proving import hostile
from tests.recording.programs import told_by
from tests.recording.refusals import cannot

FILES = dict(hostile.files())
MIB = 2**20
# A file that claims to inflate to more than is ever read.
REFUSED = "many chunks of 16 MiB"

_PEAK = """
import resource, sys
from pathlib import Path
from proving.hostile import read_all
resource.setrlimit(resource.RLIMIT_CPU, (60, 60))
for name in sys.argv[1:]:
    read_all(Path(name))
status = Path("/proc/self/status").read_text()  # getrusage would tell of the process this one was forked from
print(status.split("VmHWM:")[1].split()[0])
"""


@pytest.mark.parametrize("name", FILES)
def test_a_hostile_file_yields_no_message_that_is_not_in_it_and_no_error_but_one(tmp_path: Path, name: str) -> None:
    path = tmp_path / "a.mcap"
    path.write_bytes(FILES[name])
    in_it = 2 if FILES[name].startswith(MAGIC) and b"pkg/msg/T0" in FILES[name] else 0
    assert hostile.read_all(path) in (0, in_it)
    if name == REFUSED:
        cannot(reader.info, path, why="such a file is not read")
        return
    info = reader.info(path)
    assert (info.messages, info.complete) == (in_it, in_it > 0)
    if in_it:
        cannot(list, reader.read(path))


def test_all_of_them_together_take_less_than_256_mib(tmp_path: Path) -> None:
    for index, data in enumerate(FILES.values()):
        (tmp_path / f"{index}.mcap").write_bytes(data)
    peak_kib = told_by(sys.executable, "-c", _PEAK, *tmp_path.iterdir(), folder=Path(hostile.__file__).parents[1])
    assert int(peak_kib) * 1024 < 256 * MIB


@pytest.mark.parametrize("body", [b"\x05" + bytes(8), b"\x04" + struct.pack("<Q", 2) + b"ab", b"\x0e" + bytes(8)])
def test_nonsense_inside_a_chunk_is_damage(tmp_path: Path, body: bytes) -> None:
    chunk = struct.pack("<QQQII", 0, 1, len(body), 0, 0) + struct.pack("<Q", len(body)) + body
    end = struct.pack("<BQI", 15, 4, 0) + MAGIC
    path = tmp_path / "a.mcap"
    path.write_bytes(MAGIC + struct.pack("<BQ", 6, len(chunk)) + chunk + end)
    assert (reader.info(path).messages, reader.info(path).complete) == (0, False)


def declaring(channels: int, chunks: int = 1) -> bytes:
    """A small file with so many channels, declared between two messages, and more chunks of one message each."""
    stream = io.BytesIO()
    writer = ChunkWriter(stream)
    schema = writer.add_schema("pkg/msg/T0", "ros2msg", b"uint8 a")
    for number in range(channels):
        channel = writer.add_channel(f"/{number}", "cdr", schema, {})
        writer.add_message(channel, 1, 1, b"\0\1\0\0\7")
    for _ in range(chunks):
        writer.end_chunk()
        writer.add_message(1, 1, 1, b"\0\1\0\0\7")
    writer.finish()
    return stream.getvalue()


def read_s(path: Path, data: bytes) -> float:
    """Least CPU time of three times reading a file in every way: what else the machine does makes it longer."""
    path.write_bytes(data)
    took_s = []
    for _ in range(3):
        begun_s = time.process_time()
        hostile.read_all(path)
        took_s.append(time.process_time() - begun_s)
    return min(took_s)


def test_time_is_in_proportion_to_what_is_declared(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    few, many = read_s(path, declaring(500)), read_s(path, declaring(4000))
    assert many < 25 * few, "with eight times as much"
    few, many = read_s(path, declaring(1000, 50)), read_s(path, declaring(1000, 800))
    assert many < 25 * few, "with the same, and sixteen times as many chunks"


def test_a_file_of_more_channels_than_anybody_has_is_refused(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_bytes(declaring(20_000))
    cannot(reader.info, tmp_path / "a.mcap", why="declares over 10000 channels")


def test_channels_that_are_said_again_in_every_chunk_are_no_more_than_one(tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream:
        writer = Writer(stream, chunk_size=1)
        writer.start("ros2", "somebody")
        schema = writer.register_schema("pkg/msg/T0", "ros2msg", b"uint8 a")
        channel = writer.register_channel("/a", "cdr", schema)
        for number in range(12_000):
            writer.add_message(channel, number, b"\0\1\0\0\7", number)
        writer.finish()  # type: ignore[no-untyped-call]
    assert (reader.info(tmp_path / "a.mcap").messages, reader.info(tmp_path / "a.mcap").complete) == (12_000, True)
