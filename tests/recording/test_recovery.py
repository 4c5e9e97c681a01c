"""Cut anywhere, with bits flipped anywhere: nothing but true values, and nothing lost that is intact."""

import errno
import logging
import os
import random
from io import BufferedWriter
from pathlib import Path

import pytest
from mcap.reader import make_reader

from armctl.clock import NS_PER_S
from armctl.recording.compact import compact
from armctl.recording.disk import Disk
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.reader import info
from armctl.recording.recover import recover, recover_folder
from armctl.recording.replay import RECOVERED, check, log_setup
from proving import damage
from proving.damage import chunk_places
from tests.recording.factory import ANCHOR, make_records
from tests.recording.logs import DISK, messages, spoilt, write
from tests.recording.refusals import cannot
from tests.words import missing

RECORDS = make_records(297, keyframe_ticks=100)


@pytest.fixture(scope="module")
def part(tmp_path_factory: pytest.TempPathFactory) -> bytes:
    """Half a minute, flushed as the recorder does, and then cut off by a power cut."""
    return write(tmp_path_factory.mktemp("part") / "a.mcap", RECORDS, flush_ticks=9, finish=False).read_bytes()


@pytest.fixture(scope="module")
def whole(tmp_path_factory: pytest.TempPathFactory, part: bytes) -> list[LogMessage]:
    return messages(put(tmp_path_factory.mktemp("whole"), part))


def put(folder: Path, data: bytes, name: str = "a") -> Path:
    """The bytes as a part in a folder."""
    path = folder / f"{name}.mcap.part"
    path.write_bytes(data)
    return path


