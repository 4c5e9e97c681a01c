"""A log as arrays: every value is that of the tick record it was written from."""

import json
import math
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from armctl.clock import NS_PER_S
from armctl.dynamixel import ax12a
from armctl.messages import Fault, Mode
from armctl.recording import timeline
from armctl.recording.cdr import codec
from armctl.recording.log_file import LogFile
from armctl.recording.replay import check
from tests.recording.altered import with_outputs, without_first_joint
from tests.recording.factory import ANCHOR, ARM, make_records
from tests.recording.logs import add_string_channel, foreign, spoilt, write
from tests.recording.refusals import cannot

RECORDS = make_records(60, seed=3)
# Topics that the timeline or a replay reads.
READ = ("/armctl/servos", "/joint_states", "/tcp_pose", "/armctl/cycle", "/armctl/writes", "/diagnostics", "/rosout")


@pytest.fixture(scope="module")
def found(log: Path) -> timeline.Timeline:
    return timeline.load(log)


def test_every_array_is_what_the_ticks_said(found: timeline.Timeline) -> None:
    np.testing.assert_array_equal(found.tick, [record.inputs.tick for record in RECORDS])
    for name in ("position_rad", "velocity_rad_s", "load_ratio", "voltage_V", "temperature_degC", "torque_enabled"):
        expected = [[getattr(joint, name) for joint in record.outputs.joints] for record in RECORDS]
        np.testing.assert_array_equal(getattr(found, name), expected, err_msg=name)
    tools = [record.outputs.tool for record in RECORDS]
    expected_tools = [(*tool.position_m, *tool.quaternion) for tool in tools if tool is not None]
    np.testing.assert_array_equal(found.tool, expected_tools)
    times_ns = np.array([record.inputs.sample.time_ns for record in RECORDS])
    np.testing.assert_array_equal(found.time_s, (times_ns - times_ns[0]) / NS_PER_S)
    assert found.start_ns == ANCHOR.epoch_ns(int(times_ns[0]))
    assert found.complete


def test_a_log_that_was_not_ended_is_the_same(found: timeline.Timeline, tmp_path: Path) -> None:
    cut = timeline.load(write(tmp_path / "a.mcap", RECORDS, finish=False))
    assert not cut.complete
    for one in fields(cut):
        if one.name not in ("path", "complete"):
            np.testing.assert_equal(getattr(cut, one.name), getattr(found, one.name), err_msg=one.name)


def test_goals_are_the_registers_while_there_is_torque(found: timeline.Timeline) -> None:
    for frame, record in enumerate(RECORDS):
        for j, (joint, reading) in enumerate(zip(ARM.joints, record.inputs.sample.servos, strict=True)):
            goal_rad = joint.position_rad(ax12a.register_value(ax12a.GOAL, reading.registers))
            expected = goal_rad if found.torque_enabled[frame, j] else math.nan
            np.testing.assert_equal(found.goal_rad[frame, j], expected)


def test_states_are_right_at_every_tick(found: timeline.Timeline) -> None:
    assert [found.state(i) for i in range(len(RECORDS))] == [record.outputs.mode.value for record in RECORDS]
    assert {found.fault(i) for i in range(len(RECORDS))} == {""}


def test_a_fault_is_known_from_its_first_tick_on(tmp_path: Path) -> None:
    fault = Fault("HOT", "servo 3 (elbow): 66 degC (bound 65)", 0, 3)
    later = [with_outputs(record, mode=Mode.FAULTED, faults=(fault,)) for record in RECORDS[7:20]]
    found = timeline.load(write(tmp_path / "a.mcap", [*RECORDS[:7], *later]))
    assert found.faults == ((0, ""), (7, "HOT: servo 3 (elbow): 66 degC (bound 65)"))
    assert (found.state(6), found.state(7)) == ("energising", "faulted")


def test_a_run_is_found_with_its_window_and_its_ends(found: timeline.Timeline) -> None:
    (motion,) = found.motions
    (command,) = [c for record in RECORDS for c in record.inputs.commands if c.kind == "run"]
    path = command.trajectory
    ends = path.positions_rad[0], path.positions_rad[10]
    assert (motion.label, motion.begin_rad, motion.end_rad) == (path.label, *ends)
    assert (motion.end_ns - motion.begin_ns) / NS_PER_S == pytest.approx(path.end_s - path.begin_s, abs=0.11)


def test_requests_and_events_are_told_in_order(tmp_path: Path) -> None:
    note = {"request": "torque_on", "who": "uid 1", "outcome": "BUSY", "reasons": ["taken"]}
    found = timeline.load(write(tmp_path / "a.mcap", RECORDS[:6], notes={2: [json.dumps(note), "no JSON"]}))
    assert [one.code for one in found.happenings] == ["CONNECTED", "STATE", "REQUEST", "WRITE", "STATE", "WRITE"]
    assert found.happenings[2].text == "torque_on by uid 1: BUSY: taken"


