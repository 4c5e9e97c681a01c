"""The recorder: nothing lost, nobody kept waiting, every file alone."""

from __future__ import annotations

import errno
import json
import os
import shutil
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

import pytest

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import Config, LogConfig
from armctl.errors import LogError
from armctl.messages import Connected, Fault, TickRecord
from armctl.recording import recorder as module
from armctl.recording import recordings
from armctl.recording.disk import Disk
from armctl.recording.reader import info, read
from armctl.recording.recorder import Recorder
from armctl.recording.recover import recover_folder
from armctl.recording.replay import check
from armctl.recording.writer import LogWriter
from tests.recording.factory import CONTEXT, make_records

RECORDS = make_records(100, keyframe_ticks=40)
WALL_NS = 1_750_000_000 * NS_PER_S


class Usage(NamedTuple):
    total: int
    used: int
    free: int


class Compactor:
    """Notes what it is asked to do."""

    def __init__(self) -> None:
        self.folders: list[Path] = []

    def start(self, folder: Path) -> None:
        self.folders.append(folder)


class Rig:
    """A recorder on a clock of the test's own, in step with its thread through `settle`."""

    def __init__(self, folder: Path, **log: Any) -> None:
        self.logs, self.takes = folder / "logs", folder / "recordings"
        self.clock = VirtualClock(5 * NS_PER_S)
        self.wall_offset_ns = WALL_NS
        self.compactor = Compactor()
        self.recorder = Recorder(
            replace(CONTEXT, config=Config(log=LogConfig(free_bytes=log.pop("free_bytes", 0), **log))),
            self.logs,
            self.takes,
            clock=self.clock,
            wall_ns=lambda: self.clock.now_ns() + self.wall_offset_ns,
            compactor=self.compactor,
        )

    def settle(self) -> None:
        """Return when the thread has done everything queued before."""
        done = threading.Event()
        self.recorder._put(done.set)
        assert done.wait(10.0)

    def put(self, records: list[TickRecord]) -> None:
        """Records at their own times."""
        for record in records:
            self.clock.sleep_until_ns(record.inputs.now_ns)
            self.recorder.put(record)
            self.settle()

    def close(self) -> list[Path]:
        self.recorder.close()
        return sorted(self.logs.glob("*"))


@pytest.fixture
def rig(tmp_path: Path) -> Iterator[Rig]:
    rig = Rig(tmp_path)
    yield rig
    rig.close()


def ticks(path: Path) -> list[int]:
    return [m.value["tick"] for m in read(path, ["/armctl/cycle"]) if not m.value["inputs_only"]]


@contextmanager
def held(recorder: Recorder) -> Iterator[None]:
    """Keep the recorder's thread busy."""
    entered, leave = threading.Event(), threading.Event()

    def wait() -> None:
        entered.set()
        leave.wait(10.0)

    recorder._put(wait)
    assert entered.wait(10.0)
    yield
    leave.set()


def failing(number: int) -> Callable[..., None]:
    def fail(*_: object) -> None:
        raise OSError(number, os.strerror(number))

    return fail


def test_closing_drains_the_queue_into_one_finished_log(rig: Rig) -> None:
    with held(rig.recorder):
        for record in RECORDS:
            rig.recorder.put(record)
        rig.recorder.note("/armctl/command", '{"request":1}', RECORDS[-1].inputs.now_ns)
    (path,) = rig.close()
    assert path.name == "armctl-20250615T150645Z.mcap"
    assert ticks(path) == list(range(100))
    assert json.loads(list(read(path, ["/armctl/command"]))[-1].value["data"]) == {"request": 1}
    assert (check(path).ticks, check(path).mismatches) == (99, 0)
    assert rig.recorder.problem == ""


def test_no_file_is_begun_before_there_is_something_to_record(rig: Rig) -> None:
    rig.settle()
    assert rig.recorder.log_path is None
    assert rig.close() == []


def test_what_was_put_a_second_ago_is_on_the_disk(rig: Rig) -> None:
    for record in RECORDS[:35]:
        rig.put([record])
        assert rig.recorder.log_path is not None
        on_disk = ticks(rig.recorder.log_path.with_name(rig.recorder.log_path.name + ".part"))
        assert len(on_disk) >= record.inputs.tick - 9


