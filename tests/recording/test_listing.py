"""What `recordings list` says of each take: never an exception, whatever lies in the folder."""

import json
import math
import random
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from armctl.messages import Event
from armctl.recording import recordings
from armctl.recording.recordings import describe, listing
from tests.recording.altered import with_outputs, with_sample
from tests.recording.factory import ARM, ROBOT, make_records, times_s
from tests.recording.logs import write

RECORDS = make_records(6, {})
N = len(ARM.joints)
ANY = st.floats(allow_nan=False, allow_infinity=False)


def write_take(path: Path, rows: Sequence[Sequence[float]], *, plan: bool = False, note: str = "") -> Path:
    """A finished take of these joint positions [rad]; `plan`: with a window of a plan that holds no sample."""
    records = []
    for record, row in zip(RECORDS, rows, strict=False):
        joints = tuple(replace(joint, position_rad=q) for joint, q in zip(record.outputs.joints, row, strict=True))
        records.append(with_outputs(record, joints=joints))
    if plan:
        joints = tuple(replace(joint, known=False) for joint in RECORDS[0].outputs.joints)
        later = with_sample(RECORDS[0], time_ns=RECORDS[-1].inputs.sample.time_ns + 1)
        marks = [(Event("info", code, ""),) for code in ("PLAN_BEGIN", "PLAN_END")]
        records += [with_outputs(later, joints=joints, tool=None, events=mark) for mark in marks]
    return write(path, records, notes={1: [note]} if note else {})


@settings(max_examples=80)
@given(st.lists(st.lists(ANY, min_size=N, max_size=N), max_size=6), st.booleans(), st.booleans())
@example([], False, False)
@example([[0.1] * N], False, True)
@example([[0.1] * N] * 2, False, False)
@example([[1e308] * N, [-1e308] * N], False, False)
@example([[0.1] * N, [0.1 + 1e-17] * N, [0.1] * (N - 1) + [0.1 + 1e-16]], False, False)
def test_every_take_is_listed_with_its_figures_or_with_what_is_wrong(
    tmp_path_factory: pytest.TempPathFactory, rows: list[list[float]], same: bool, plan: bool
) -> None:
    folder = tmp_path_factory.mktemp("takes")
    rows = [rows[0]] * len(rows) if same and rows else rows
    path = write_take(folder / "a.mcap", rows, plan=plan)
    found = listing(folder, ROBOT)
    json.dumps(found, allow_nan=False)
    if not rows:
        assert found["recordings"] == []
        (entry,) = found["unreadable"]
        assert (entry["name"], entry["path"]) == ("a", str(path))
        assert "no joint states" in entry["problem"]
        return
    (entry,) = found["recordings"]
    assert "unreadable" not in found
    assert (entry["name"], entry["path"], entry["samples"]) == ("a", str(path), len(rows))
    assert entry["duration_s"] == pytest.approx(times_s(RECORDS)[len(rows) - 1])
    figures = entry["mean_error_mm"], entry["max_error_mm"]
    if same or plan or len(rows) == 1:
        assert figures == (None, None)
    assert figures == (None, None) or all(math.isfinite(figure) for figure in figures)


def test_a_take_that_was_cut_at_any_byte_disturbs_no_other(tmp_path: Path) -> None:
    whole = write_take(tmp_path / "whole.mcap", [[0.1 * i] * N for i in range(6)])
    data, rng = whole.read_bytes(), random.Random(1)
    expected = listing(tmp_path, ROBOT)["recordings"]
    cut = tmp_path / "cut.mcap"
    for place in [*range(12), *(rng.randrange(len(data)) for _ in range(60)), len(data) - 1]:
        cut.write_bytes(data[:place])
        found = listing(tmp_path, ROBOT)
        names = [entry["name"] for entry in (*found["recordings"], *found.get("unreadable", ()))]
        assert sorted(names) == ["cut", "whole"]
        assert found["recordings"][-1:] == expected
        assert all(entry["problem"] for entry in found.get("unreadable", ()))


def test_a_take_of_an_arm_with_fewer_joints_has_no_errors_to_show(tmp_path: Path) -> None:
    recording = recordings.load(write_take(tmp_path / "a.mcap", [[0.1 * i] * N for i in range(3)]))
    assert describe(recording._replace(positions_rad=recording.positions_rad[:, :2]), ROBOT)["mean_error_mm"] is None


@pytest.mark.parametrize("note", ["no JSON", "[]", "5", '{"event":"VIA_MARK"}', '{"request":1}', "[" * 100_000])
def test_notes_that_are_no_via_marks_are_passed_over(tmp_path: Path, note: str) -> None:
    take = recordings.load(write_take(tmp_path / "a.mcap", [[0.1] * N] * 2, note=note))
    assert describe(take, ROBOT, with_marks=True)["marks"] == []


def test_a_via_mark_is_shown(tmp_path: Path) -> None:
    mark = {"tick": 4, "position_m": [0.1, 0.2, 0.3], "joints_rad": [0.0] * N}
    note = json.dumps({"event": "VIA_MARK", "more": 1, **mark})
    take = recordings.load(write_take(tmp_path / "a.mcap", [[0.1] * N] * 2, note=note))
    assert describe(take, ROBOT, with_marks=True)["marks"] == [mark]