def test_a_cut_loses_the_chunk_it_hits_and_nothing_else(tmp_path: Path, part: bytes) -> None:
    """The short form: the edges of every chunk of the last 64 KiB and every 250th byte; 120 places in all of it."""
    last = range(len(part) - 2**16, len(part) + 1)
    edges = {cut for begin, end in chunk_places(part) for cut in (begin, begin + 9, end - 1, end, end + 1)}
    places = edges & set(last) | {*last[::250], *range(9, len(part), len(part) // 120)}
    tally = damage.Damage(part, tmp_path).cut(sorted(places))
    assert tally.examples == []
    assert (tally.runs > 250, tally.violations) == (True, 0)
    assert 0.7 < tally.worst_loss_s <= 1.0


def test_recovery_of_cuts_at_random_places_is_finished_true_and_says_what_was_lost(
    tmp_path: Path, part: bytes, whole: list[LogMessage]
) -> None:
    rng, begin = random.Random(2), chunk_places(part)[0][1]
    for index in range(60):
        path = put(tmp_path, part[: rng.randrange(begin, len(part))], f"{index}")
        before = messages(path)
        assert not info(path).complete
        result = recover(path, disk=DISK)
        assert messages(result.path) == before == whole[: result.recovered_messages]
        assert 0.0 <= result.lost_s <= 1.0
        assert info(result.path).complete
        with LogFile(result.path) as log:
            list(log.messages())
            assert float(log.metadata[RECOVERED]["lost_s"]) == pytest.approx(result.lost_s)


@pytest.mark.parametrize("finish", [False, True])
def test_a_flipped_bit_costs_one_chunk_at_most_and_is_never_believed(tmp_path: Path, finish: bool) -> None:
    data = write(tmp_path / "b.mcap", RECORDS[:99], flush_ticks=9, finish=finish).read_bytes()
    tally = damage.Damage(data, tmp_path).flip(random.Random(3), 300)
    assert (tally.runs, tally.violations, tally.examples) == (300, 0, [])


@pytest.mark.parametrize("index", [0, 1, 7, -1])
def test_a_lost_chunk_costs_itself_and_the_loss_is_stated(
    tmp_path: Path, part: bytes, whole: list[LogMessage], index: int
) -> None:
    """The first one too, although it holds schemas and channels."""
    middle = sum(chunk_places(part)[index]) // 2
    path = put(tmp_path, part[:middle] + bytes(40) + part[middle + 40 :])
    found = messages(path)
    missing = [one for one in whole if one not in set(found)]
    result = recover(path, disk=DISK)
    assert result.recovered_messages == len(found) == len(whole) - len(missing)
    times_ns = [one.log_time_ns for one in missing]
    span_s = (max(times_ns) - min(times_ns)) / NS_PER_S
    assert span_s <= 1.0
    assert result.lost_s == pytest.approx(span_s, abs=0.21)
    if index == 0:
        assert len(found) > 0.98 * len(whole)


def test_two_damaged_places_and_what_lies_between_them(tmp_path: Path, part: bytes, whole: list[LogMessage]) -> None:
    result = recover(put(tmp_path, spoilt(part, 3, 9)), disk=DISK)
    assert result.lost_s == pytest.approx(2.0, abs=0.1)
    assert set(messages(result.path)) < set(whole)


def test_metadata_that_was_damaged_is_taken_from_where_a_checksum_confirms_it(tmp_path: Path, part: bytes) -> None:
    at = part.index(b"/dev/ttyUSB0", part.index(b"calibration.yaml")) + 5
    data = part[:at] + bytes([part[at] ^ 1]) + part[at + 1 :]
    with LogFile(recover(put(tmp_path, data), disk=DISK).path) as log:
        assert log.metadata["armctl"]["port"] == log.facts["port"] == "/dev/ttyUSB0"


def test_recovered_files_compact_and_stay_what_they_are(tmp_path: Path, part: bytes) -> None:
    result = recover(put(tmp_path, part[: len(part) * 9 // 10]), disk=DISK)
    before = messages(result.path)
    assert compact(result.path, disk=DISK)
    assert messages(result.path) == before


def test_recovery_removes_the_part_and_leaves_a_file_that_replays(tmp_path: Path, log: Path) -> None:
    part = put(tmp_path, log.read_bytes()[: int(log.stat().st_size * 0.7)], "b")
    (tmp_path / "b.mcap.recovering").write_bytes(b"killed while recovering")
    result = recover(part)
    assert [*tmp_path.iterdir()] == [result.path] == [tmp_path / "b.mcap"]
    assert check(result.path).mismatches == 0
    with LogFile(result.path) as file:
        assert log_setup(file).anchor == ANCHOR
        assert file.metadata["recovered"]["messages"] == str(result.recovered_messages)
    with result.path.open("rb") as stream:
        assert make_reader(stream, validate_crcs=True).get_summary() is not None


def test_a_damaged_finished_file_is_kept_beside_the_recovered_one(tmp_path: Path, log: Path) -> None:
    data = bytearray(log.read_bytes())
    data[len(data) // 3] ^= 8
    path = tmp_path / "c.mcap"
    path.write_bytes(data)
    names = [recover(path).path.name for _ in range(3)]
    assert names == ["c-recovered.mcap", "c-recovered-2.mcap", "c-recovered-3.mcap"]
    assert path.read_bytes() == data
    result = recover(path, tmp_path / "d.mcap")
    assert len(messages(log)) * 0.85 < result.recovered_messages < len(messages(log))
    assert 0.0 < result.lost_s <= 1.1
    cannot(recover, path, tmp_path / "d.mcap", why="exists already")


def test_a_finished_file_that_still_has_its_old_name_loses_it(tmp_path: Path, log: Path) -> None:
    os.link(put(tmp_path, log.read_bytes()), tmp_path / "a.mcap")
    recover_folder(tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ["a.mcap"]


def test_a_part_without_an_intact_message_is_not_recovered(tmp_path: Path, log: Path) -> None:
    part = put(tmp_path, log.read_bytes()[:20_000])
    cannot(recover, part, why="no intact message")
    assert [*tmp_path.iterdir()] == [part]


@pytest.mark.parametrize("size_bytes", [0, 5, 20_000])
def test_a_part_that_was_cut_as_it_began_is_set_aside_and_no_error(
    size_bytes: int, tmp_path: Path, log: Path, caplog: pytest.LogCaptureFixture
) -> None:
    put(tmp_path, log.read_bytes()[:size_bytes])
    recover_folder(tmp_path)
    assert [path.name for path in tmp_path.iterdir()] == ["a.mcap.part.broken"]
    [(_, level, said)] = caplog.record_tuples
    assert level == logging.WARNING
    assert not missing(said, str(tmp_path / "a.mcap.part"), "kept as a.mcap.part.broken, and may be deleted")


def test_a_part_for_which_the_disk_has_no_room_stays_for_the_next_start(
    tmp_path: Path, part: bytes, whole: list[LogMessage], caplog: pytest.LogCaptureFixture
) -> None:
    """Before, it was set aside as broken, and nothing of a whole log was recovered any more."""

    class Full(Disk):
        def create(self, path: Path) -> BufferedWriter:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    cut = put(tmp_path, part)
    recover_folder(tmp_path, disk=Full())
    assert [(path, path.read_bytes()) for path in tmp_path.iterdir()] == [(cut, part)]
    [(_, level, said)] = caplog.record_tuples
    assert level == logging.ERROR
    assert not missing(said, "a.mcap", "No space left on device", "a.mcap.part stays, and the next start tries again")
    recover_folder(tmp_path)
    assert messages(tmp_path / "a.mcap") == whole
