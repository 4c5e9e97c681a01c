"""Rotation: one log follows another, old ones make room, and the seconds around a fault are kept."""

import errno
import os
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from armctl.clock import NS_PER_S
from armctl.errors import LogError
from armctl.recording.disk import Disk
from armctl.recording.reader import info, read
from armctl.recording.replay import check
from armctl.recording.rotation import MAX_WIRE
from tests.recording.altered import faulty
from tests.recording.factory import make_records
from tests.recording.logs import recorder_lines, replayed, ticks
from tests.recording.rig import WALL_NS, Rig, failing

RECORDS = make_records(100, keyframe_ticks=40)


@pytest.mark.parametrize("limit", [{"rotate_s": 2.0}, {"rotate_bytes": 2**16}])
def test_a_full_file_is_compacted_and_followed_by_one_that_replays_alone(tmp_path: Path, limit: dict[str, Any]) -> None:
    rig = Rig(tmp_path, **limit)
    rig.put(make_records(400, keyframe_ticks=70))
    paths = rig.close()
    assert 2 <= len(paths) <= 20
    assert rig.compacted == [rig.logs] * (len(paths) - 1)
    assert [tick for path in paths for tick in ticks(path)] == list(range(400))
    of_each, mismatches = zip(*map(replayed, paths), strict=True)
    assert (sum(of_each), sum(mismatches)) == (400, 0)
    assert [info(path).facts["previous"] for path in paths] == ["", *(path.name for path in paths[:-1])]


def test_files_are_numbered_one_behind_the_other(tmp_path: Path) -> None:
    rig = Rig(tmp_path)
    first = Rig(tmp_path)
    rig.put(RECORDS[:1])
    first.put(RECORDS[:1])
    first.close()
    names = ["armctl-20250615T150645Z-000001.mcap", "armctl-20250615T150645Z-000002.mcap"]
    assert [path.name for path in rig.close()] == names


def test_the_seconds_around_a_fault_are_kept_in_a_file_of_its_own(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_s=2.0)
    rig.put(faulty(make_records(150, keyframe_ticks=30), 80, 90))
    snapshot, log = sorted(rig.close(), reverse=True)
    assert snapshot.name == "fault-20250615T150653Z-TRIPPED-000002.mcap"
    assert ticks(snapshot) == list(range(60, 101))
    assert (info(snapshot).complete, info(snapshot).facts["previous"]) == (True, log.name)
    assert ticks(log) == list(range(150))
    whole = {(m.topic, m.sequence): m.value for m in read(log, ["/joint_states", "/armctl/servos"])}
    for message in read(snapshot, ["/joint_states", "/armctl/servos"]):
        assert whole[message.topic, message.sequence] == message.value
    # The control step knows nothing of a fault that was made up here; up to it the snapshot replays.
    assert check(snapshot).ticks == 41


def wire_of(path: Path) -> list[tuple[int, bool, bytes]]:
    """Every piece of the wire in a file."""
    pieces = [piece for message in read(path, ["/armctl/wire"]) for piece in message.value["pieces"]]
    return [(piece["time_ns"], piece["sent"], piece["data"]) for piece in pieces]


def test_the_wire_around_a_fault_is_in_its_snapshot_alone(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_s=5.0)
    records = faulty(make_records(150, keyframe_ticks=30), 80, 90)
    rig.put(records)
    snapshot, log = sorted(rig.close(), reverse=True)
    fault_ns = records[80].inputs.sample.time_ns
    passed = [piece for record in records for piece in record.wire]
    around = [p for p in passed if fault_ns - 2 * NS_PER_S <= p[0] < records[90].inputs.sample.time_ns]
    assert wire_of(snapshot) == around
    # Six servos are asked and answer in each of 30 ticks.
    assert len(around) == 30 * 12
    assert wire_of(log) == []
    begins = [record.inputs.sample.time_ns for record in records]
    for message, ours in zip(read(snapshot, ["/armctl/wire"]), begins[80:90], strict=True):
        assert message.log_time_ns == WALL_NS + ours


