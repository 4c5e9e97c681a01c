"""Cut anywhere, with bits flipped anywhere: nothing but true values, and nothing lost that is intact."""

from __future__ import annotations

import random
from pathlib import Path

import pytest

from armctl.clock import NS_PER_S
from armctl.recording.chunks import CHUNK, RECORD
from armctl.recording.compact import compact
from armctl.recording.reader import LogFile, LogMessage, info
from armctl.recording.recover import RECOVERED, recover
from armctl.recording.writer import LogWriter
from proving import damage
from proving.damage import UnsyncedDisk, chunk_places
from tests.recording.factory import ANCHOR, CONTEXT, make_records

RECORDS = make_records(300, keyframe_ticks=100)
DISK = UnsyncedDisk()
FLUSH_TICKS = 9


def messages(path: Path) -> list[LogMessage]:
    with LogFile(path) as log:
        return list(log.messages())


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Half a minute, flushed as the recorder does, and then cut off by a power cut."""
    writer = LogWriter(tmp_path_factory.mktemp("part") / "a.mcap", CONTEXT, anchor=ANCHOR, disk=DISK)
    for record in RECORDS:
        writer.write_tick(record)
        if record.inputs.tick % FLUSH_TICKS == FLUSH_TICKS - 1:
            writer.flush()
    data = writer.part.read_bytes()
    writer.abandon()
    return data


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, part: bytes) -> list[LogMessage]:
    path = tmp_path_factory.mktemp("whole") / "a.mcap.part"
    path.write_bytes(part)
    return messages(path)


def test_a_cut_loses_the_chunk_it_hits_and_nothing_else(tmp_path: Path, part: bytes) -> None:
    """The short form: the edges of every chunk of the last 64 KiB, and every 250th byte."""
    last = range(len(part) - 2**16, len(part) + 1)
    edges = [
        cut for begin, end in chunk_places(part) for cut in (begin, begin + 9, end - 1, end, end + 1) if cut in last
    ]
    tally = damage.Damage(part, tmp_path).cut(sorted({*edges, *last[::250]}))
    assert tally.examples == []
    assert (tally.runs > 250, tally.violations) == (True, 0)
    assert 0.7 < tally.worst_loss_s <= 1.0


def test_recovery_of_cuts_at_random_places_is_finished_true_and_says_what_was_lost(
    tmp_path: Path, part: bytes, whole: list[LogMessage]
) -> None:
    rng, begin = random.Random(2), chunk_places(part)[0][1]
    for index in range(60):
        path = tmp_path / f"{index}.mcap.part"
        path.write_bytes(part[: rng.randrange(begin, len(part))])
        before = messages(path)
        result = recover(path, disk=DISK)
        assert messages(result.path) == before == whole[: result.recovered_messages]
        assert 0.0 <= result.lost_s <= 1.0
        assert info(result.path).complete
        with LogFile(result.path) as log:
            list(log.messages())
            assert float(log.metadata[RECOVERED]["lost_s"]) == pytest.approx(result.lost_s)


def test_a_flipped_bit_costs_one_chunk_at_most_and_is_never_believed(
    tmp_path: Path, part: bytes, whole: list[LogMessage]
) -> None:
    path, rng, true = tmp_path / "a.mcap.part", random.Random(3), set(whole)
    longest = max(sum(1 for _ in group) for group in _by_chunk(part, whole))
    for _ in range(300):
        at = rng.randrange(8, len(part))
        path.write_bytes(part[:at] + bytes([part[at] ^ 1 << rng.randrange(8)]) + part[at + 1 :])
        found = messages(path)
        assert set(found) <= true
        assert len(found) == len(set(found)) >= len(whole) - longest


def _by_chunk(part: bytes, whole: list[LogMessage]) -> list[list[LogMessage]]:
    groups: dict[int, list[LogMessage]] = {}
    starts = [CHUNK.unpack_from(part, begin + RECORD.size)[0] for begin, _ in chunk_places(part)]
    for message in whole:
        groups.setdefault(sum(start <= message.log_time_ns for start in starts), []).append(message)
    return list(groups.values())


@pytest.mark.parametrize("index", [0, 1, 7, -1])
def test_a_lost_chunk_costs_itself_and_the_loss_is_stated(
    tmp_path: Path, part: bytes, whole: list[LogMessage], index: int
) -> None:
    """The first one too, although it holds schemas and channels."""
    begin, end = chunk_places(part)[index]
    middle = (begin + end) // 2
    path = tmp_path / "a.mcap.part"
    path.write_bytes(part[:middle] + bytes(40) + part[middle + 40 :])
    found = messages(path)
    missing = [one for one in whole if one not in set(found)]
    result = recover(path, disk=DISK)
    assert result.recovered_messages == len(found) == len(whole) - len(missing)
    spans = {one.log_time_ns for one in missing}
    assert (max(spans) - min(spans)) / NS_PER_S <= 1.0
    assert result.lost_s == pytest.approx((max(spans) - min(spans)) / NS_PER_S, abs=0.21)
    if index == 0:
        assert len(found) > 0.98 * len(whole)


def test_two_damaged_places_and_what_lies_between_them(tmp_path: Path, part: bytes, whole: list[LogMessage]) -> None:
    places = chunk_places(part)
    data = bytearray(part)
    for begin, end in (places[3], places[9]):
        data[(begin + end) // 2] ^= 0xFF
    path = tmp_path / "a.mcap.part"
    path.write_bytes(data)
    result = recover(path, disk=DISK)
    assert result.lost_s == pytest.approx(2.0, abs=0.1)
    assert set(messages(result.path)) < set(whole)


def test_metadata_that_was_damaged_is_taken_from_where_a_checksum_vouches_for_it(tmp_path: Path, part: bytes) -> None:
    data = bytearray(part)
    at = part.index(b"/dev/ttyUSB0", part.index(b"calibration.yaml"))
    data[at + 5] ^= 1
    path = tmp_path / "a.mcap.part"
    path.write_bytes(data)
    result = recover(path, disk=DISK)
    with LogFile(result.path) as log:
        assert log.metadata["armctl"]["port"] == log.facts["port"] == "/dev/ttyUSB0"


def test_recovered_files_compact_and_stay_what_they_are(tmp_path: Path, part: bytes) -> None:
    path = tmp_path / "a.mcap.part"
    path.write_bytes(part[: len(part) * 9 // 10])
    result = recover(path, disk=DISK)
    before = messages(result.path)
    assert compact(result.path, disk=DISK)
    assert messages(result.path) == before
