"""The gripping arm behind a real daemon: a reach grips, lifts and is recorded; judged by the simulator."""

import json

import pytest

from armctl.recording import replay
from tests.scenarios.bench import armctl, bench, insist, simulator

pytestmark = pytest.mark.pty

GRIPPER_ID = 6
# Near the rest pose: the arm need not go far.
POINT = (0.08, 0.02, 0.32)


def test_a_grip_of_something_in_the_hand_is_told_and_its_recording_replays() -> None:
    """What is gripped is as thick as the open hand: the servo is held where it stands."""
    with simulator("--arm", "xiang-6dof") as arm, bench(arm.port) as b:
        b.start_daemon("--arm", "xiang-6dof")
        assert len(arm.client.state()["servos"]) == 6
        client = b.client()
        assert insist(client, "torque_on") == {"state": "holding"}
        arm.client.fault_begin("blocked_joint", servo_id=GRIPPER_ID)
        place = ",".join(map(str, POINT))
        reach = f"reach --xyz {place} --grip --off 0.02 --json --socket {b.socket}"
        done = armctl(b.folder, *reach.split())
        result = json.loads(done.stdout)
        assert done.returncode == 0, result
        assert result["gripped"] is True
        assert result["position_error_mm"] < 8.0
        tool_m = arm.client.state()["tool_m"]
        assert tool_m[:2] == pytest.approx(POINT[:2], abs=0.015)
        assert 0.008 < tool_m[2] - POINT[2] < 0.035
        assert client.call("status")["state"] == "holding"
        [path] = b.recordings.iterdir()
        assert path.stem == result["recording"]
        checked = replay.check(path)
        assert (checked.mismatches, checked.first_mismatch) == (0, "")
