"""The index of a folder of logs: true to them, made anew whenever it is not, and quick to ask."""

import fcntl
import json
import os
import shutil
import sqlite3
import subprocess
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from armctl.errors import ConfigError, LogError
from armctl.messages import Event
from armctl.recording import index as index_module
from armctl.recording import search
from armctl.recording.entry import diff
from armctl.recording.index import INDEX, Index, bring_up_to_date
from armctl.recording.notes import NOTES, add_note
from armctl.recording.reader import info
from armctl.recording.timeline import load
from armctl.recording.writer import LogContext
from tests.recording.altered import later, with_outputs
from tests.recording.factory import CONTEXT, make_records
from tests.recording.logs import spoilt, write
from tests.recording.refusals import cannot

RECORDS = make_records(100, keyframe_ticks=40)
WEEK_NS = 604_800 * 10**9
TRIPPED = Event("error", "TRIPPED", "servo 3 (elbow): shut itself down", 3)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with a log a week for five weeks, one of which has a fault, a cut one and one that is none."""
    folder = tmp_path_factory.mktemp("logs")
    for week in range(5):
        records = [later(record, week * WEEK_NS) for record in RECORDS]
        if week == 2:
            records[50] = with_outputs(records[50], events=(TRIPPED,))
        write(folder / f"armctl-{week}.mcap", records)
    (folder / "cut.mcap.part").write_bytes((folder / "armctl-0.mcap").read_bytes()[:30_000])
    (folder / "none.mcap").write_bytes(b"nothing")
    return folder


@pytest.fixture
def folder(made: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(made, tmp_path / "logs"))


def updated(folder: Path) -> Index:
    index = Index(folder)
    index.read(index.new())
    return index


def asked(index: Index, expression: str) -> list[tuple[str, str]]:
    """Log and code of what is found."""
    return [(Path(row["log"]).name, row["code"]) for row in search.find(index, expression)]


def test_every_log_is_listed_with_what_it_says_of_itself_and_what_came_up(folder: Path) -> None:
    with updated(folder) as index:
        logs = {Path(row["path"]).name: row for row in search.listing(index)}
    assert len(logs) == 7
    one = logs["armctl-2.mcap"]
    assert (one["faults"], one["complete"], one["simulated"]) == (["TRIPPED"], True, False)
    assert one["arm_id"] == CONTEXT.arm.arm_id
    assert one["start"].startswith("2025-06-29T15:06:40")
    assert one["duration_s"] == pytest.approx(load(folder / "armctl-2.mcap").duration_s)
    assert one["size_bytes"] == (folder / "armctl-2.mcap").stat().st_size
    assert (logs["armctl-0.mcap"]["faults"], logs["cut.mcap.part"]["complete"]) == ([], False)
    assert (logs["none.mcap"]["start"], logs["none.mcap"]["complete"]) == (None, False)
    assert "is no MCAP file" in logs["none.mcap"]["problem"]


def test_complete_means_in_a_list_what_it_means_of_one_log(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", RECORDS[:5]).read_bytes()
    begin = int.from_bytes(whole[-8 - 20 : -8 - 12], "little")  # of the summary
    (tmp_path / "logs").mkdir()
    for place in range(begin - 20, len(whole), 97):
        spoiled = whole[:place] + bytes([whole[place] ^ 1]) + whole[place + 1 :]
        (tmp_path / "logs" / f"{place}.mcap").write_bytes(spoiled)
    with updated(tmp_path / "logs") as index:
        found = {row["path"]: row["complete"] for row in search.listing(index)}
    assert found == {path: info(Path(path)).complete for path in found}
    assert {*found.values()} == {True, False}


def reread(index: Index) -> int:
    """How many logs were read."""
    new = index.new()
    index.read(new)
    return len(new)


def test_a_log_is_read_once_and_again_when_it_has_changed(folder: Path) -> None:
    with Index(folder) as index:
        assert [reread(index), reread(index)] == [7, 0]
        write(folder / "armctl-6.mcap", RECORDS[:20])
        (folder / "armctl-4.mcap").unlink()
        os.utime(folder / "armctl-3.mcap", ns=(1, 1))
        assert [reread(index), reread(index)] == [2, 0]
        names = [Path(row["path"]).name for row in search.listing(index)]
        assert ("armctl-4.mcap" in names, "armctl-6.mcap" in names) == (False, True)
        events = index.ask("SELECT count(*) AS n FROM events WHERE log NOT IN (SELECT id FROM logs)")
        assert events == [{"n": 0}]


@pytest.mark.parametrize("spoil", ["lost", "garbage", "other", "truncated"])
def test_an_index_that_is_lost_or_damaged_is_made_anew(folder: Path, spoil: str) -> None:
    with updated(folder) as index:
        before = search.listing(index), search.find(index, "code:STATE")
    path = folder / INDEX
    assert index.path == path
    if spoil == "lost":
        path.unlink()
    elif spoil == "garbage":
        path.write_bytes(b"garbage" * 1000)
    elif spoil == "truncated":
        path.write_bytes(path.read_bytes()[:5000])
    else:
        with sqlite3.connect(path) as other:
            other.execute("PRAGMA user_version = 99")
    if spoil == "truncated":
        with suppress(LogError):  # noticed when it was open already: the next one makes it anew
            updated(folder).__exit__(None, None, None)
    with updated(folder) as index:
        assert (search.listing(index), search.find(index, "code:STATE")) == before


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[list[str]]:
    """Commands that were to run in the background, and do not."""
    found: list[list[str]] = []
    monkeypatch.setattr(index_module, "FEW", 3)
    monkeypatch.setattr(index_module, "Popen", lambda command, **_: found.append(command))
    return found


def test_what_an_answer_does_not_wait_for_is_read_in_the_background_and_told(
    folder: Path, started: list[list[str]]
) -> None:
    for age, path in enumerate(sorted(folder.iterdir(), reverse=True)):
        os.utime(path, ns=(10**9 - age, 10**9 - age))
    newest = sorted(path.name for path in folder.iterdir())[-3:]
    with Index(folder) as index:
        index.catch_up()
        assert (index.unread, sorted(row["name"] for row in index.ask("SELECT name FROM logs"))) == (4, newest)
    (command,) = started
    root = Path(index_module.__file__).parents[2]
    subprocess.run(command, check=True, cwd=root, timeout=300)
    with Index(folder) as index, updated(Path(shutil.copytree(folder, folder.with_name("b")))) as other:
        index.catch_up()
        assert (index.unread, len(started)) == (0, 1)
        ours, theirs = ([row | {"path": ""} for row in search.listing(one)] for one in (index, other))
        assert ours == theirs
        assert asked(index, "level:info") == asked(other, "level:info")


def test_one_process_at_a_time_reads_a_folder(folder: Path, started: list[list[str]]) -> None:
    lock = os.open(folder, os.O_RDONLY)
    fcntl.flock(lock, fcntl.LOCK_EX)
    bring_up_to_date(folder)
    with Index(folder) as index:
        index.catch_up()
        assert index.unread == 4
    os.close(lock)
    bring_up_to_date(folder)
    with Index(folder) as index:
        index.catch_up()
        assert index.unread == 0
    assert len(started) == 1


def test_two_who_read_a_log_at_once_keep_it_once(folder: Path) -> None:
    with Index(folder) as one, updated(folder) as other:
        one.read(["armctl-2.mcap"])
        assert len(asked(other, "code:TRIPPED")) == 1
        assert other.ask("SELECT count(*) AS n FROM events WHERE log NOT IN (SELECT id FROM logs)") == [{"n": 0}]


def test_events_are_found_by_code_servo_level_arm_log_time_and_text(folder: Path) -> None:
    with updated(folder) as index:
        assert asked(index, "code:TRIPPED") == [("armctl-2.mcap", "TRIPPED")]
        assert asked(index, "servo:3 level:error") == [("armctl-2.mcap", "TRIPPED")]
        assert asked(index, "servo:4 level:error") == []
        assert asked(index, "SHUT elbow") == [("armctl-2.mcap", "TRIPPED")]
        assert asked(index, "level:error arm:nobody") == []
        everything = asked(index, "code:PLAN_BEGIN log:armctl*")
        assert [name for name, _ in everything] == [f"armctl-{week}.mcap" for week in range(5)]
        assert [n for n, _ in asked(index, "code:PLAN_BEGIN after:2025-06-28")] == [
            f"armctl-{w}.mcap" for w in (2, 3, 4)
        ]
        assert len(asked(index, "code:PLAN_BEGIN before:2025-06-28T00:00+00:00 log:armctl*")) == 2
        (found,) = search.find(index, "code:TRIPPED")
        since_s = (RECORDS[50].inputs.sample.time_ns - RECORDS[0].inputs.sample.time_ns) / 1e9
        assert found["time_s"] == pytest.approx(since_s, abs=1e-5)


# What sqlite3 itself fails at is among them: 65 bits, half of a pair of surrogates, over a thousand conditions.
@pytest.mark.parametrize(
    ("wrong", "told"),
    [
        ("servo:x", "servo:x: "), (f"servo:{2**63}", "from 0 to 253"), ("after:never", "2025-"), ("level:loud", "info"),
        ("load>0.1 code:HOT", "ask twice"), ("load>=0.1", "by < or >"), ("hum>3", "load"), ("arm:\ud800", "ud800"),
        ("\udfff", "udfff"), ("a " * 1500, "1500 words: .* 100 at most"),
    ],
)  # fmt: skip
def test_a_word_that_means_nothing_is_refused(made: Path, tmp_path: Path, wrong: str, told: str) -> None:
    shutil.copy(made / "armctl-2.mcap", tmp_path)
    with updated(tmp_path) as index:
        with pytest.raises(ConfigError, match=f"^armctl log find: .*{told}"):
            search.find(index, wrong)
        assert index.path.exists()


@given(st.lists(st.sampled_from([*search._TERMS, *search.READINGS, *":<>=*[", "9" * 20]) | st.text(), max_size=8))
@settings(max_examples=200, suppress_health_check=[HealthCheck.function_scoped_fixture])
def test_whatever_is_asked_is_answered_or_refused(tmp_path: Path, words: list[str]) -> None:
    with Index(tmp_path) as index, suppress(ConfigError):
        search.find(index, "".join(words))


def test_quotes_and_wildcards_are_only_text(folder: Path) -> None:
    with updated(folder) as index:
        for word in ("'", '"', "%", "_;--", "'); DROP TABLE logs; --", "code:' OR 1=1 --"):
            assert asked(index, word) == []
        assert len(search.listing(index)) == 7


def test_what_servos_went_through_is_found_by_the_minute(folder: Path) -> None:
    timeline = load(folder / "armctl-0.mcap")
    with updated(folder) as index:
        rows = index.ask("SELECT minutes.*, name FROM minutes JOIN logs ON logs.id = log WHERE name = 'armctl-0.mcap'")
        assert {row["joint"] for row in rows} == set(timeline.arm.joint_names)
        for j, (name, servo_id) in enumerate(zip(timeline.arm.joint_names, timeline.arm.servo_ids, strict=True)):
            mine = [row for row in rows if row["servo_id"] == servo_id]
            assert {row["joint"] for row in mine} == {name}
            assert max(row["temperature_degC"] for row in mine) == timeline.temperature_degC[:, j].max()
            assert max(row["load_ratio"] for row in mine) == pytest.approx(np.abs(timeline.load_ratio[:, j]).max())
            assert min(row["voltage_V"] for row in mine) == pytest.approx(timeline.voltage_V[:, j].min())
            error_deg = np.degrees(np.abs(timeline.position_rad[:, j] - timeline.goal_rad[:, j]))
            if len(mine) == 1:
                assert mine[0]["error_deg"] == pytest.approx(np.nanmean(error_deg), abs=1e-6)
        most = max(row["load_ratio"] for row in rows)
        found = search.find(index, f"load>{most - 1e-6:.6f} log:armctl-0*")
        assert len(found) >= 1
        assert {row["code"] for row in found} == {"LOAD"}
        assert f"load {most:.4g}" in found[0]["text"]
        assert search.find(index, f"load>{most + 1e-3:.6f}") == []
        servo = found[0]["servo_id"]
        assert search.find(index, f"load>{most - 1e-6:.6f} servo:{servo % 6 + 1}") == []


def test_joints_are_followed_from_week_to_week(folder: Path) -> None:
    with updated(folder) as index:
        rows = search.stats(index, "week")
        first = [row for row in rows if row["joint"] == CONTEXT.arm.joint_names[0]]
    assert len(first) == 5
    assert [row["from"] for row in first] == sorted(row["from"] for row in first)
    assert first[0]["change"]["temperature_degC"] == pytest.approx(0.0, abs=1e-9)
    assert first[0]["hours"] > 0.0


def test_a_joint_that_grows_hotter_week_by_week_shows_by_how_much(tmp_path: Path) -> None:
    for week in range(4):
        records = []
        for record in (later(record, week * WEEK_NS) for record in RECORDS[:20]):
            first, *others = record.inputs.sample.servos
            hot = bytearray(first.registers)
            hot[43 - 24] = 40 + 3 * week
            sample = replace(record.inputs.sample, servos=(replace(first, registers=bytes(hot)), *others))
            records.append(replace(record, inputs=replace(record.inputs, sample=sample)))
        write(tmp_path / f"{week}.mcap", records)
    with updated(tmp_path) as index:
        changes = {row["joint"]: row["change"]["temperature_degC"] for row in search.stats(index, "week")}
    hotter, same, *_ = CONTEXT.arm.joint_names
    assert changes[hotter] == pytest.approx(3.0)
    assert changes[same] == pytest.approx(0.0, abs=1e-9)


def test_notes_are_shown_and_found_and_outlive_the_index(folder: Path) -> None:
    add_note(folder / "armctl-1.mcap", "new gripper, it's lighter")
    add_note(folder / "armctl-1.mcap", "[bold]")
    (folder / NOTES).write_text(
        (folder / NOTES).read_text() + 'no json\n{"log": 3}\n{"log": "gone.mcap", "text": "x"}\n'
    )
    for _ in range(2):
        with updated(folder) as index:
            noted = {Path(row["path"]).name: row["notes"] for row in search.listing(index) if row["notes"]}
            assert noted == {"armctl-1.mcap": ["new gripper, it's lighter", "[bold]"]}
            assert asked(index, "gripper") == [("armctl-1.mcap", "NOTE")]
            assert asked(index, "code:NOTE gone") == []
        index.path.unlink()
    cannot(add_note, folder / "nothing.mcap", "x", why="there is no such log")
    cannot(add_note, folder / "armctl-1.mcap", " ", why="a note without a word says nothing")


def test_odd_names_and_notes_of_some_logs_disturb_no_other(tmp_path: Path) -> None:
    huge = Event("error", "TRIPPED", f"a (servo {10**20}): shut itself down", None)
    half = json.dumps({"event": "X\udce9", "text": "caf\udce9 \U0001f600"})
    log = write(tmp_path / "a.mcap", [*RECORDS[:5], with_outputs(RECORDS[5], events=(huge,))], notes={3: [half]})
    Path(os.fsdecode(os.fsencode(tmp_path) + b"/caf\xe9.mcap")).write_bytes(log.read_bytes())
    (tmp_path / "empty.mcap").touch()
    add_note(log, "caf\udce9")
    add_note(tmp_path / "empty.mcap", "why is it empty?")
    with updated(tmp_path) as index:
        noted = {Path(row["path"]).name: row["notes"] for row in search.listing(index)}
        assert noted == {"a.mcap": ["caf?"], "empty.mcap": ["why is it empty?"]}
        assert asked(index, "caf?") == [("a.mcap", "NOTE"), ("a.mcap", "X?")]
        assert asked(index, "code:TRIPPED") == [("a.mcap", "TRIPPED")]
        (why,) = search.find(index, "code:NOTE why")
        assert (why["time_s"], why["time"][:4]) == (0.0, search.iso((tmp_path / "empty.mcap").stat().st_mtime)[:4])
        json.dumps([search.listing(index), search.find(index, ""), search.stats(index, "day")]).encode()


def test_two_logs_are_compared_by_every_figure(folder: Path) -> None:
    rows = {row["quantity"]: row for row in diff(folder / "armctl-1.mcap", folder / "armctl-2.mcap")}
    assert rows["events, error"] == {"quantity": "events, error", "a": 0, "b": 1, "difference": 1}
    assert rows["arm_id"]["difference"] is None
    joint = CONTEXT.arm.joint_names[0]
    assert rows[f"{joint}.temperature_degC"]["difference"] == 0.0
    json.dumps(list(rows.values()), allow_nan=False)
    cannot(diff, folder / "armctl-1.mcap", folder / "none.mcap", why="is no MCAP file")
    cannot(diff, folder / "armctl-1.mcap", folder / "no.mcap", why=r"no\.mcap: cannot be read: No such file")


def test_a_folder_that_cannot_be_written_is_indexed_elsewhere(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    access = os.access
    monkeypatch.setattr(os, "access", lambda path, mode: path != folder and access(path, mode))
    with updated(folder) as index:
        assert index.path.parent == tmp_path / "cache" / "armctl"
        assert len(search.listing(index)) == 7
    assert not (folder / INDEX).exists()
    (tmp_path / "file").touch()
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with updated(folder) as index:
        assert len(search.listing(index)) == 7
    cannot(Index, tmp_path / "nowhere", why="is no folder with logs")


def test_a_disk_without_room_for_an_index_is_looked_through_all_the_same(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    connect = sqlite3.connect

    def full(path: Path, **options: Any) -> Any:
        if path.parent == folder:
            raise sqlite3.OperationalError("database or disk is full")
        return connect(path, **options)

    (folder / INDEX).touch()  # what another attempt left
    monkeypatch.setattr(sqlite3, "connect", full)
    with updated(folder) as index:
        assert index.path.parent == tmp_path / "cache" / "armctl"
        assert len(search.listing(index)) == 7


def test_logs_damaged_anywhere_disturb_no_other(folder: Path) -> None:
    data = (folder / "armctl-0.mcap").read_bytes()
    places = range(0, len(data), len(data) // 30)
    for count, place in enumerate(places):
        (folder / f"z{count}.mcap").write_bytes(data[:place] + bytes(40) + data[place + 40 :])
    (folder / "spoilt.mcap").write_bytes(spoilt(data, 1, 2))
    with updated(folder) as index:
        logs = {Path(row["path"]).name: row for row in search.listing(index)}
        assert logs["armctl-2.mcap"]["faults"] == ["TRIPPED"]
        assert not logs["spoilt.mcap"]["complete"]
        assert len(logs) == 7 + len(places) + 1


def test_a_servo_that_never_answered_has_no_minutes(tmp_path: Path) -> None:
    records = []
    for record in RECORDS[:10]:
        one, *rest = record.inputs.sample.servos
        silent = replace(one, registers=b"", stamp_ns=0, fresh=False, problem="NO_REPLY")
        sample = replace(record.inputs.sample, servos=(silent, *rest))
        records.append(replace(record, inputs=replace(record.inputs, sample=sample)))
    context: LogContext = CONTEXT
    write(tmp_path / "a.mcap", records, context=context)
    with updated(tmp_path) as index:
        servos = {row["servo_id"] for row in index.ask("SELECT servo_id FROM minutes")}
    assert servos == set(CONTEXT.arm.servo_ids[1:])
