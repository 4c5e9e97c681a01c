"""Compaction: smaller, the same bit for bit, and never a loss."""

import errno
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from unittest.mock import Mock

import pytest
from mcap.reader import make_reader

from armctl.recording.chunks import MAX_CHUNK_BYTES
from armctl.recording.compact import CHUNK_BYTES, COMPACTED, Compaction, compact, compact_folder
from armctl.recording.disk import PartInUse, owned
from armctl.recording.index import Index
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.recover import recover
from armctl.recording.replay import check
from armctl.recording.rewrite import Rewrite
from proving.damage import chunk_places
from proving.log_rig import repeated
from tests.recording.factory import make_records
from tests.recording.logs import replayed, spoilt, write
from tests.recording.refusals import cannot
from tests.recording.rig import failing

RECORDS = make_records(400, keyframe_ticks=150)


def held(path: Path) -> tuple[list[LogMessage], dict[str, bytes], dict[str, str]]:
    with LogFile(path) as log:
        messages = list(log.messages())
        assert log.complete
        return messages, {name: one.data for name, one in log.attachments.items()}, log.facts


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return write(tmp_path / "armctl-20250615T150645Z.mcap", RECORDS, flush_ticks=9)


def test_a_compacted_log_is_smaller_and_holds_the_same_and_replays_bit_for_bit(log: Path) -> None:
    before, size = held(log), log.stat().st_size
    assert compact(log)
    assert held(log) == before
    assert log.stat().st_size < 0.7 * size
    assert replayed(log) == (400, 0)
    assert [path.name for path in log.parent.iterdir()] == [log.name]


def test_a_compacted_log_has_large_chunks_that_every_reader_still_inflates(tmp_path: Path) -> None:
    log = write(tmp_path / "armctl-20250615T150645Z.mcap", repeated(RECORDS, 700), flush_ticks=9)
    assert len(chunk_places(log.read_bytes())) > 70
    assert compact(log)
    with log.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    (chunk,) = summary.chunk_indexes
    assert 2**20 < chunk.uncompressed_size < CHUNK_BYTES <= MAX_CHUNK_BYTES / 4


def test_a_log_is_compacted_once(log: Path) -> None:
    assert compact(log)
    data = log.read_bytes()
    assert not compact(log)
    assert log.read_bytes() == data
    with LogFile(log) as file:
        assert COMPACTED in file.metadata


def test_a_damaged_log_stays_as_it_is(log: Path) -> None:
    log.write_bytes(data := spoilt(log.read_bytes(), 5))
    cannot(compact, log, why="is damaged")
    assert log.read_bytes() == data
    compact_folder(log.parent)
    assert log.read_bytes() == data
    assert [path.name for path in log.parent.iterdir()] == [log.name]


FULL = [(f"disk.Disk.{method}", failing(errno.ENOSPC), "No space left") for method in ("create", "sync", "replace")]


ADD = Rewrite._add


def spoiling(copy: Rewrite, topic: str, data: bytes, at: LogMessage) -> None:
    """A copy that is not the same in one bit of one message."""
    ADD(copy, topic, data[:-1] + bytes([data[-1] ^ (copy.messages == 100)]), at)


def losing(copy: Rewrite, topic: str, data: bytes, at: LogMessage) -> None:
    """A copy that lacks the last messages."""
    if at.sequence < RECORDS[-1].inputs.tick:
        ADD(copy, topic, data, at)


WRONG = [("rewrite.Rewrite._add", does, "is damaged") for does in (spoiling, losing)]


@pytest.mark.parametrize(("part", "does", "why"), [*FULL, *WRONG])
def test_a_failing_disk_or_a_copy_that_differs_leaves_the_log_as_it_is(
    log: Path, part: str, does: Callable[..., object], why: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = log.read_bytes()
    monkeypatch.setattr(f"armctl.recording.{part}", does)
    cannot(compact, log, why=why)
    monkeypatch.undo()
    assert log.read_bytes() == data
    assert compact(log), "what the failure left behind is in nobody's way"


def test_a_log_somebody_holds_is_left_alone(log: Path) -> None:
    with owned(log), pytest.raises(PartInUse):
        compact(log)


def test_the_process_compacts_the_logs_of_a_folder_and_nothing_else(log: Path) -> None:
    names = ("take.mcap", "fault-20250615T150645Z-HOT.mcap")
    others = {path: path.read_bytes() for path in (write(log.with_name(name), RECORDS) for name in names)}
    size = log.stat().st_size
    subprocess.run([sys.executable, "-m", "armctl.recording.compact", log.parent], check=True, timeout=100)
    assert log.stat().st_size < size
    assert others == {path: path.read_bytes() for path in others}
    with Index(log.parent) as index:
        assert index.new() == [], "the index is up to date"


def test_nothing_is_left_of_a_process_that_has_compacted(log: Path) -> None:
    def children() -> set[str]:
        return {
            child for task in Path("/proc/self/task").iterdir() for child in (task / "children").read_text().split()
        }

    before, size = children(), log.stat().st_size
    Compaction().start(log.parent)
    for thread in threading.enumerate():
        if thread.name == "compaction":
            thread.join(100.0)
    assert children() <= before
    assert log.stat().st_size < size


def test_a_log_that_was_cut_is_known_to_have_been_when_it_is_compacted(tmp_path: Path) -> None:
    for name, flush_ticks in (("small", 1000), ("large", 5)):
        part = write(tmp_path / f"{name}.mcap", RECORDS, finish=False, flush_ticks=flush_ticks)
        assert compact(log := recover(part).path)
        assert check(log).gaps[-1]["to_s"] is None


def test_one_compaction_runs_at_a_time(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    process = Mock(**{"return_value.poll.return_value": None})
    monkeypatch.setattr(subprocess, "Popen", process)
    compaction = Compaction()
    compaction.start(tmp_path)
    compaction.start(tmp_path)
    assert process.call_count == 1
    assert process.call_args.kwargs["start_new_session"], "the daemon's own session goes before others"
    process.return_value.poll.return_value = 0
    compaction.start(tmp_path)
    assert [call.args[0][-1] for call in process.call_args_list] == [str(tmp_path)] * 2
