"""The proof of the set-up: a few arms whole, and that its judge sees what it is there for."""

import math
from pathlib import Path

import numpy as np
import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from proving import setting_up
from proving.put_together import Person, assembled
from proving.setting_up import DEFECTS, Trial, drawn, prove, run, wrong


@pytest.mark.parametrize(("kind", "defects", "ends"), [
    ("ax12-line", (), "set up"),
    ("phantomx-pincher", ("swapped", "reversed", "shared"), "set up"),
    ("lanzhou-4dof", ("strange", "baud"), "set up"),
    ("crane-plus-v2", ("missing", "reversed"), "4 of 5 servos answer"),
])  # fmt: skip
def test_an_arm_is_set_up_right_or_its_defect_is_named(kind: str, defects: tuple[str, ...], ends: str) -> None:
    result = run(Trial(3, defects, kind))
    assert result["broken"] == []
    assert result["outcome"].startswith(ends)


@pytest.mark.pty
def test_a_command_that_is_typed_names_what_is_missing() -> None:
    result = run(Trial(3, ("missing",), "crane-plus-v2"), typed=True)
    assert result["broken"] == []
    assert "4 of 5 servos answer" in result["outcome"]


def test_every_defect_and_every_number_of_them_is_drawn() -> None:
    trials = [drawn(1, number) for number in range(setting_up.ARMS)]
    assert {len(trial.defects) for trial in trials} == {0, 1, 2, 3}
    assert {what for trial in trials for what in trial.defects} == set(DEFECTS)
    assert len({trial.kind for trial in trials}) == len(setting_up.KINDS)


@pytest.mark.parametrize(("key", "value", "says"), [
    ("servo_id", 9, "servo 9, and it has 3"),
    ("direction", -1, "direction -1, and it is 1"),
    ("zero_tick", 506.0, "zero at 506.0"),
    ("limits_deg", (-145.0, 148.0), "beyond its stops"),
    ("limits_deg", (-145.0, 120.0), "of its range are not used"),
    ("rest_deg", -120.0, "rests at -120.0 deg"),
])  # fmt: skip
def test_a_file_that_is_wrong_in_one_thing_is_told(key: str, value: object, says: str) -> None:
    arm = assembled(3, (), "ax12-line")
    assert wrong(arm, arm.kind) == []
    joints = [j.model_copy(update={key: value}) if j.name == "elbow" else j for j in arm.kind.joints]
    [told] = wrong(arm, arm.kind.model_copy(update={"joints": tuple(joints)}))
    assert told.startswith("elbow: ")
    assert says in told


def test_a_gripper_that_would_close_elsewhere_is_told() -> None:
    arm = assembled(3, (), "phantomx-pincher")
    assert arm.kind.gripper is not None
    gripper = arm.kind.gripper.model_copy(update={"closed_deg": arm.kind.gripper.closed_deg - 10.0})
    [told] = wrong(arm, arm.kind.model_copy(update={"gripper": gripper}))
    assert told.startswith("gripper: open and closed at")


def test_torque_that_nobody_allowed_and_a_joint_at_its_stop_are_told() -> None:
    arm = assembled(3, (), "ax12-line")
    stop = arm.kind.joints[0].limits_deg[1] + arm.simulated.spec.stop_deg
    arm.simulated.servos[0].shaft_rad = arm.kind.joints[0].tick(math.radians(stop)) * ax12a.TICK_RAD
    arm.simulated.servos[0].set(ax12a.TORQUE_ENABLE, 1)
    arm.wire.receive(b"\xff", arm.virtual.clock.now_ns())
    assert arm.wire.broken == [
        "base is at a stop with torque on, 147.0 deg",
        "base has torque, and nobody said that it is free",
    ]


def test_an_answer_that_is_not_what_the_tool_did_is_told(tmp_path: Path) -> None:
    arm = assembled(3, (), "ax12-line")
    file = tmp_path / "answers.yaml"
    file.write_text("base.went: yes")
    rest = arm.simulated.true_positions()
    arm.wire.began_rad, arm.wire.farthest_rad = rest, rest - np.eye(6)[0] * 0.1
    Person(arm, file).ask("base.went", "did the tool turn counter-clockwise, seen from above", ("yes", "no"))
    assert "is prepared, and it is not what is seen" in arm.wire.broken[0]


def test_a_set_up_that_ends_without_naming_what_was_planted_and_one_that_misses_a_servo_are_violations(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(setting_up, "commanded", lambda *_: "something is wrong")
    [told] = prove(1, lambda _: None, arms=1, workers=1)["violations"]
    assert told == "arm 1000 (ax12-line, no defect): ended by 'something is wrong'"
    monkeypatch.setattr(setting_up, "attempted", lambda *_: "set up")
    monkeypatch.setattr(setting_up, "load_arm", load_kind)
    assert run(Trial(3, ("missing",), "ax12-line"))["broken"] == ["set up, though a servo is missing"]


def load_kind(name: str) -> ArmConfig:
    """The arm itself, wherever a file of it is looked for."""
    from armctl.files import load_arm

    return load_arm("ax12-line" if name.endswith("mine.yaml") else name)
