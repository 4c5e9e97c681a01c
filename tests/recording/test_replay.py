"""What replay knows beyond one file: clocks of merged files, and a comparison that goes on message by message."""

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armctl.clock import NS_PER_S
from armctl.control.step import step
from armctl.errors import LogError
from armctl.messages import Hold, Inputs, Outputs, Release, Teach, TeachEnd
from armctl.recording import reader, recordings, replay
from armctl.recording.channels import TOPICS, Anchor
from armctl.recording.chunks import ChunkWriter
from armctl.recording.edit import merge, trim
from armctl.recording.log_file import LogFile
from armctl.recording.recover import recover
from armctl.recording.replay import LogSetup, Rerun, check, log_setup
from armctl.recording.rewrite import Rewrite
from proving.damage import chunk_places
from tests.recording.altered import later, with_sample
from tests.recording.factory import ANCHOR, ARM, PERIOD_S, ROBOT, RUN_SCRIPT, make_records
from tests.recording.logs import messages, of_an_older_build, recorder_lines, replayed, spoilt, write
from tests.recording.refusals import cannot

RECORDS = make_records(100, keyframe_ticks=40)


def test_a_tick_goes_by_the_anchor_its_log_time_is_of() -> None:
    later = Anchor(ANCHOR.wall_ns + 777, ANCHOR.monotonic_ns)
    setup = LogSetup(ARM, ROBOT, PERIOD_S, ANCHOR, (later,))
    time_ns = ANCHOR.monotonic_ns + 10**9
    assert setup.anchor_of(time_ns, ANCHOR.epoch_ns(time_ns)) == ANCHOR
    assert setup.anchor_of(time_ns, later.epoch_ns(time_ns)) == later
    assert setup.anchor_of(time_ns, 12345) == ANCHOR  # of none: compared with the first, and found to differ


def test_the_state_is_known_after_every_tick_from_the_very_first_on(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS)
    known = []
    with LogFile(path) as log:
        rerun = Rerun(log, log_setup(log))
        for message in log.messages():
            rerun.take(message)
            if message.topic == "/armctl/cycle":
                known.append(rerun.state is not None)
    assert known == [True] * 100
    assert (rerun.found.ticks, rerun.found.mismatches, rerun.keyframes) == (100, 0, 3)


def test_anchors_that_cannot_be_read_are_an_error_of_the_log(tmp_path: Path) -> None:
    with LogFile(write(tmp_path / "a.mcap", RECORDS)) as log:
        log.metadata[replay.MERGED] = {"anchors": "1/2/3 x"}
        cannot(log_setup, log)


def test_what_a_replay_passes_over_has_a_name_and_everything_else_is_judged() -> None:
    """A topic that is new is to be compared, to be an input, or to be entered here."""
    passed_over = {"/armctl/wire", "/robot_description", "/tf_static"}
    assert {*replay._COMPARED, "/armctl/servos", "/armctl/state"} == TOPICS.keys() - passed_over


def test_the_wire_is_passed_over_and_hides_nothing(tmp_path: Path) -> None:
    plain, wired = write(tmp_path / "a.mcap", RECORDS), write(tmp_path / "b.mcap", RECORDS, wire_ticks=1)
    ours, theirs = check(plain), check(wired)
    assert (theirs.judged, theirs.skipped, theirs.gaps, theirs.mismatches) == (100, 0, (), 0)
    assert theirs.messages == ours.messages
    altered = [with_sample(r, retries=7) if r.inputs.tick == 50 else r for r in RECORDS]
    assert (
        check(write(tmp_path / "c.mcap", altered, wire_ticks=1)).mismatches
        == check(write(tmp_path / "d.mcap", altered)).mismatches
    )


