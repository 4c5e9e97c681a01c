"""What stands in the log of a tick."""

import json
from dataclasses import replace

import numpy as np
import pytest

from armctl.dynamixel import ax12a
from armctl.json_text import command_from_json
from armctl.kinematics.chain import link_frames
from armctl.kinematics.transform import matrix_from_quaternion
from armctl.messages import Event, Fault, JointTrajectory, Reply, Run, TickRecord
from armctl.recording import channels
from armctl.recording.cdr import Value
from armctl.recording.channels import TOPICS, Anchor
from tests.recording.altered import with_outputs, with_sample, without_first_joint
from tests.recording.factory import ANCHOR, ARM, ROBOT, make_records, tick_messages

RECORDS = make_records(60)
MOVING = RECORDS[30]


def messages(record: TickRecord) -> dict[str, list[Value]]:
    found: dict[str, list[Value]] = {}
    for topic, value in tick_messages(record):
        found.setdefault(topic, []).append(TOPICS[topic].codec.decode(TOPICS[topic].codec.encode(value)))
    return found


def test_a_joint_that_never_answered_is_left_out() -> None:
    found = messages(without_first_joint(MOVING))
    assert found["/joint_states"][0]["name"] == list(ARM.joint_names[1:])
    assert "/tf" not in found
    assert "/tcp_pose" not in found


def test_joint_commands_are_the_goal_ticks_through_the_calibration_and_silent_where_no_goal_is_sent() -> None:
    goal = MOVING.outputs.goal
    assert goal is not None
    (commands,) = messages(MOVING)["/joint_commands"]
    ticks = [joint.tick(q) for joint, q in zip(ARM.joints, commands["position"], strict=True)]
    assert ticks == pytest.approx(goal.ticks, abs=1e-9)
    assert commands["velocity"] == [speed * ax12a.SPEED_UNIT_RAD_S for speed in goal.speeds]
    assert RECORDS[1].outputs.goal is None
    assert "/joint_commands" not in messages(RECORDS[1])


def test_tf_is_forward_kinematics() -> None:
    (tf,) = messages(MOVING)["/tf"]
    q = np.array([joint.position_rad for joint in MOVING.outputs.joints])
    frames = link_frames(ROBOT.chain, q[: ROBOT.chain.n])[1:]
    assert [t["child_frame_id"] for t in tf["transforms"]] == [f"link_{i}" for i in range(1, 7)]
    for transform, T in zip(tf["transforms"], frames, strict=False):
        assert transform["header"]["frame_id"] == "base_link"
        assert list(transform["transform"]["translation"].values()) == T[:3, 3].tolist()
        R = matrix_from_quaternion(tuple(transform["transform"]["rotation"].values()))
        np.testing.assert_allclose(R, T[:3, :3], atol=1e-12)


def test_the_cycle_is_the_last_message_of_a_tick() -> None:
    for record in RECORDS:
        assert tick_messages(record)[-1][0] == "/armctl/cycle"


def test_commands_and_replies_stand_in_the_log_with_their_tick() -> None:
    record = with_outputs(RECORDS[20], replies=(Reply(9, False, "BUSY", "no"),))
    found = messages(record)
    command, reply = (channels.parse_record(value["data"]) for value in found["/armctl/command"])
    (run,) = record.inputs.commands
    assert isinstance(run, Run)
    assert command is not None
    assert (*command[:2], command_from_json(json.dumps(command[2]))) == (20, "command", run)
    assert reply == (20, "reply", {"request_id": 9, "ok": False, "code": "BUSY", "message": "no"})
    ((*_, point),) = (trajectory["points"][:11] for trajectory in found["/joint_trajectory"])
    assert point["time_from_start"] == {"sec": 1, "nanosec": 0}
    assert point["positions"] == list(run.trajectory.positions_rad[10])


@pytest.mark.parametrize("text", ["", "[]", "{}", '{"tick":1}', '{"request":1}', "[" * 100_000])
def test_notes_of_others_are_no_records(text: str) -> None:
    assert channels.parse_record(text) is None


def test_an_event_keeps_its_code_and_severity() -> None:
    line = channels.log_line(Event("error", "TRIPPED", "it tripped", 4), 1_500_000_001, "armctl.control")
    assert (line["level"], line["function"]) == (40, "TRIPPED")
    assert line["msg"] == "TRIPPED (servo 4): it tripped"
    assert line["stamp"] == {"sec": 1, "nanosec": 500_000_001}


def test_diagnostics_tell_fault_and_silent_servos() -> None:
    first, second, *others = MOVING.inputs.sample.servos
    record = with_sample(without_first_joint(MOVING), servos=(first, replace(second, error=0x24), *others))
    record = with_outputs(record, faults=(Fault("TRIPPED", "it tripped", 5, 2),))
    topic, value = channels.diagnostics(record, ANCHOR, ARM)
    assert topic == "/diagnostics"
    assert [status["level"] for status in value["status"]] == [2, 3, 1, 0, 0, 0, 0]
    assert "TRIPPED" in value["status"][0]["message"]
    assert value["status"][2]["message"] == "OVERHEAT OVERLOAD"
    TOPICS[topic].codec.encode(value)


def test_epoch_time_is_the_anchor_plus_the_monotonic_difference() -> None:
    assert Anchor(1_000, 300).epoch_ns(350) == 1_050
    assert Anchor(10, 300).epoch_ns(200) == 0


def test_a_refused_run_with_fewer_times_than_points_stands_in_the_log_as_far_as_it_goes() -> None:
    away = JointTrajectory(0.1, ((0.0,) * 6,) * 3, times_s=(0.0, 0.1))
    record = replace(RECORDS[0], inputs=replace(RECORDS[0].inputs, commands=(Run(1, away),)))
    [told] = [value for topic, value in tick_messages(record) if topic == channels.JOINT_TRAJECTORY]
    assert len(told["points"]) == 2
