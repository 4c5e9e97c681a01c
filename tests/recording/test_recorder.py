"""The recorder: nothing lost, nobody kept waiting, every file alone."""

import errno
import json
import os
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.messages import Connected, TickRecord
from armctl.recording import recorder as module
from armctl.recording import recordings
from armctl.recording.disk import Disk
from armctl.recording.reader import info, read
from armctl.recording.recorder import Recorder
from armctl.recording.recover import recover_folder
from armctl.recording.writer import LogWriter
from tests.recording.altered import faulty
from tests.recording.factory import make_records, times_s
from tests.recording.logs import recorder_lines, replayed, ticks
from tests.recording.refusals import cannot
from tests.recording.rig import Rig, failing

RECORDS = make_records(100, keyframe_ticks=40)


@contextmanager
def held(recorder: Recorder) -> Iterator[None]:
    """Keep the recorder's thread busy."""
    entered, leave = threading.Event(), threading.Event()

    def wait() -> None:
        entered.set()
        leave.wait(10.0)

    recorder._queue.put(wait)
    assert entered.wait(10.0)
    yield
    leave.set()


def put_at_once(recorder: Recorder, records: list[TickRecord], note: str = "{}") -> None:
    """More than the recorder's thread has time for, and a note behind it."""
    with held(recorder):
        for record in records:
            recorder.put(record)
        recorder.note(note, records[-1].inputs.now_ns)


def slow_disk(rig: Rig, monkeypatch: pytest.MonkeyPatch, took_ns: int) -> list[int]:
    """A disk that takes so long from now on, and when it was done each time."""
    done_ns: list[int] = []

    def sync(_: Disk, stream: Any) -> None:
        stream.flush()
        rig.clock.advance_ns(took_ns)
        done_ns.append(rig.clock.now_ns())

    monkeypatch.setattr(Disk, "sync", sync)
    return done_ns


def test_closing_writes_the_queue_into_one_finished_log(rig: Rig) -> None:
    put_at_once(rig.recorder, RECORDS, note='{"request":1}')
    path = rig.only_log()
    assert path.name == "armctl-20250615T150645Z-000001.mcap"
    assert ticks(path) == list(range(100))
    assert json.loads(list(read(path, ["/armctl/command"]))[-1].value["data"]) == {"request": 1}
    assert replayed(path) == (100, 0)
    assert rig.recorder.problem == ""


def test_no_file_is_begun_before_there_is_something_to_record(rig: Rig) -> None:
    rig.settle()
    assert rig.recorder.log_path is None
    assert rig.close() == []


def test_the_log_being_written_is_told_by_the_name_that_it_has_on_the_disk(rig: Rig) -> None:
    rig.put(RECORDS[:3])
    assert rig.recorder.log_path == rig.logs / "armctl-20250615T150645Z-000001.mcap.part"
    assert list(rig.logs.iterdir()) == [rig.recorder.log_path]


def test_what_was_put_a_second_ago_is_on_the_disk(rig: Rig) -> None:
    for record in RECORDS[:35]:
        rig.put([record])
        assert len(ticks(rig.part)) >= record.inputs.tick - 9


def test_a_fault_reaches_the_disk_at_once(rig: Rig) -> None:
    rig.put(faulty(RECORDS[:4], 3, 3))
    assert ticks(rig.part) == [0, 1, 2, 3]


def test_an_idle_recorder_flushes_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "FLUSH_NS", 1_000_000)
    flushed = threading.Event()
    flush = LogWriter.flush

    def noted(writer: LogWriter) -> None:
        flush(writer)
        flushed.set()

    monkeypatch.setattr(LogWriter, "flush", noted)
    rig = Rig(tmp_path)
    rig.recorder.put(RECORDS[0])
    rig.settle()
    rig.clock.advance_ns(NS_PER_S)
    assert flushed.wait(10.0)
    rig.close()


def test_a_take_holds_its_own_ticks_and_replays_alone(rig: Rig) -> None:
    rig.put(RECORDS[:55])
    path = rig.recorder.begin_take("first")
    assert rig.recorder.take_path == path
    rig.put(RECORDS[55:80])
    assert rig.recorder.end_take() == path == rig.takes / "first.mcap"
    rig.put(RECORDS[80:])
    log = rig.only_log()
    assert ticks(path) == list(range(55, 80))
    assert replayed(path) == (25, 0)
    assert recordings.load(path).samples == 25
    assert ticks(log) == list(range(100))
    times = {m.sequence: m.log_time_ns for m in read(log, ["/joint_states"])}
    assert all(times[m.sequence] == m.log_time_ns for m in read(path, ["/joint_states"]))


def test_a_take_needs_a_free_name_and_a_free_recorder(rig: Rig) -> None:
    assert rig.recorder.end_take() is None
    cannot(rig.recorder.begin_take, "../first", why="a name has")
    rig.recorder.begin_take("first")
    cannot(rig.recorder.begin_take, "second", why="first is being recorded")
    rig.recorder.end_take()
    cannot(rig.recorder.begin_take, "first", why="exists already")


def test_closing_keeps_the_take_under_way(rig: Rig) -> None:
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[:10])
    rig.close()
    assert ticks(path) == list(range(10))


def test_putting_never_waits_and_a_full_queue_is_told(rig: Rig) -> None:
    rig.recorder._queue_records = 20
    put_at_once(rig.recorder, RECORDS[:30], note="{}")
    rig.settle()
    rig.put(RECORDS[30:])
    path = rig.only_log()
    assert ticks(path) == [*range(20), *range(30, 100)]
    (line,) = recorder_lines(path)
    assert line["function"] == "DROPPED"
    assert "10 tick records were lost before tick 30" in line["msg"]
    assert replayed(path) == (20 + 59, 0)


