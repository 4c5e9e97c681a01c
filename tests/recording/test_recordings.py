"""Takes by name."""

import os
from pathlib import Path

import numpy as np
import pytest

from armctl.errors import ConfigError
from armctl.recording import recordings
from armctl.recording.recordings import listing
from armctl.recording.writer import LogWriter
from armctl.trajectory.dead_time import moving_part
from tests.recording.factory import ANCHOR, ARM, CONTEXT, ROBOT, make_records, times_s
from tests.recording.logs import write
from tests.recording.refusals import cannot

RECORDS = make_records(70)


def take(folder: Path, name: str, *, finish: bool = True) -> Path:
    return write(folder / f"{name}.mcap", RECORDS, finish=finish)


def test_a_take_loads_as_joint_positions(tmp_path: Path) -> None:
    loaded = recordings.load(take(tmp_path, "first"))
    begin_ns = ANCHOR.epoch_ns(RECORDS[0].inputs.sample.time_ns)
    assert (loaded.name, loaded.arm_id, loaded.calibration_hash) == ("first", ARM.arm_id, ARM.calibration_hash)
    assert loaded.joint_names == ARM.joint_names
    assert (loaded.samples, loaded.complete, loaded.start_ns) == (70, True, begin_ns)
    assert loaded.duration_s == pytest.approx(times_s(RECORDS)[-1])
    expected = [[joint.position_rad for joint in record.outputs.joints] for record in RECORDS]
    np.testing.assert_array_equal(loaded.positions_rad, expected)


def test_the_window_of_the_plan_comes_from_the_events(tmp_path: Path) -> None:
    loaded = recordings.load(take(tmp_path, "run"))
    marks = {event.code: r.inputs.tick for r in RECORDS for event in r.outputs.events if event.code.startswith("PLAN_")}
    window_s = tuple(times_s(RECORDS)[marks[code]] for code in ("PLAN_BEGIN", "PLAN_END"))
    assert loaded.plan_s == pytest.approx(window_s)
    assert loaded.positions_rad[loaded.played].shape == (marks["PLAN_END"] - marks["PLAN_BEGIN"] + 1, 6)


def test_a_take_without_a_plan_is_used_whole(tmp_path: Path) -> None:
    loaded = recordings.load(write(tmp_path / "a.mcap", RECORDS[:10]))
    assert loaded.plan_s is None
    assert loaded.played == moving_part(loaded.positions_rad)


def test_of_a_run_the_plan_is_played_and_of_a_take_what_moves(tmp_path: Path) -> None:
    run = recordings.load(take(tmp_path, "run"))
    motion = recordings.taught(run)
    assert (motion.joints, motion.arm_id, motion.calibration_hash) == (
        ARM.joint_names,
        ARM.arm_id,
        ARM.calibration_hash,
    )
    np.testing.assert_allclose(motion.positions_rad, run.positions_rad[run.played], atol=1e-5)
    assert run.plan_s is not None
    assert motion.duration_s == pytest.approx(run.plan_s[1] - run.plan_s[0], abs=1e-5)
    swing = np.concatenate([np.zeros(20), 0.5 * np.sin(np.linspace(0.0, 1.5, 30)), np.full(20, 0.5)])
    guided = run._replace(plan_s=None, positions_rad=np.repeat(swing[:, None], 6, axis=1))
    assert recordings.taught(guided).duration_s == pytest.approx(2.9, abs=0.4)
    with pytest.raises(ConfigError, match=r"recording run: .*can be played"):
        recordings.taught(guided._replace(plan_s=(0.0, 0.2)))


def test_a_part_is_listed_and_loads_without_its_end(tmp_path: Path) -> None:
    part = take(tmp_path, "crashed", finish=False)
    loaded = recordings.load(tmp_path / "crashed.mcap")
    assert (loaded.name, loaded.path, loaded.samples, loaded.complete) == ("crashed", part, 70, False)
    assert [found.name for found in recordings.take_files(tmp_path)] == ["crashed.mcap.part"]


def test_the_list_is_sorted_and_says_what_cannot_be_read(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    take(tmp_path, "b")
    path = take(tmp_path, "a")
    take(tmp_path, "c.mcap")
    (tmp_path / "a.mcap.part").write_bytes(b"an older part of the same name")
    (tmp_path / "link.mcap").symlink_to(path)
    (tmp_path / "broken.mcap").write_bytes(b"no log")
    (tmp_path / "folder.mcap").mkdir()
    found = listing(tmp_path, ROBOT)
    assert [entry["name"] for entry in found["recordings"]] == ["a", "b", "c.mcap"]
    (broken,) = found["unreadable"]
    assert (broken["name"], "is no MCAP file" in broken["problem"]) == ("broken", True)
    assert "broken.mcap" in caplog.text
    assert listing(tmp_path / "nowhere", ROBOT) == {"recordings": []}


def test_renaming_never_overwrites(tmp_path: Path) -> None:
    take(tmp_path, "a")
    take(tmp_path, "b")
    take(tmp_path, "c", finish=False)
    for target in ("b", "c"):
        cannot(recordings.rename, tmp_path, "a", target, why="exists already")
    assert recordings.load(recordings.rename(tmp_path, "a", "d")).name == "d"
    assert recordings.load(recordings.rename(tmp_path, "c", "e")).complete
    assert sorted(p.name for p in tmp_path.iterdir()) == ["b.mcap", "d.mcap", "e.mcap"]


@pytest.mark.parametrize("name", ["", "../a", "a/b", ".hidden", "a\n", "a" * 65, "ä"])
def test_names_that_are_no_names_are_refused(tmp_path: Path, name: str) -> None:
    take(tmp_path, "a")
    for act, names in ((recordings.find, (name,)), (recordings.rename, ("a", name)), (recordings.delete, (name,))):
        cannot(act, tmp_path, *names, why="a name has")


def test_a_missing_take_is_an_error_that_lists_the_known_ones(tmp_path: Path) -> None:
    take(tmp_path, "a")
    cannot(recordings.delete, tmp_path, "b", why="known: a")


def test_of_many_takes_an_error_names_the_newest(tmp_path: Path) -> None:
    for age_s in range(11):
        path = tmp_path / f"take-{age_s}.mcap"
        path.touch()
        os.utime(path, (1e9 - age_s, 1e9 - age_s))
    newest = ", ".join(f"take-{age_s}" for age_s in range(8))
    cannot(recordings.find, tmp_path, "b", why=f"known: {newest}, and 3 older ones$")


def test_what_is_typed_for_a_recording_is_a_file_or_a_name(tmp_path: Path) -> None:
    take(tmp_path, "a")
    assert recordings.path_of(tmp_path, "a") == tmp_path / "a.mcap"
    for name in ("a.mcap", "./a", "../other/a.mcap", "motion.csv"):
        assert recordings.path_of(tmp_path, name) == Path(name)
    cannot(recordings.path_of, tmp_path, "b", why="known: a")


def test_deleting_removes_the_take_but_not_one_being_recorded(tmp_path: Path) -> None:
    take(tmp_path, "a")
    recordings.delete(tmp_path, "a")
    live = LogWriter(tmp_path / "live.mcap", CONTEXT, anchor=ANCHOR)
    cannot(recordings.delete, tmp_path, "live", why="being written")
    live.close()
    assert [p.name for p in tmp_path.iterdir()] == ["live.mcap"]