def test_a_fault_reaches_the_disk_at_once(rig: Rig) -> None:
    rig.put(RECORDS[:3])
    fault = replace(RECORDS[3], outputs=replace(RECORDS[3].outputs, fault=Fault("TRIPPED", "it did", 1, 2)))
    rig.put([fault])
    assert rig.recorder.log_path is not None
    assert ticks(rig.recorder.log_path.with_name(rig.recorder.log_path.name + ".part")) == [0, 1, 2, 3]


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


@pytest.mark.parametrize("limit", [{"rotate_s": 2.0}, {"rotate_bytes": 2**16}])
def test_a_full_file_is_followed_by_one_that_replays_alone(tmp_path: Path, limit: dict[str, Any]) -> None:
    rig = Rig(tmp_path, **limit)
    rig.put(make_records(400, keyframe_ticks=70))
    paths = rig.close()
    assert 2 <= len(paths) <= 20
    assert [tick for path in paths for tick in ticks(path)] == list(range(400))
    assert sum(check(path).ticks for path in paths) == 399
    assert all(check(path).mismatches == 0 for path in paths)
    assert [info(path).facts["previous"] for path in paths] == ["", *(path.name for path in paths[:-1])]


def test_files_of_the_same_second_get_a_number(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    first = Rig(tmp_path)
    rig.put(RECORDS[:1])
    first.put(RECORDS[:1])
    first.close()
    assert [path.name for path in rig.close()] == ["armctl-20250615T150645Z-2.mcap", "armctl-20250615T150645Z.mcap"]


def test_a_take_holds_its_own_ticks_and_replays_alone(rig: Rig) -> None:
    rig.put(RECORDS[:55])
    path = rig.recorder.begin_take("first")
    assert rig.recorder.take_path == path
    rig.put(RECORDS[55:80])
    assert rig.recorder.end_take() == path == rig.takes / "first.mcap"
    rig.put(RECORDS[80:])
    (log,) = rig.close()
    assert ticks(path) == list(range(55, 80))
    assert (check(path).ticks, check(path).mismatches) == (25, 0)
    assert recordings.load(path).samples == 25
    assert ticks(log) == list(range(100))
    times = {m.sequence: m.log_time_ns for m in read(log, ["/joint_states"])}
    assert all(times[m.sequence] == m.log_time_ns for m in read(path, ["/joint_states"]))


def test_a_take_needs_a_free_name_and_a_free_recorder(rig: Rig) -> None:
    assert rig.recorder.end_take() is None
    with pytest.raises(LogError, match="a name has"):
        rig.recorder.begin_take("../first")
    rig.recorder.begin_take("first")
    with pytest.raises(LogError, match="first is being recorded"):
        rig.recorder.begin_take("second")
    rig.recorder.end_take()
    with pytest.raises(LogError, match="exists already"):
        rig.recorder.begin_take("first")


def test_closing_keeps_the_take_under_way(rig: Rig) -> None:
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[:10])
    rig.close()
    assert ticks(path) == list(range(10))


def test_putting_never_waits_and_a_full_queue_is_told(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    rig.recorder._queue_records = 20
    with held(rig.recorder):
        for record in RECORDS[:30]:
            rig.recorder.put(record)
        rig.recorder.note("/armctl/command", "{}", 0)
    rig.settle()
    rig.put(RECORDS[30:])
    (path,) = rig.close()
    assert ticks(path) == [*range(20), *range(30, 100)]
    (line,) = (m.value for m in read(path, ["/rosout"]) if m.value["name"] == "armctl.recording")
    assert line["function"] == "DROPPED"
    assert "10 tick records were lost before tick 30" in line["msg"]
    assert (check(path).ticks, check(path).mismatches) == (19 + 59, 0)


def test_a_take_that_begins_after_a_loss_waits_for_the_next_keyframe(rig: Rig) -> None:
    rig.put(RECORDS[:50])
    rig.put(RECORDS[55:60])
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[60:])
    rig.recorder.end_take()
    assert (check(path).ticks, check(path).mismatches) == (19, 0)


