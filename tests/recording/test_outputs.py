"""Whatever the control step says is in the log, and a replay that says anything else differs there."""

from collections.abc import Iterator, Sequence
from dataclasses import fields, is_dataclass, replace
from enum import Enum
from math import inf, nan, nextafter
from pathlib import Path
from typing import Any

import pytest

from armctl.messages import Command, Fault, Goal, Mode, Outputs, TickRecord, Write
from armctl.recording import timeline
from armctl.recording.channels import CYCLE, WRITES
from armctl.recording.reader import read
from armctl.recording.replay import ReplayResult, check
from armctl.sim.virtual_arm import VirtualArm
from tests.recording.altered import with_outputs
from tests.recording.factory import RUN_SCRIPT, make_records
from tests.recording.logs import write


def trip(virtual: VirtualArm) -> Sequence[Command]:
    """A servo shuts itself down."""
    virtual.simulated.servos[2].protect(overloaded=True)
    return ()


def heat(virtual: VirtualArm) -> Sequence[Command]:
    virtual.simulated.servos[4].temperature_degC = 68.0
    return ()


# The arm is switched on, runs to the end of its motion, is about to go to rest for heat, and a servo trips.
RECORDS = make_records(80, {**RUN_SCRIPT, 45: heat, 75: trip}, keyframe_ticks=1)
WRITTEN = next(record for record in RECORDS if len(record.outputs.writes) > 2)
WRITES_TOLD = WRITTEN.outputs.writes
ELSEWHERE = tuple(replace(write, address=14) for write in WRITES_TOLD)
QUIET, MOVING, TRIPPED = RECORDS[1], RECORDS[30], RECORDS[-1]
# Where a replay is to find what is wrong with a field, and fields of which others repeat some: those differ as well.
PLACES = {
    "mode": "/armctl/cycle.mode", "faults": "/armctl/cycle.faults", "progress": "/armctl/cycle.progress",
    "rate": "/armctl/cycle.rate", "rest_in_s": "/armctl/cycle.rest_in_s", "writes": "/armctl/writes",
    "goal": "/joint_commands", "replies": "/armctl/command", "events": "/rosout",
}  # fmt: skip
REPEATED = ("joints", "tool")


def checked(record: TickRecord, path: Path) -> ReplayResult:
    """What a replay says of a log of one tick."""
    return check(write(path, [record], keyframe=RECORDS[record.inputs.tick - 1].keyframe))


def others(name: str, value: Any) -> Iterator[tuple[str, Any]]:
    """Every value that differs from one in a single leaf, or by a missing, a further or a misplaced member."""
    if is_dataclass(value) and not isinstance(value, type):
        for field in fields(value):
            for where, other in others(f"{name}.{field.name}", getattr(value, field.name)):
                yield where, replace(value, **{field.name: other})
    elif isinstance(value, tuple):
        for i, member in enumerate(value):
            for where, other in others(f"{name}[{i}]", member):
                yield where, (*value[:i], other, *value[i + 1 :])
        if name in ("writes", "replies", "events", "faults"):
            yield f"{name}, the last one missing", value[:-1]
            yield f"{name}, one more", (*value, value[-1])
        if len(set(value)) > 1:
            yield f"{name}, in another order", value[::-1]
    elif name.endswith(".severity"):
        yield name, {"info": "warning", "warning": "error", "error": "info"}[value]
    elif isinstance(value, Enum):
        yield from ((name, other) for other in type(value) if other is not value)
    elif isinstance(value, bool | str):
        yield name, f"{value}x" if isinstance(value, str) else not value
    elif isinstance(value, float):
        yield name, nextafter(value, inf)
    else:
        assert value is None or isinstance(value, int), f"{name}: {type(value).__name__} is not changed here"
        yield name, 7 if value is None else value + 1


@pytest.mark.parametrize("name", [field.name for field in fields(Outputs)])
def test_every_leaf_of_the_outputs_is_compared(name: str, tmp_path: Path) -> None:
    record = next(r for r in (MOVING, WRITTEN, TRIPPED, *RECORDS[1:]) if getattr(r.outputs, name))
    assert checked(record, tmp_path / "sound.mcap").mismatches == 0
    changed = list(others(name, getattr(record.outputs, name)))
    assert changed
    for index, (where, value) in enumerate(changed):
        result = checked(with_outputs(record, **{name: value}), tmp_path / f"{index}.mcap")
        assert result.first is not None, where
        assert result.mismatches == 1 or name in REPEATED, where
        assert result.first["tick"] == record.inputs.tick
        assert result.first["field"].startswith(PLACES.get(name, "/")), where
        assert result.first_mismatch.startswith(f"tick {record.inputs.tick}, {result.first['field']}: logged ")


def test_what_is_said_of_the_joints_is_compared_in_a_tick_without_diagnostics(tmp_path: Path) -> None:
    last, before, tick = RECORDS[MOVING.inputs.tick + 1 : MOVING.inputs.tick + 4]
    sound = write(tmp_path / "sound.mcap", [before, tick], keyframe=last.keyframe)
    assert [m.sequence for m in read(sound, ["/diagnostics"])] == [before.inputs.tick]
    for index, (where, value) in enumerate(others("joints", tick.outputs.joints)):
        changed = [before, with_outputs(tick, joints=value)]
        result = check(write(tmp_path / f"{index}.mcap", changed, keyframe=last.keyframe))
        assert result.mismatches > 0, where


