"""Trimming and merging: nothing added, nothing lost, and every piece replays alone."""

from collections import Counter
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from mcap.reader import make_reader
from mcap.writer import CompressionType
from rosbags.highlevel import AnyReader

from armctl.clock import NS_PER_S
from armctl.errors import RequestRefused
from armctl.recording import edit, reader, replay
from armctl.recording.channels import Anchor
from armctl.recording.edit import merge, trim
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.recover import recover
from armctl.recording.writer import LogContext
from tests.host.doubles import refused
from tests.recording.altered import with_outputs
from tests.recording.factory import ANCHOR, ARM, CONTEXT, make_records, times_s
from tests.recording.logs import add_string_channel, foreign, messages, replayed, spoilt, write
from tests.recording.refusals import cannot

RECORDS = make_records(90, keyframe_ticks=25)
LATCHED = {"/robot_description", "/tf_static"}


def own(path: Path) -> list[LogMessage]:
    """Messages that a trimmed file takes over, and does not say anew."""
    return [message for message in messages(path) if message.topic not in {*LATCHED, "/diagnostics", "/armctl/state"}]


# ------------------------------------------------------------------------------------------------------- trim


@given(begin=st.integers(1, 80), length=st.integers(2, 40))
@settings(max_examples=12)
def test_a_trimmed_file_holds_its_stretch_byte_for_byte_and_replays_from_its_first_tick(
    log: Path, tmp_path_factory: pytest.TempPathFactory, begin: int, length: int
) -> None:
    out = tmp_path_factory.mktemp("trim") / "b.mcap"
    result = trim(log, out, begin / 10.0 - 0.05, (begin + length) / 10.0 - 0.05)
    zero_ns = messages(log)[0].log_time_ns
    begin_ns, end_ns = (zero_ns + round((tick / 10.0 - 0.05) * NS_PER_S) for tick in (begin, begin + length))
    assert own(out) == [message for message in own(log) if begin_ns <= message.log_time_ns < end_ns]
    assert replayed(out) == (min(length, 90 - begin), 0)
    info = reader.info(out)
    assert (info.complete, result.begins_with_state) == (True, True)
    assert (info.messages, info.duration_s) == (result.messages, result.duration_s)
    assert info.duration_s == pytest.approx((min(length, 90 - begin) - 1) / 10.0)