def test_a_joint_that_never_answered_is_not_a_number(tmp_path: Path) -> None:
    found = timeline.load(write(tmp_path / "a.mcap", [without_first_joint(RECORDS[0]), *RECORDS[1:3]]))
    assert np.argwhere(~np.isfinite(found.position_rad)).tolist() == [[0, 0]]
    assert np.isnan([found.position_rad[0, 0], *found.tool[0]]).all()


def test_ticks_kept_for_replay_alone_are_no_frames(tmp_path: Path) -> None:
    records = make_records(30)
    path = write(tmp_path / "a.mcap", records[10:], keyframe=records[0].keyframe, inputs_only=records[1:10])
    found = timeline.load(path)
    np.testing.assert_array_equal(found.tick, np.arange(10, 30))
    assert found.start_ns == ANCHOR.epoch_ns(records[10].inputs.sample.time_ns)


def test_index_finds_the_newest_frame_at_or_before_a_time(found: timeline.Timeline) -> None:
    assert (found.index(-1.0), found.index(1e9)) == (0, len(RECORDS) - 1)
    for later_s in (0.0, 0.05):
        assert [found.index(time_s + later_s) for time_s in found.time_s.tolist()] == list(range(len(RECORDS)))


def test_ticks_of_which_something_is_lost_are_no_frames_and_disturb_no_other(tmp_path: Path) -> None:
    whole = timeline.load(write(tmp_path / "a.mcap", RECORDS, flush_ticks=1))
    data = (tmp_path / "a.mcap").read_bytes()
    for lost in ((9,), (1, 2, 30), (len(RECORDS),)):  # of the chunks, the one with number 0 being the head
        (tmp_path / "b.mcap").write_bytes(spoilt(data, *lost))
        found = timeline.load(tmp_path / "b.mcap")
        kept = ~np.isin(whole.tick, [number - 1 for number in lost])
        assert not found.complete
        for name in ("tick", "position_rad", "goal_rad", "voltage_V", "fresh", "tool", "cycle"):
            np.testing.assert_equal(getattr(found, name), getattr(whole, name)[kept], err_msg=name)
        states = [whole.state(frame) for frame in np.flatnonzero(kept).tolist()]
        # Where the message with the change is lost the one before goes on.
        assert [found.state(frame) for frame in range(len(states))][-5:] == states[-5:]


def test_a_servo_message_of_a_tick_without_its_end_is_not_taken_for_the_next_one(tmp_path: Path) -> None:
    """As after a damaged chunk: a tick begins, and the next thing that can be read is the end of another."""
    with foreign(tmp_path / "b.mcap") as writer, LogFile(write(tmp_path / "a.mcap", RECORDS[:8])) as source:
        for attachment in source.attachments.values():
            data = attachment.data
            if attachment.name == "armctl.json":
                data = json.dumps(json.loads(data) | {"schemas": [], "channels": []}).encode()
            writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
        ids = {}
        for message in source.messages():
            if message.topic not in ids:
                schema = source.schemas[next(c.schema_id for c in source.channels.values() if c.topic == message.topic)]
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                ids[message.topic] = writer.register_channel(message.topic, "cdr", number)
            time_ns, tick, end = message.log_time_ns, message.sequence, message.topic == "/armctl/cycle"
            if not (tick == 3 and end) and not (tick == 4 and not end):
                writer.add_message(ids[message.topic], time_ns, message.data, time_ns, tick)
    assert timeline.load(tmp_path / "b.mcap").tick.tolist() == [0, 1, 2, 5, 6, 7]


def test_a_tick_that_stands_there_twice_is_two_frames(tmp_path: Path) -> None:
    found = timeline.load(write(tmp_path / "a.mcap", [*RECORDS[:9], RECORDS[8], *RECORDS[9:]]))
    assert found.tick.tolist() == [*range(9), 8, *range(9, len(RECORDS))]
    assert found.position_rad[8].tolist() == found.position_rad[9].tolist()


def test_a_log_without_ticks_is_refused(tmp_path: Path) -> None:
    cannot(timeline.load, write(tmp_path / "a.mcap", []), why="no whole tick")


def test_our_topics_with_something_else_in_them_are_an_error_of_the_log(log: Path, tmp_path: Path) -> None:
    text = codec("std_msgs/String").encode({"data": '{"tick": 1, "command": 5}'})
    for topic in READ:
        path = tmp_path / f"{topic.replace('/', '-')}.mcap"
        with foreign(path) as writer, LogFile(log) as source:
            for attachment in source.attachments.values():
                data = attachment.data
                if attachment.name == "armctl.json":
                    data = json.dumps(json.loads(data) | {"schemas": [], "channels": []}).encode()
                writer.add_attachment(0, 0, attachment.name, attachment.media_type, data)
            for name in (topic, "/armctl/command"):
                writer.add_message(add_string_channel(writer, name), 1, text, 1)
        for attempt in (timeline.load, check):
            cannot(attempt, path, why=path.name)