@pytest.mark.parametrize(
    ("record", "changes", "field"),
    [
        (QUIET, {"writes": (Write(3, 24, 1, 0),)}, "/armctl/writes"),
        (WRITTEN, {"writes": ()}, "/armctl/writes"),
        (WRITTEN, {"writes": WRITES_TOLD[:-1]}, f"/armctl/writes.writes[{len(WRITES_TOLD) - 1}]"),
        (
            WRITTEN,
            {"writes": ELSEWHERE},
            "/armctl/writes.writes[0].address",
        ),
        (QUIET, {"mode": Mode.TEACHING}, "/armctl/cycle.mode"),
        (QUIET, {"faults": (Fault("HOT", "it is", 5),)}, "/armctl/cycle.faults[0]"),
        (TRIPPED, {"faults": ()}, "/armctl/cycle.faults[0]"),
        (QUIET, {"goal": Goal((512,) * 6, (16,) * 6)}, "/joint_commands"),
        (MOVING, {"goal": None}, "/joint_commands"),
        (QUIET, {"progress": 0.0}, "/armctl/cycle.progress"),
        (MOVING, {"rate": None}, "/armctl/cycle.rate"),
    ],
)
def test_what_comes_from_nothing_or_is_missing_differs_once(
    record: TickRecord, changes: dict[str, Any], field: str, tmp_path: Path
) -> None:
    result = checked(with_outputs(record, **changes), tmp_path / "a.mcap")
    assert result.first is not None
    assert (result.mismatches, result.first["field"]) == (1, field)


def test_floats_that_differ_say_by_how_many_ulps(tmp_path: Path) -> None:
    progress = MOVING.outputs.progress
    assert progress
    for index, value in enumerate((nextafter(progress, inf), nextafter(progress, 0.0))):
        result = checked(with_outputs(MOVING, progress=value), tmp_path / f"{index}.mcap")
        values = {"logged": value, "computed": progress, "ulps": 1}
        assert result.first == {"tick": 30, "field": "/armctl/cycle.progress"} | values


def test_a_difference_is_json_whatever_the_log_holds(tmp_path: Path) -> None:
    result = checked(with_outputs(MOVING, progress=nan), tmp_path / "a.mcap")
    assert result.first is not None
    assert (result.first["logged"], result.first["ulps"]) == ("NaN", None)
    result = checked(with_outputs(QUIET, writes=(WRITTEN.outputs.writes[0],) * 100), tmp_path / "b.mcap")
    assert result.first is not None
    assert len(result.first["logged"]["writes"]) == 100
    assert len(result.first_mismatch) < 300


def results(path: Path) -> list[tuple[int, tuple[bool, ...]]]:
    """Tick and confirmations of every message about writes."""
    return [(m.sequence, tuple(w["confirmed"] for w in m.value["writes"])) for m in read(path, [WRITES])]


def test_writes_are_read_back_with_their_results_and_quiet_ticks_have_none(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS)
    told = [record for record in RECORDS if record.outputs.writes]
    assert 0 < len(told) < 20
    assert results(path) == [(record.inputs.tick, record.confirmed) for record in told]
    for message, record in zip(read(path, [WRITES]), told, strict=True):
        found = [Write(**{key: w[key] for key in Write.__slots__}) for w in message.value["writes"]]
        assert tuple(found) == record.outputs.writes
    sent = [m.value["goal_sent"] for m in read(path, [CYCLE])]
    assert sent == [record.goal_sent for record in RECORDS] == [record.outputs.goal is not None for record in RECORDS]


FAILED = replace(WRITTEN, confirmed=(False, *WRITTEN.confirmed[1:]))
LOST = replace(WRITTEN, goal_sent=not WRITTEN.goal_sent)


@pytest.mark.parametrize("changed", [FAILED, LOST])
def test_what_the_world_answered_is_logged_and_not_compared(changed: TickRecord, tmp_path: Path) -> None:
    result = checked(changed, tmp_path / "a.mcap")
    assert (result.ticks, result.mismatches) == (1, 0)
    assert results(tmp_path / "a.mcap") == [(changed.inputs.tick, changed.confirmed)]
    assert [m.value["goal_sent"] for m in read(tmp_path / "a.mcap", [CYCLE])] == [changed.goal_sent]


def test_a_person_sees_what_was_written_and_who_did_not_confirm_it(tmp_path: Path) -> None:
    record = replace(WRITTEN, confirmed=(True, False))  # and what has no result is not confirmed either
    record = with_outputs(record, writes=(Write(2, 34, 2, 102), Write(4, 34, 2, 102), Write(5, 45, 1, 0)))
    for name, tick, level in (("a", WRITTEN, 20), ("b", record, 30)):
        told = timeline.load(write(tmp_path / f"{name}.mcap", [tick])).happenings
        (shown,) = [one for one in told if one.code == "WRITE"]
        assert shown.level == level
    assert shown.text == "wrote torque_limit = 102 to servo 2, 4 (not confirmed); 45 = 0 to servo 5 (not confirmed)"