def test_a_full_disk_stops_recording_and_nothing_else(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.put(RECORDS[:20])
    path = rig.recorder.begin_take("first")
    rig.put(RECORDS[20:25])
    monkeypatch.setattr(os, "fdatasync", failing(errno.ENOSPC))
    rig.put(RECORDS[25:40])
    assert rig.recorder.problem.startswith("NO_SPACE: ")
    assert rig.recorder.log_path is None
    with pytest.raises(LogError, match="NO_SPACE"):
        rig.recorder.end_take()
    with pytest.raises(LogError, match="NO_SPACE"):
        rig.recorder.begin_take("second")
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
    with pytest.raises(LogError, match="the take's disk is gone"):
        rig.recorder.end_take()
    rig.recorder.begin_take("second")
    assert rig.recorder.problem == ""
    (log,) = rig.close()
    assert ticks(log) == list(range(10))


def test_recording_ends_before_the_disk_is_full_and_begins_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [2**30]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: Usage(2**40, 0, free[0]))
    rig = Rig(tmp_path, free_bytes=2**28)
    take = rig.recorder.begin_take("first")
    rig.put(RECORDS[:20])
    free[0] = 2**27
    rig.put(RECORDS[20:40])
    assert rig.recorder.problem.startswith("NO_SPACE: 128 MiB free")
    assert rig.recorder.end_take() == take
    free[0] = 2**30
    rig.put(RECORDS[40:])
    assert rig.recorder.problem == ""
    paths = rig.close()
    assert all(info(path).complete for path in [*paths, take])
    assert ticks(paths[0]) == ticks(take) == list(range(ticks(take)[-1] + 1))
    assert ticks(paths[1])[-1] == 99
    assert all(check(path).mismatches == 0 for path in paths)


def test_an_unwritable_folder_is_a_problem_and_no_exception(tmp_path: Path) -> None:
    (tmp_path / "logs").write_bytes(b"a file where a folder should be")
    rig = Rig(tmp_path)
    rig.put(RECORDS[:3])
    assert rig.recorder.problem.startswith("LOG_ERROR: ")
    assert rig.recorder.log_path is None
    rig.recorder.close()


def test_a_file_that_cannot_be_begun_is_tried_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armctl.recording.disk.fcntl.flock", failing(errno.ENOSPC))
    rig.put(RECORDS[:3])
    assert rig.recorder.problem.startswith("NO_SPACE: ")
    monkeypatch.undo()
    rig.put(RECORDS[3:])
    assert rig.recorder.problem == ""
    (path,) = rig.close()
    assert ticks(path)[-1] == 99
    assert check(path).mismatches == 0