def test_a_second_fault_adds_the_wire_that_is_not_in_the_snapshot_yet_and_nothing_twice(tmp_path: Path) -> None:
    rig = Rig(tmp_path, snapshot_s=10.0)
    records = faulty(faulty(make_records(200, keyframe_ticks=30), 80, 90), 130, 140, "HOT")
    rig.put(records)
    (snapshot, *_) = sorted(rig.close(), reverse=True)
    pieces = wire_of(snapshot)
    assert len(set(pieces)) == len(pieces)
    times_ns = [time_ns for time_ns, _, _ in pieces]
    assert times_ns == sorted(times_ns)
    first_ns, second_ns = (records[tick].inputs.sample.time_ns for tick in (80, 130))
    quiet = [time_ns for time_ns in times_ns if first_ns + NS_PER_S <= time_ns < second_ns - 2 * NS_PER_S]
    assert quiet == []
    assert len([time_ns for time_ns in times_ns if time_ns >= second_ns - 2 * NS_PER_S]) == 30 * 12


def test_the_wire_that_waits_for_a_fault_takes_a_bounded_memory(rig: Rig) -> None:
    rig.put([replace(r, wire=((r.inputs.sample.time_ns, False, bytes(256)),) * 512) for r in RECORDS[:40]])
    assert len(rig.recorder._files._wire) == MAX_WIRE
    assert not any(record.wire for record in rig.recorder._files._history._records)


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