def test_replay_gives_the_logged_bytes(log: Path) -> None:
    fractions: list[float] = []
    result = check(log, fractions.append)
    assert (result.ticks, result.mismatches, result.first_mismatch) == (100, 0, "")
    assert (result.judged, result.skipped, result.gaps, result.passed_over) == (100, 0, (), False)
    assert result.messages > 3 * 100
    assert result.realtime_ratio > 1.0
    assert fractions
    assert all(0.0 < fraction <= 1.0 for fraction in fractions)


def test_replay_covers_teaching_stops_and_refusals(tmp_path: Path) -> None:
    script = {**RUN_SCRIPT, 30: (Hold(3),), 45: (Teach(4), Release(5)), 60: (TeachEnd(6),)}
    assert replayed(write(tmp_path / "a.mcap", make_records(80, script, keyframe_ticks=25))) == (80, 0)


def test_replay_tells_a_step_that_does_otherwise(log: Path) -> None:

    def other(before: Any, inputs: Inputs, *given: Any) -> tuple[Any, Outputs]:
        state, outputs = step(before, inputs, *given)
        if inputs.tick == 50:
            first, *others = outputs.joints
            outputs = replace(outputs, joints=(replace(first, load_ratio=first.load_ratio + 1e-15), *others))
        return state, outputs

    result = check(log, step=other)
    assert result.mismatches == 2  # the checksum of all that was said of the joints differs as well
    assert "tick 50, /joint_states.effort[0]: " in result.first_mismatch


def test_replay_goes_on_at_the_next_keyframe_after_a_gap(tmp_path: Path) -> None:
    assert replayed(write(tmp_path / "gap.mcap", [*RECORDS[:30], *RECORDS[33:]])) == (30 + 59, 0)
    dropped = write(tmp_path / "dropped.mcap", [*RECORDS[:30], replace(RECORDS[30], dropped=3), *RECORDS[31:]])
    assert replayed(dropped) == (30 + 59, 0)
    assert [line["function"] for line in recorder_lines(dropped)] == ["DROPPED"]


@pytest.mark.parametrize("begin", [41, 55])
def test_a_file_that_begins_after_a_keyframe_replays_from_its_beginning(tmp_path: Path, begin: int) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[begin:], keyframe=RECORDS[40].keyframe, inputs_only=RECORDS[41:begin])
    assert replayed(path) == (100 - begin, 0)
    assert recordings.load(path).positions_rad.shape == (100 - begin, 6)
    assert recordings.load(path).duration_s == pytest.approx((99 - begin) / 10.0)


def test_a_step_that_cannot_take_the_log_is_a_log_error(log: Path) -> None:
    def broken(*_: object) -> tuple[Any, Outputs]:
        raise IndexError("no")

    cannot(check, log, step=broken, why="tick 0: the control step cannot take it")


def test_a_log_of_a_build_without_the_writes_replays_and_says_what_was_not_compared(log: Path, tmp_path: Path) -> None:
    old = of_an_older_build(log, tmp_path / "old.mcap")
    result, now = check(old), check(log)
    assert (result.ticks, result.mismatches, result.passed_over) == (100, 0, True)
    assert (result.not_compared, now.not_compared) == (("/armctl/writes", "/armctl/cycle"), ())
    writes = sum(bool(record.outputs.writes) for record in RECORDS)
    assert result.messages == now.messages - 100 - writes
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


def times_s(*ticks: int) -> list[float]:
    """When ticks were sampled, since the first one."""
    begin_ns = RECORDS[0].inputs.sample.time_ns
    return [(RECORDS[tick].inputs.sample.time_ns - begin_ns) / NS_PER_S for tick in ticks]


def passed_over(path: Path) -> tuple[int, int, list[list[float | None]]]:
    """How many ticks were judged and skipped, and the gaps."""
    result = check(path)
    assert result.mismatches == 0
    assert result.passed_over
    return result.judged, result.skipped, [[gap["from_s"], gap["to_s"]] for gap in result.gaps]