def test_a_file_that_cannot_be_finished_stays_as_a_part(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.put(RECORDS[:15])
    monkeypatch.setattr(os, "fdatasync", failing(errno.EIO))
    (path,) = rig.close()
    assert path.name.endswith(".part")
    assert rig.recorder.problem.startswith("LOG_ERROR: ")
    assert len(ticks(path)) == 15


def test_a_disk_that_does_not_answer_does_not_keep_the_daemon(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "CLOSE_S", 0.01)
    monkeypatch.setattr(module, "TAKE_END_S", 0.01)
    rig.recorder.begin_take("first")
    with held(rig.recorder):
        with pytest.raises(LogError, match="does not answer"):
            rig.recorder.end_take()
        rig.recorder.close()
        assert rig.recorder._thread.is_alive()
    rig.recorder._thread.join(10.0)


def test_a_step_of_the_wall_clock_is_told_and_changes_no_time(rig: Rig) -> None:
    rig.put(RECORDS[:30])
    rig.wall_offset_ns += 3600 * NS_PER_S
    rig.put(RECORDS[30:])
    (path,) = rig.close()
    lines = [m.value["msg"] for m in read(path, ["/rosout"]) if m.value["name"] == "armctl.recording"]
    assert lines == ["CLOCK_STEP: the wall clock was set by +3600.000 s"]
    times = [m.log_time_ns for m in read(path, ["/joint_states"])]
    assert all(b - a == NS_PER_S // 10 for a, b in pairwise(times))


def faulty(records: list[TickRecord], first: int, last: int, code: str = "TRIPPED") -> list[TickRecord]:
    """The records with a fault from one tick to another."""
    fault = Fault(code, "it did", first, 2)
    return [
        replace(record, outputs=replace(record.outputs, fault=fault)) if first <= record.inputs.tick <= last else record
        for record in records
    ]


def test_the_seconds_around_a_fault_are_kept_in_a_file_of_its_own(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_s=2.0)
    rig.put(faulty(make_records(150, keyframe_ticks=30), 80, 90))
    snapshot, log = sorted(rig.close(), reverse=True)
    assert snapshot.name == "fault-20250615T150653Z-TRIPPED.mcap"
    assert ticks(snapshot) == list(range(60, 101))
    assert info(snapshot).complete
    assert info(snapshot).facts["previous"] == log.name
    assert ticks(log) == list(range(150))
    whole = {(m.topic, m.sequence): m.value for m in read(log, ["/joint_states", "/armctl/servos"])}
    for message in read(snapshot, ["/joint_states", "/armctl/servos"]):
        assert whole[message.topic, message.sequence] == message.value
    # The control step knows nothing of a fault that was made up here; up to it the snapshot replays.
    assert check(snapshot).ticks == 41


def test_faults_that_follow_each_other_make_one_snapshot_and_it_has_a_longest_length(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_s=1.0)
    records = make_records(400, keyframe_ticks=30)
    for number, first in enumerate(range(50, 400, 8)):
        records = faulty(records, first, first + 5, f"FAULT_{number}")
    rig.put(records)
    snapshots = [path for path in rig.close() if path.name.startswith("fault-")]
    assert len(snapshots) == 4
    assert all(len(ticks(path)) <= 112 for path in snapshots)
    assert sorted({tick for path in snapshots for tick in ticks(path)}) == list(range(40, 400))


def test_a_snapshot_that_cannot_be_written_disturbs_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    create = Disk.create

    def refuse(disk: Disk, path: Path) -> Any:
        if path.name.startswith("fault-"):
            raise OSError(errno.EIO, os.strerror(errno.EIO))
        return create(disk, path)

    monkeypatch.setattr(Disk, "create", refuse)
    rig = Rig(tmp_path)
    rig.put(faulty(RECORDS, 30, 40))
    (log,) = rig.close()
    assert ticks(log) == list(range(100))
    assert rig.recorder.problem == ""


def test_a_rotated_log_is_handed_to_the_compactor(tmp_path: Path) -> None:
    rig = Rig(tmp_path, rotate_s=2.0)
    rig.put(make_records(50))
    assert rig.compactor.folders == [rig.logs] * 2
    rig.close()


def test_a_compactor_that_cannot_start_stops_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Compactor, "start", failing(errno.EAGAIN))
    rig = Rig(tmp_path, rotate_s=2.0)
    rig.put(make_records(50))
    assert [tick for path in rig.close() for tick in ticks(path)] == list(range(50))
    assert rig.recorder.problem == ""


def test_old_logs_make_room_and_snapshots_and_takes_stay(tmp_path: Path) -> None:
    logs = tmp_path / "logs"
    logs.mkdir()
    for day in range(4):
        (logs / f"armctl-2025010{day + 1}T000000Z.mcap").write_bytes(bytes(2**20))
    (logs / "fault-20250101T000000Z-HOT.mcap").write_bytes(bytes(2**20))
    rig = Rig(tmp_path, quota_bytes=2**20)
    rig.put(RECORDS[:20])
    names = [path.name for path in rig.close()]
    assert names == [
        "armctl-20250103T000000Z.mcap",
        "armctl-20250104T000000Z.mcap",
        "armctl-20250615T150645Z.mcap",
        "fault-20250101T000000Z-HOT.mcap",
    ]


def test_a_slow_disk_is_told_and_flushed_sooner(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    took_ns = 3 * NS_PER_S // 10

    def slow(_: Disk, stream: Any) -> None:
        stream.flush()
        rig.clock.advance_ns(took_ns)

    monkeypatch.setattr(Disk, "sync", slow)
    rig.put(RECORDS[:40])
    assert rig.recorder.problem == ""
    assert rig.recorder._flush_due_ns() - rig.recorder._flushed_ns == 9 * NS_PER_S // 10 - took_ns
    took_ns = 2 * NS_PER_S
    rig.put(RECORDS[40:70])
    assert rig.recorder.problem.startswith("SLOW_DISK: ")
    assert "2.0 s" in rig.recorder.problem
    took_ns = 0
    rig.put(RECORDS[70:])
    assert rig.recorder.problem == ""
    (log,) = rig.close()
    assert ticks(log) == list(range(100))


def test_the_firmware_of_the_servos_stands_in_the_file(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    first = RECORDS[0]
    told = replace(first, inputs=replace(first.inputs, commands=(Connected(firmware=(24, 24, -1, 24, 24, 24)),)))
    rig.put([told, *RECORDS[1:5]])
    (log,) = rig.close()
    assert info(log).facts["firmware"] == "24 24 -1 24 24 24"
