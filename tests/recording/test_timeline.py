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
from tests.recording.logs import add_string_channel, foreign, write
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


def test_a_log_that_is_read_tick_by_tick_is_the_same(found: timeline.Timeline, tmp_path: Path) -> None:
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


def test_frames_can_be_read_one_by_one(log: Path) -> None:
    with LogFile(log) as file:
        frames = timeline.Frames(file)
        assert next(iter(frames)).tick == 0
        assert [one.code for one in frames.happenings] == ["CONNECTED", "STATE"]  # nothing was read ahead


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