def test_a_trimmed_file_opens_alone_everywhere(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "b.mcap"
    result = trim(log, out, 3.0, 6.0)
    found = list(reader.read(out))
    begin_ns = found[-1].log_time_ns - round(2.9 * NS_PER_S)
    assert [message.topic for message in found[:2]] == ["/robot_description", "/tf_static"]
    assert {"/diagnostics", "/armctl/state"} == {message.topic for message in found[2:4]}
    assert [message.log_time_ns for message in found[:4]] == [begin_ns] * 4
    values = [*(message.value for message in found[:4]), *found[1].value["transforms"]]
    stamps = [value["header"]["stamp"] for value in values if "header" in value]
    assert stamps == [{"sec": begin_ns // NS_PER_S, "nanosec": begin_ns % NS_PER_S}] * len(stamps)
    assert len(stamps) > len(found[1].value["transforms"]) > 0
    with LogFile(log) as old, LogFile(out) as new:
        assert {name: a.data for name, a in new.attachments.items()} == {n: a.data for n, a in old.attachments.items()}
        assert new.facts == old.facts
        assert new.metadata["trimmed"] == {"from": "a.mcap", "begin_s": "3.0", "end_s": "6.0"}
        assert new.channels == old.channels
    with AnyReader([out]) as bag, out.open("rb") as stream:
        stock = make_reader(stream, validate_crcs=True)
        assert [sum(1 for _ in found) for found in (bag.messages(), stock.iter_messages())] == [result.messages] * 2


def test_a_trimmed_file_can_be_trimmed_again(log: Path, tmp_path: Path) -> None:
    trim(log, tmp_path / "b.mcap", 1.0, 7.0)
    trim(tmp_path / "b.mcap", tmp_path / "c.mcap", 2.0, 4.0)
    trim(log, tmp_path / "d.mcap", 3.0, 5.0)
    assert messages(tmp_path / "c.mcap") == messages(tmp_path / "d.mcap")


def test_trimming_to_everything_keeps_everything(log: Path, tmp_path: Path) -> None:
    result = trim(log, tmp_path / "b.mcap", 0.0, float("inf"))
    assert messages(tmp_path / "b.mcap") == messages(log)
    assert result.begins_with_state is False  # as the log itself: its first keyframe is after its first tick
    assert replay.check(tmp_path / "b.mcap").mismatches == 0


def test_where_the_log_does_not_replay_no_state_is_made_up(tmp_path: Path) -> None:
    later = RECORDS[40].outputs
    wrong = with_outputs(RECORDS[5], mode=later.mode, joints=later.joints)
    log = write(tmp_path / "a.mcap", [*RECORDS[:5], wrong, *RECORDS[6:]])
    assert trim(log, tmp_path / "b.mcap", 0.95, 3.95).begins_with_state is False
    # from the keyframe of tick 25 on
    assert replayed(tmp_path / "b.mcap") == (14, 0)


def test_the_ticks_before_a_rotated_file_lead_to_its_state(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[40:], keyframe=RECORDS[25].keyframe, inputs_only=RECORDS[26:40])
    assert trim(path, tmp_path / "b.mcap", 0.0, 1.0).begins_with_state
    assert reader.info(tmp_path / "b.mcap").duration_s == pytest.approx(0.9)
    assert replayed(tmp_path / "b.mcap") == (10, 0)


def test_a_file_of_others_is_trimmed_as_well(tmp_path: Path) -> None:
    path = tmp_path / "a.mcap"
    with foreign(path, CompressionType.LZ4) as writer:
        channel = add_string_channel(writer)
        for i in range(10):
            writer.add_message(channel, i * NS_PER_S, b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00", i * NS_PER_S)
    assert trim(path, tmp_path / "b.mcap", 2.0, 5.0).messages == 3


def test_nothing_is_overwritten_and_a_failure_leaves_nothing(log: Path, tmp_path: Path) -> None:
    taken = tmp_path / "b.mcap"
    taken.write_bytes(b"mine")
    cannot(trim, log, taken, 0.0, 1.0, why="exists already")
    assert taken.read_bytes() == b"mine"
    for begin_s, end_s in ((2.0, 2.0), (3.0, 1.0), (100.0, 200.0), (float("nan"), 1.0)):
        with pytest.raises(RequestRefused):
            trim(log, tmp_path / "c.mcap", begin_s, end_s)
    cannot(trim, log, tmp_path / "none" / "c.mcap", 0.0, 1.0, why="cannot be written")
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]


def test_what_a_killed_trim_left_behind_does_not_block_the_next(log: Path, tmp_path: Path) -> None:
    (tmp_path / "b.mcap.unfinished").write_bytes(b"half")
    trim(log, tmp_path / "b.mcap", 0.0, 1.0)
    assert [path.name for path in tmp_path.iterdir()] == ["b.mcap"]


def test_a_damaged_chunk_is_left_out_and_told(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS)
    path.write_bytes(spoilt(path.read_bytes(), 6))
    assert trim(path, tmp_path / "b.mcap", 4.0, 7.0).damaged == 1
    assert replay.check(tmp_path / "b.mcap").mismatches == 0


# ------------------------------------------------------------------------------------------------------ merge


def rotated(folder: Path, cut: int = 50, *, anchor: Anchor = ANCHOR, context: LogContext = CONTEXT) -> list[Path]:
    """Two files as a daemon writes them around a rotation; anchor and context are the later one's."""
    keyframe = cut // 25 * 25
    beginning = {"keyframe": RECORDS[keyframe].keyframe, "inputs_only": RECORDS[keyframe + 1 : cut]}
    later: dict[str, Any] = beginning | {"previous": "a.mcap", "anchor": anchor, "context": context}
    return [write(folder / "a.mcap", RECORDS[:cut]), write(folder / "b.mcap", RECORDS[cut:], **later)]


def pieces(path: Path, folder: Path, *stretches_s: tuple[float, float]) -> list[Path]:
    """Stretches of a log, as files 1.mcap, 2.mcap and so on."""
    numbered = enumerate(stretches_s, 1)
    return [trim(path, folder / f"{number}.mcap", begin_s, end_s).path for number, (begin_s, end_s) in numbered]


DRIFTED = Anchor(ANCHOR.wall_ns + 123_456, ANCHOR.monotonic_ns)


@pytest.mark.parametrize("cut", [50, 51, 62])
@pytest.mark.parametrize("anchor", [ANCHOR, DRIFTED])
def test_files_around_a_rotation_become_the_log_they_would_have_been(tmp_path: Path, cut: int, anchor: Anchor) -> None:
    paths = rotated(tmp_path, cut, anchor=anchor)
    result = merge(list(reversed(paths)), tmp_path / "c.mcap")
    merged = messages(tmp_path / "c.mcap")
    topics = Counter(message.topic for message in merged)
    assert topics["/armctl/cycle"] == topics["/joint_states"] == 90
    assert topics["/tf_static"] == topics["/robot_description"] == 1
    times_ns = [message.log_time_ns for message in merged]
    assert times_ns == sorted(times_ns)
    assert replayed(tmp_path / "c.mcap") == (90, 0)
    assert result.gaps == ()
    assert result.messages == len(merged) == reader.info(tmp_path / "c.mcap").messages
    a, b = (own(path) for path in paths)
    assert merged[: len(messages(paths[0]))] == messages(paths[0])
    assert own(tmp_path / "c.mcap") == a + b[len(b) - (len(own(tmp_path / "c.mcap")) - len(a)) :]


def test_the_pieces_of_a_log_make_the_log_again(log: Path, tmp_path: Path) -> None:
    first, second, third = pieces(log, tmp_path, (0.0, 3.05), (3.05, 5.55), (5.55, 100.0))
    merge([third, first, second], tmp_path / "whole.mcap")
    assert own(tmp_path / "whole.mcap") == own(log)
    assert replay.check(tmp_path / "whole.mcap").mismatches == 0


def test_a_merged_file_can_be_trimmed_and_merged_again(tmp_path: Path) -> None:
    merge(rotated(tmp_path, anchor=DRIFTED), tmp_path / "c.mcap")
    paths = pieces(tmp_path / "c.mcap", tmp_path, (0.0, 3.05), (3.05, 100.0))
    assert [replay.check(path).mismatches for path in paths] == [0, 0]
    merge(paths, tmp_path / "d.mcap")
    assert own(tmp_path / "d.mcap") == own(tmp_path / "c.mcap")
    assert replay.check(tmp_path / "d.mcap").mismatches == 0


def test_ticks_that_went_missing_between_two_files_are_missing_in_the_merged_one(tmp_path: Path) -> None:
    first = write(tmp_path / "a.mcap", RECORDS[:40])
    follows: dict[str, Any] = {"keyframe": RECORDS[50].keyframe, "previous": "a.mcap", "inputs_only": RECORDS[51:55]}
    result = merge([first, write(tmp_path / "b.mcap", RECORDS[55:], **follows)], tmp_path / "c.mcap")
    ticks = [m.value["tick"] for m in reader.read(tmp_path / "c.mcap", ["/armctl/cycle"])]
    assert ticks == [*range(40), *range(55, 90)]
    assert len(result.gaps) == 1
    # up to the gap, and from the keyframe of tick 75 on
    assert replayed(tmp_path / "c.mcap") == (40 + 14, 0)


def test_ticks_that_are_there_for_a_replay_alone_fill_no_gap(tmp_path: Path) -> None:
    """As in two takes, of which the second one's inputs reach back into the first one."""
    first = write(tmp_path / "a.mcap", RECORDS[:40])
    second = write(tmp_path / "b.mcap", RECORDS[60:], keyframe=RECORDS[25].keyframe, inputs_only=RECORDS[26:60])
    result = merge([second, first], tmp_path / "c.mcap")
    from_s, to_s = times_s(RECORDS)[39], times_s(RECORDS)[60]
    assert list(result.gaps) == [{"from_s": pytest.approx(from_s), "to_s": pytest.approx(to_s)}]
    assert [is_gap(message) for message in reader.read(tmp_path / "c.mcap")].count(True) == 1
    checked = replay.check(tmp_path / "c.mcap")
    assert (checked.judged, checked.mismatches, checked.skipped) == (40 + 30, 0, 0)


def test_files_around_a_crash_are_merged_and_the_gap_is_marked_and_told(tmp_path: Path) -> None:
    crashed = recover(write(tmp_path / "a.mcap", RECORDS[:43], finish=False)).path
    restarted, far = (Anchor(ANCHOR.wall_ns + s * NS_PER_S, ANCHOR.monotonic_ns) for s in (60, 90))
    later = write(tmp_path / "b.mcap", RECORDS, anchor=restarted)
    result = merge([later, crashed], tmp_path / "c.mcap")
    [gap] = result.gaps
    times_s = [(m.log_time_ns - edit.first_ns(crashed)) / NS_PER_S for m in messages(tmp_path / "c.mcap")]
    assert gap == {"from_s": pytest.approx(times_s[len(messages(crashed)) - 1]), "to_s": pytest.approx(60.0)}
    [(line, time_s)] = [(m, s) for m, s in zip(reader.read(tmp_path / "c.mcap"), times_s, strict=True) if is_gap(m)]
    assert (line.value["msg"], time_s) == (
        f"GAP: nothing was recorded for {60.0 - gap['from_s']:.3f} s before this",
        60,
    )
    checked = replay.check(tmp_path / "c.mcap")
    assert (checked.judged, checked.mismatches, checked.skipped) == (43 + 90, 0, 0)
    assert list(checked.gaps) == [gap]
    # Of a last file that was cut nobody knows what is missing behind it; that stays known.
    latest = recover(write(tmp_path / "d.mcap", RECORDS[:20], anchor=far, finish=False)).path
    assert len(merge([later, latest, crashed], tmp_path / "e.mcap").gaps) == 2
    assert replay.check(tmp_path / "e.mcap").gaps[-1]["to_s"] is None


def is_gap(message: reader.DecodedMessage) -> bool:
    return message.topic == "/rosout" and message.value["function"] == "GAP"


@pytest.mark.parametrize(
    ("context", "named"),
    [
        (CONTEXT._replace(arm=ARM.model_copy(update={"arm_id": "other"})), "arm_id"),
        (CONTEXT._replace(port="/dev/ttyUSB7"), "port"),
        (CONTEXT._replace(period_s=0.05), "period_s"),
    ],
)
def test_files_of_another_daemon_are_refused(tmp_path: Path, context: LogContext, named: str) -> None:
    with refused("FOREIGN_LOG", named):
        merge(rotated(tmp_path, context=context), tmp_path / "c.mcap")
    assert not (tmp_path / "c.mcap").exists()


def test_one_file_damaged_ones_and_those_that_overlap_or_do_not_follow_are_refused(log: Path, tmp_path: Path) -> None:
    first, overlapping, later = pieces(log, tmp_path, (0.0, 4.0), (3.0, 6.0), (7.0, 8.0))
    before, damaged = rotated(tmp_path)
    damaged.write_bytes(damaged.read_bytes()[:-300])
    cannot(merge, [log], tmp_path / "c.mcap", why="two or more")
    cannot(merge, [before, damaged], tmp_path / "c.mcap", why="log recover")
    cannot(merge, [first, overlapping], tmp_path / "c.mcap", why=r"begins 0\.9 s before .*1\.mcap ends")
    cannot(merge, [log, log], tmp_path / "c.mcap", why="overlap")
    cannot(merge, [first, later], tmp_path / "c.mcap", why="does not follow")
    assert sorted(tmp_path.iterdir()) == [first, overlapping, later, before, damaged]


def test_progress_comes_to_its_end(log: Path, tmp_path: Path) -> None:
    seen: list[float] = []
    trim(log, tmp_path / "b.mcap", 0.0, 5.0, seen.append)
    assert seen == sorted(seen)
    assert len(seen) > 5
    seen.clear()
    merge(rotated(tmp_path / "rotated"), tmp_path / "c.mcap", seen.append)
    assert seen == sorted(seen)
    assert max(seen) > 0.5