def test_ticks_that_are_missing_and_those_that_cannot_be_judged_for_it_are_told(tmp_path: Path) -> None:
    gap = times_s(29, 41)
    assert passed_over(write(tmp_path / "a.mcap", [*RECORDS[:30], *RECORDS[33:]])) == (89, 8, [gap])
    dropped = [*RECORDS[:30], replace(RECORDS[30], dropped=3), *RECORDS[31:]]
    assert passed_over(write(tmp_path / "b.mcap", dropped)) == (89, 11, [gap])
    late = write(tmp_path / "c.mcap", RECORDS[20:])
    assert passed_over(late) == (59, 21, [[0.0, pytest.approx(times_s(41)[0] - times_s(20)[0])]])
    never = write(tmp_path / "d.mcap", RECORDS[:30] + RECORDS[90:])
    assert passed_over(never) == (30, 10, [times_s(29, 99)])


def test_a_control_process_that_was_started_again_leaves_a_gap_and_no_tick_is_skipped(tmp_path: Path) -> None:
    later_ns = 20 * NS_PER_S
    again = [later(record, later_ns) for record in RECORDS[:20]]
    path = write(tmp_path / "a.mcap", [*RECORDS[:50], *again])
    assert passed_over(path) == (70, 0, [[times_s(49)[0], 20.0]])


@pytest.mark.parametrize("percent", [1, 20, 50, 80, 99])
def test_a_log_that_was_cut_is_never_given_a_clean_bill_recovered_or_not(
    log: Path, tmp_path: Path, percent: int
) -> None:
    cut = tmp_path / "cut.mcap.part"
    cut.write_bytes(log.read_bytes()[: log.stat().st_size * (100 - percent) // 100])
    for path in (cut, tmp_path / "cut.mcap"):
        try:
            judged, skipped, gaps = passed_over(path)
        except LogError:
            continue  # nothing is left
        assert judged + skipped <= 100
        assert gaps[-1][1] is None
        if path == cut:
            recover(cut)


def test_damage_is_a_gap_wherever_it_is(log: Path, tmp_path: Path) -> None:
    data = log.read_bytes()
    for chunk in range(len(chunk_places(data))):
        path = tmp_path / f"{chunk}.mcap"
        path.write_bytes(spoilt(data, chunk))
        judged, skipped, gaps = passed_over(path)
        assert gaps
        assert 0 < judged + skipped <= 100


def test_an_output_that_belongs_to_no_tick_is_not_passed_over(log: Path, tmp_path: Path) -> None:
    again = next(message for message in messages(log) if message.topic == "/joint_states")
    with (tmp_path / "a.mcap").open("wb") as stream, LogFile(log) as source:
        writer = ChunkWriter(stream)
        rewrite = Rewrite(source, writer)
        for message in source.messages():
            rewrite.add([message])
            if message.topic == "/armctl/cycle" and message.sequence == 50:
                rewrite.add([again])
        writer.finish()
    assert passed_over(tmp_path / "a.mcap") == (100, 1, [])


def test_diagnostics_that_are_missing_differ(log: Path, tmp_path: Path) -> None:
    with (tmp_path / "a.mcap").open("wb") as stream, LogFile(log) as source:
        writer = ChunkWriter(stream)
        kept = (m for m in source.messages() if m.topic != "/diagnostics" or m.sequence < 50)
        Rewrite(source, writer).add(kept)
        writer.finish()
    result = check(tmp_path / "a.mcap")
    assert result.mismatches == len([m for m in messages(log) if m.topic == "/diagnostics" and m.sequence >= 50])
    assert result.first is not None
    assert result.first["logged"] is None


def test_a_file_does_not_begin_before_its_own_data(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[55:], keyframe=RECORDS[40].keyframe, inputs_only=RECORDS[41:55])
    assert reader.info(path).start_s == pytest.approx(ANCHOR.epoch_ns(RECORDS[55].inputs.sample.time_ns) / NS_PER_S)
    assert (reader.info(path).duration_s) == pytest.approx(times_s(99)[0] - times_s(55)[0])
