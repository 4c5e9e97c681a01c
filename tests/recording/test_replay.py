"""What replay knows beyond one file: clocks of merged files, and a comparison that goes on message by message."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armctl.control.step import step
from armctl.messages import Hold, Inputs, Outputs, Release, Teach, TeachEnd
from armctl.recording import reader, recordings, replay
from armctl.recording.channels import Anchor
from armctl.recording.edit import merge, trim
from armctl.recording.log_file import LogFile
from armctl.recording.replay import LogSetup, Rerun, check, log_setup
from tests.recording.altered import with_sample
from tests.recording.factory import ANCHOR, ARM, PERIOD_S, ROBOT, RUN_SCRIPT, make_records
from tests.recording.logs import of_an_older_build, recorder_lines, replayed, write
from tests.recording.refusals import cannot

RECORDS = make_records(100, keyframe_ticks=40)


def test_a_tick_goes_by_the_anchor_its_log_time_is_of() -> None:
    later = Anchor(ANCHOR.wall_ns + 777, ANCHOR.monotonic_ns)
    setup = LogSetup(ARM, ROBOT, PERIOD_S, ANCHOR, (later,))
    time_ns = ANCHOR.monotonic_ns + 10**9
    assert setup.anchor_of(time_ns, ANCHOR.epoch_ns(time_ns)) == ANCHOR
    assert setup.anchor_of(time_ns, later.epoch_ns(time_ns)) == later
    assert setup.anchor_of(time_ns, 12345) == ANCHOR  # of none: compared with the first, and found to differ


def test_the_state_is_known_after_every_tick_from_the_first_keyframe_on(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS)
    known = []
    with LogFile(path) as log:
        rerun = Rerun(log, log_setup(log))
        for message in log.messages():
            rerun.take(message)
            if message.topic == "/armctl/cycle":
                known.append(rerun.state is not None)
    assert known == [False] + [True] * 99
    assert (rerun.ticks, rerun.mismatches, rerun.keyframes) == (99, 0, 3)


def test_anchors_that_cannot_be_read_are_an_error_of_the_log(tmp_path: Path) -> None:
    with LogFile(write(tmp_path / "a.mcap", RECORDS)) as log:
        log.metadata[replay.MERGED] = {"anchors": "1/2/3 x"}
        cannot(log_setup, log)


def test_replay_gives_the_logged_bytes(log: Path) -> None:
    fractions: list[float] = []
    result = check(log, fractions.append)
    assert (result.ticks, result.mismatches, result.first_mismatch) == (99, 0, "")
    assert result.messages > 3 * 99
    assert result.realtime_ratio > 1.0
    assert fractions
    assert all(0.0 < fraction <= 1.0 for fraction in fractions)


def test_replay_covers_teaching_stops_and_refusals(tmp_path: Path) -> None:
    script = {**RUN_SCRIPT, 30: (Hold(3),), 45: (Teach(4), Release(5)), 60: (TeachEnd(6),)}
    assert replayed(write(tmp_path / "a.mcap", make_records(80, script, keyframe_ticks=25))) == (79, 0)


def test_replay_tells_a_step_that_does_otherwise(log: Path) -> None:

    def other(before: Any, inputs: Inputs, *given: Any) -> tuple[Any, Outputs]:
        state, outputs = step(before, inputs, *given)
        if inputs.tick == 50:
            first, *others = outputs.joints
            outputs = replace(outputs, joints=(replace(first, load_ratio=first.load_ratio + 1e-15), *others))
        return state, outputs

    result = check(log, step=other)
    assert result.mismatches == 1
    assert "tick 50, /joint_states.effort[0]: " in result.first_mismatch


def test_replay_goes_on_at_the_next_keyframe_after_a_gap(tmp_path: Path) -> None:
    assert replayed(write(tmp_path / "gap.mcap", [*RECORDS[:30], *RECORDS[33:]])) == (29 + 59, 0)
    dropped = write(tmp_path / "dropped.mcap", [*RECORDS[:30], replace(RECORDS[30], dropped=3), *RECORDS[31:]])
    assert replayed(dropped) == (29 + 59, 0)
    assert [line["function"] for line in recorder_lines(dropped)] == ["DROPPED"]


@pytest.mark.parametrize("begin", [41, 55])
def test_a_file_that_begins_after_a_keyframe_replays_from_its_beginning(tmp_path: Path, begin: int) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[begin:], keyframe=RECORDS[40].keyframe, inputs_only=RECORDS[41:begin])
    assert replayed(path) == (100 - begin, 0)
    assert reader.ticks(path).position_rad.shape == (100 - begin, 6)
    assert recordings.load(path).duration_s == pytest.approx((99 - begin) / 10.0)


def test_a_step_that_cannot_take_the_log_is_a_log_error(log: Path) -> None:
    def broken(*_: object) -> tuple[Any, Outputs]:
        raise IndexError("no")

    cannot(check, log, step=broken, why="tick 1: the control step cannot take it")


def test_a_log_of_a_build_without_the_writes_replays_and_says_what_was_not_compared(log: Path, tmp_path: Path) -> None:
    old = of_an_older_build(log, tmp_path / "old.mcap")
    result, now = check(old), check(log)
    assert (result.ticks, result.mismatches) == (99, 0)
    assert (result.not_compared, now.not_compared) == (("/armctl/writes", "/armctl/cycle"), ())
    writes = sum(bool(record.outputs.writes) for record in RECORDS[1:])
    assert result.messages == now.messages - 99 - writes
    trim(old, tmp_path / "part.mcap", 2.05, 5.0)
    assert replayed(tmp_path / "part.mcap") == (30, 0)
    new, types = write(tmp_path / "b.mcap", RECORDS[:5]), "has another type for /armctl/cycle than"
    cannot(merge, [new, old], tmp_path / "c.mcap", why=f"{types} .*two versions of armctl")


def test_a_log_of_other_servos_or_states_is_a_log_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[41:50], keyframe='{"phase":"asleep"}')
    cannot(check, path, why="cannot be understood")
    servos = tuple(replace(reading, servo_id=reading.servo_id + 1) for reading in RECORDS[41].inputs.sample.servos)
    path = write(tmp_path / "b.mcap", [with_sample(RECORDS[41], servos=servos)], keyframe=RECORDS[40].keyframe)
    cannot(check, path, why="servos")
    monkeypatch.setattr(replay, "validate", lambda *_: (_ for _ in ()).throw(ValueError("no")))
    cannot(check, path, why="not written by armctl")
