"""Takes by name."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from armctl.errors import LogError
from armctl.recording import recordings
from armctl.recording.listing import listing
from armctl.recording.writer import LogWriter
from tests.recording.factory import ANCHOR, ARM, CONTEXT, ROBOT, make_records

RECORDS = make_records(70)


def write(folder: Path, name: str, *, finish: bool = True) -> Path:
    writer = LogWriter(folder / f"{name}.mcap", CONTEXT, anchor=ANCHOR)
    for record in RECORDS:
        writer.write_tick(record)
    if finish:
        writer.close()
        return writer.path
    writer.flush()
    writer.abandon()
    return writer.part


def test_a_take_loads_as_joint_positions(tmp_path: Path) -> None:
    take = recordings.load(write(tmp_path, "first"))
    assert (take.name, take.arm_id, take.calibration_hash) == ("first", ARM.arm_id, ARM.calibration_hash)
    assert take.joint_names == ARM.joint_names
    assert (take.samples, take.complete, take.start_ns) == (70, True, ANCHOR.wall_ns)
    assert take.duration_s == pytest.approx(6.9)
    expected = [[joint.position_rad for joint in record.outputs.joints] for record in RECORDS]
    np.testing.assert_array_equal(take.positions_rad, expected)


def test_the_window_of_the_plan_comes_from_the_events(tmp_path: Path) -> None:
    take = recordings.load(write(tmp_path, "run"))
    marks = {event.code: r.inputs.tick for r in RECORDS for event in r.outputs.events if event.code.startswith("PLAN_")}
    assert take.plan_s == pytest.approx((marks["PLAN_BEGIN"] * 0.1, marks["PLAN_END"] * 0.1))
    assert take.plan_positions_rad.shape == (marks["PLAN_END"] - marks["PLAN_BEGIN"] + 1, 6)


def test_a_take_without_a_plan_is_used_whole(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", CONTEXT, anchor=ANCHOR)
    for record in RECORDS[:10]:
        writer.write_tick(record)
    writer.close()
    take = recordings.load(writer.path)
    assert take.plan_s is None
    assert take.plan_positions_rad is take.positions_rad


def test_a_part_is_listed_and_loads_without_its_end(tmp_path: Path) -> None:
    part = write(tmp_path, "crashed", finish=False)
    take = recordings.load(tmp_path / "crashed.mcap")
    assert (take.name, take.path, take.samples, take.complete) == ("crashed", part, 70, False)
    assert [found.name for found in recordings.take_files(tmp_path)] == ["crashed.mcap.part"]


def test_the_list_is_sorted_and_says_what_cannot_be_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    write(tmp_path, "b")
    path = write(tmp_path, "a")
    write(tmp_path, "c.mcap")
    (tmp_path / "a.mcap.part").write_bytes(b"an older part of the same name")
    (tmp_path / "link.mcap").symlink_to(path)
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    (tmp_path / "folder.mcap").mkdir()
    found = listing(tmp_path, ROBOT)
    assert [entry["name"] for entry in found["recordings"]] == ["a", "b", "c.mcap"]
    assert [(entry["name"], "is no MCAP file" in entry["problem"]) for entry in found["unreadable"]] == [
        ("broken", True)
    ]
    assert "broken.mcap" in caplog.text
    assert listing(tmp_path / "nowhere", ROBOT) == {"recordings": []}


def test_renaming_never_overwrites(tmp_path: Path) -> None:
    write(tmp_path, "a")
    write(tmp_path, "b")
    write(tmp_path, "c", finish=False)
    for target in ("b", "c"):
        with pytest.raises(LogError, match="exists already"):
            recordings.rename(tmp_path, "a", target)
    assert recordings.load(recordings.rename(tmp_path, "a", "d")).name == "d"
    assert recordings.load(recordings.rename(tmp_path, "c", "e")).complete
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.mcap", "d.mcap", "e.mcap"]


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a\n", "a" * 65, "ä"])
def test_names_that_are_no_names_are_refused(tmp_path: Path, name: str) -> None:
    write(tmp_path, "a")
    with pytest.raises(LogError, match="a name has"):
        recordings.find(tmp_path, name)
    with pytest.raises(LogError, match="a name has"):
        recordings.rename(tmp_path, "a", name)
    with pytest.raises(LogError, match="a name has"):
        recordings.delete(tmp_path, name)


def test_a_missing_take_is_an_error_that_lists_the_known_ones(tmp_path: Path) -> None:
    write(tmp_path, "a")
    with pytest.raises(LogError, match="known: a"):
        recordings.delete(tmp_path, "b")


def test_deleting_removes_the_take_but_not_one_being_recorded(tmp_path: Path) -> None:
    write(tmp_path, "a")
    recordings.delete(tmp_path, "a")
    live = LogWriter(tmp_path / "live.mcap", CONTEXT, anchor=ANCHOR)
    with pytest.raises(LogError, match="being written"):
        recordings.delete(tmp_path, "live")
    live.close()
    assert [p.name for p in tmp_path.iterdir()] == ["live.mcap"]