def test_a_snapshot_that_cannot_be_written_disturbs_nothing(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    create, refuse = Disk.create, failing(errno.EIO)
    monkeypatch.setattr(Disk, "create", lambda disk, p: (refuse if p.name.startswith("fault-") else create)(disk, p))
    rig.put(faulty(RECORDS, 30, 40))
    assert ticks(rig.only_log()) == list(range(100))
    assert rig.recorder.problem == ""


def test_a_compactor_that_cannot_start_stops_nothing(tmp_path: Path) -> None:
    rig = Rig(tmp_path, failing(errno.EAGAIN), rotate_s=2.0)
    rig.put(make_records(50))
    assert [tick for path in rig.close() for tick in ticks(path)] == list(range(50))
    assert rig.recorder.problem == ""


def test_old_logs_make_room_and_snapshots_and_takes_stay(tmp_path: Path) -> None:
    (tmp_path / "logs").mkdir()
    old, snapshot = [f"armctl-2025010{day}T000000Z.mcap" for day in range(1, 5)], "fault-20250101T000000Z-HOT.mcap"
    for name in (*old, snapshot):
        (tmp_path / "logs" / name).write_bytes(bytes(2**20))
    rig = Rig(tmp_path, quota_bytes=2**20)
    rig.put(RECORDS[:20])
    assert [path.name for path in rig.close()] == [*old[2:], "armctl-20250615T150645Z-000001.mcap", snapshot]


def test_recording_ends_before_the_disk_is_full_and_begins_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [2**30]
    monkeypatch.setattr(shutil, "disk_usage", lambda _: SimpleNamespace(free=free[0]))
    rig = Rig(tmp_path, free_bytes=2**28)
    take = rig.recorder.begin_take("first")
    rig.put(RECORDS[:20])
    free[0] = 2**27
    rig.put(RECORDS[20:40])
    assert rig.recorder.problem.startswith("NO_SPACE: 128 MiB free")
    with pytest.raises(LogError, match="the take ended early \\(NO_SPACE: 128 MiB free"):
        rig.recorder.end_take()
    free[0] = 2**30
    rig.put(RECORDS[40:])
    assert rig.recorder.problem == ""
    paths = rig.close()
    assert all(info(path).complete for path in [*paths, take])
    assert ticks(paths[0]) == ticks(take) == list(range(ticks(take)[-1] + 1))
    assert ticks(paths[1])[-1] == 99
    assert all(check(path).mismatches == 0 for path in paths)


@pytest.mark.parametrize(("logs", "remedy"), [(1, "delete old logs"), (0, "make room")])
def test_a_full_disk_is_told_with_what_helps_there_and_the_name_of_the_bound(
    tmp_path: Path, logs: int, remedy: str
) -> None:
    rig = Rig(tmp_path, free_bytes=2**60)
    rig.logs.mkdir(exist_ok=True)
    for number in range(logs):
        (rig.logs / f"armctl-20250101T000000Z-{number:06d}.mcap").touch()
    rig.put(RECORDS[:2])
    assert rig.recorder.problem.endswith(f" needed; {remedy} in {rig.logs}, or set log.free_bytes lower")
    rig.recorder.close()


def test_a_file_that_cannot_be_begun_is_tried_again(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("armctl.recording.disk.fcntl.flock", failing(errno.ENOSPC))
    rig.put(RECORDS[:3])
    assert rig.recorder.problem.startswith("NO_SPACE: ")
    monkeypatch.undo()
    rig.put(RECORDS[3:])
    assert rig.recorder.problem == ""
    path = rig.only_log()
    assert ticks(path)[-1] == 99
    assert check(path).mismatches == 0


@pytest.mark.parametrize("step_s", [3600, -86_400 * 365, 86_400 * 4000])
def test_a_step_of_the_wall_clock_begins_another_log_whose_times_are_the_new_ones(rig: Rig, step_s: int) -> None:
    rig.put(RECORDS[:30])
    rig.wall_offset_ns += step_s * NS_PER_S
    rig.put(RECORDS[30:])
    first, second = sorted(rig.close(), key=lambda path: path.name[-11:])
    assert [line["function"] for line in recorder_lines(first)] == ["CLOCK_STEP"]
    assert ticks(first) + ticks(second) == list(range(100))
    assert info(second).facts["previous"] == first.name
    assert info(second).start_s - info(first).start_s == pytest.approx(step_s + info(first).duration_s, abs=0.2)
    assert check(second).mismatches == 0
    assert rig.compacted == [rig.logs]


@pytest.mark.parametrize("wall_s", [2**31 + 86_400, -3600])
def test_a_clock_that_no_stamp_holds_does_not_end_the_log(rig: Rig, wall_s: int) -> None:
    rig.put(RECORDS[:30])
    rig.wall_offset_ns = wall_s * NS_PER_S - rig.clock.now_ns()
    rig.put(RECORDS[30:])
    assert rig.recorder.problem == ""
    logs = sorted(rig.close(), key=lambda path: path.name[-11:])
    assert [tick for path in logs for tick in ticks(path)] == list(range(100))
    assert check(logs[-1]).mismatches == 0


def test_a_log_that_was_taken_away_is_noticed_within_a_second_and_another_begins(rig: Rig) -> None:
    rig.put(RECORDS[:30])
    shutil.rmtree(rig.logs)
    rig.put(RECORDS[30:41])
    path = rig.only_log()
    assert path.suffix == ".mcap"
    assert ticks(path)[0] <= 40
    assert check(path).mismatches == 0


def test_a_folder_that_cannot_be_written_any_more_is_told_within_a_second_and_the_log_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig = Rig(tmp_path, rotate_s=4.0)
    rig.put(RECORDS[:20])
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != rig.logs and access(path, mode))
    rig.put(RECORDS[20:31])
    assert rig.recorder.problem.startswith(f"LOG_ERROR: {rig.logs}: can no longer be written")
    rig.put(RECORDS[31:60])
    assert [path.suffix for path in rig.logs.iterdir()] == [".part"], "no rotation meanwhile"
    monkeypatch.undo()
    rig.put(RECORDS[60:])
    assert rig.recorder.problem == ""
    assert [tick for path in rig.close() for tick in ticks(path)] == list(range(100))


def test_what_was_abandoned_is_recovered_once_recording_goes_on(rig: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    rig.put(RECORDS[:20])
    monkeypatch.setattr(os, "fdatasync", failing(errno.ENOSPC))
    rig.put(RECORDS[20:30])
    monkeypatch.undo()
    assert rig.recorder.problem.startswith("NO_SPACE")
    assert rig.compacted == []
    rig.put(make_records(150)[30:])
    assert rig.recorder.problem == ""
    assert rig.compacted == [rig.logs]