def test_a_take_that_begins_after_a_loss_waits_for_the_next_keyframe(rig: Rig) -> None:
    rig.put(RECORDS[:50])
    rig.put(RECORDS[55:60])
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[60:])
    rig.recorder.end_take()
    assert replayed(path) == (19, 0)


def test_a_full_disk_stops_recording_and_nothing_else(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.put(RECORDS[:20])
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[20:25])
    monkeypatch.setattr(os, "fdatasync", failing(errno.ENOSPC))
    rig.put(RECORDS[25:40])
    assert rig.recorder.problem.startswith("NO_SPACE: ")
    assert rig.recorder.log_path is None
    cannot(rig.recorder.end_take, why="NO_SPACE")
    cannot(rig.recorder.begin_take, "second", why="no take can be recorded now: NO_SPACE")
    cannot(rig.recorder.check, why="no take can be recorded now: NO_SPACE")
    monkeypatch.undo()
    rig.put(RECORDS[40:])
    assert rig.recorder.problem == ""
    rig.close()
    recover_folder(rig.logs)
    kept = [tick for log in sorted(rig.logs.glob("*.mcap")) for tick in ticks(log)]
    assert kept == sorted(set(kept))
    assert set(range(20)) < set(kept)
    # Tried again 5 s after the disk failed.
    assert 75 <= min(tick for tick in kept if tick > 45) <= 85
    assert recordings.load(path).samples >= 5


def test_a_failing_take_does_not_stop_the_log(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[:5])
    write = LogWriter.write_tick

    def fail(writer: LogWriter, record: TickRecord) -> None:
        if writer.path == path:
            raise LogError("the take's disk is gone")
        write(writer, record)

    monkeypatch.setattr(LogWriter, "write_tick", fail)
    rig.put(RECORDS[5:10])
    assert "LOG_ERROR: the take's disk is gone" in rig.recorder.problem
    cannot(rig.recorder.end_take, why="the take's disk is gone")
    rig.recorder.begin_take("second")
    assert rig.recorder.problem == ""
    assert ticks(rig.only_log()) == list(range(10))


def test_an_unwritable_folder_is_a_problem_and_no_exception(tmp_path: Path) -> None:
    (tmp_path / "logs").write_bytes(b"a file where a folder should be")
    rig = Rig(tmp_path)
    rig.put(RECORDS[:3])
    assert rig.recorder.problem.startswith("LOG_ERROR: ")
    assert rig.recorder.log_path is None
    rig.recorder.close()


def test_a_file_that_cannot_be_finished_stays_as_a_part(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.put(RECORDS[:15])
    monkeypatch.setattr(os, "fdatasync", failing(errno.EIO))
    path = rig.only_log()
    assert (path.suffix, len(ticks(path))) == (".part", 15)
    assert rig.recorder.problem.startswith("LOG_ERROR: ")


def test_a_disk_that_does_not_answer_does_not_keep_the_daemon(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CLOSE_S", 0.01)
    monkeypatch.setattr(module, "TAKE_END_S", 0.01)
    rig.recorder.begin_take("first")
    with held(rig.recorder):
        cannot(rig.recorder.end_take, why="does not answer")
        rig.recorder.close()
        assert rig.recorder._thread.is_alive()
    rig.recorder._thread.join(10.0)


def test_a_step_of_the_wall_clock_is_told_and_changes_no_time(rig: Rig) -> None:
    take = rig.recorder.begin_take("first")
    rig.put(RECORDS[:30])
    rig.wall_offset_ns += 3600 * NS_PER_S
    rig.put(RECORDS[30:])
    rig.recorder.end_take()
    for path in (take, rig.close()[0]):
        assert [line["msg"] for line in recorder_lines(path)] == ["CLOCK_STEP: the wall clock was set by +3600.000 s"]
        times = [m.log_time_ns for m in read(path, ["/joint_states"])]
        known = times_s(RECORDS)[: len(times)]
        assert [(time_ns - times[0]) / NS_PER_S for time_ns in times] == known
    assert len(times) < len(RECORDS)


def test_a_slow_disk_is_told_and_flushed_sooner(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    slow_disk(rig, monkeypatch, took_ns := 3 * NS_PER_S // 10)
    rig.put(RECORDS[:40])
    assert rig.recorder.problem == ""
    assert rig.recorder._flush_due_ns() - rig.recorder._flushed_ns == 9 * NS_PER_S // 10 - took_ns
    slow_disk(rig, monkeypatch, 2 * NS_PER_S)
    rig.put(RECORDS[40:70])
    assert rig.recorder.problem.startswith("SLOW_DISK: ")
    assert "2.0 s" in rig.recorder.problem
    slow_disk(rig, monkeypatch, 0)
    rig.put(RECORDS[70:])
    assert rig.recorder.problem == ""
    assert ticks(rig.only_log()) == list(range(100))


def test_a_disk_slower_than_the_records_is_asked_once_for_all_that_came_meanwhile(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    syncs = slow_disk(rig, monkeypatch, 2 * NS_PER_S)
    rig.put(RECORDS[:20])
    before = len(syncs)
    put_at_once(rig.recorder, RECORDS[20:60])
    rig.settle()
    assert len(syncs) - before <= 2
    rig.put(RECORDS[60:])
    assert ticks(rig.only_log()) == list(range(100))


def test_the_firmware_of_the_servos_stands_in_the_file(rig: Rig) -> None:
    first = RECORDS[0]
    told = replace(first, inputs=replace(first.inputs, commands=(Connected(firmware=(24, 24, -1, 24, 24, 24)),)))
    rig.put([told, *RECORDS[1:5]])
    assert info(rig.only_log()).facts["firmware"] == "24 24 -1 24 24 24"
