"""YAML without its surprises, names that stay names, and the key `gripper` of a calibration file."""

from pathlib import Path
from typing import Any

import pytest
import yaml
from dynamixel_sdk.protocol1_packet_handler import TXPACKET_MAX_LEN
from hypothesis import given
from hypothesis import strategies as st

from armctl.config import MOST_SERVOS, ArmConfig, Config, PairConfig, parse_yaml, validate
from armctl.errors import ConfigError
from armctl.files import find_arm_file, load_arm
from armctl.strict_yaml import MAX_YAML_BYTES, MAX_YAML_DEPTH

REFUSED = yaml.safe_load(Path(__file__).with_name("config.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        *REFUSED["texts"].items(),
        ("a" * (MAX_YAML_BYTES + 1), f"larger than {MAX_YAML_BYTES} bytes"),
        ("[" * 60_000, f"nested more than {MAX_YAML_DEPTH} deep"),
        ("- " * 30_000, f"nested more than {MAX_YAML_DEPTH} deep"),
    ],
)
def test_what_yaml_allows_beyond_keys_and_values_is_refused(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as refused:
        parse_yaml(text, "FILE")
    assert str(refused.value).startswith("FILE")
    assert problem in str(refused.value)


@given(st.integers(1, MAX_YAML_DEPTH + 4))
def test_depth_is_bounded_just_there(depth: int) -> None:
    """The mapping, its value, and what is inside of it."""
    text = "a: " + "[" * (depth - 2) + "1" + "]" * (depth - 2)
    if depth <= MAX_YAML_DEPTH:
        assert parse_yaml(text, "FILE").keys() == {"a"}
    else:
        with pytest.raises(ConfigError, match="deep"):
            parse_yaml(text, "FILE")


@pytest.mark.parametrize(
    ("text", "value"),
    [("1:30", "1:30"), ("0o17", "0o17"), ("yes", "yes"), (".nan", ".nan"), ("1e3", 1000.0), ("true", True), ("", None)],
)
def test_only_what_looks_like_a_number_is_one(text: str, value: object) -> None:
    assert parse_yaml(f"a: {text}", "FILE") == {"a": value}


@given(st.text())
def test_whatever_the_text_it_is_read_or_refused(text: str) -> None:
    told = "FILE"
    try:
        assert isinstance(parse_yaml(text, "FILE"), dict)
    except ConfigError as refused:
        told = str(refused)
    assert told.startswith("FILE")


@pytest.mark.parametrize("name", ["ax12-line\n", "..", "", "ax12 line"])
def test_a_name_of_an_arm_is_a_plain_name(name: str) -> None:
    with pytest.raises(ConfigError, match="no such arm"):
        find_arm_file(name)


GRIPPER = {"joint": "gripper", "open_deg": 0.0, "closed_deg": 90.0}


def arm_with(gripper: object, **joint: object) -> ArmConfig:
    data = load_arm("xiang-6dof").model_dump(mode="json", exclude={"gripper"})
    data["joints"][5] |= joint
    return validate(ArmConfig, {**data, "gripper": gripper}, "arm.yaml")


def test_only_the_arm_of_the_gripping_paper_has_a_gripper() -> None:
    found = {name: load_arm(name).gripper for name in ("ax12-line", "lanzhou-4dof", "transfer-6dof", "xiang-6dof")}
    gripper = found.pop("xiang-6dof")
    assert gripper is not None
    assert (gripper.joint, gripper.open_deg, gripper.closed_deg, gripper.load_ratio) == ("gripper", 0.0, 90.0, 0.3)
    assert set(found.values()) == {None}


def test_a_gripper_does_not_make_logs_foreign() -> None:
    assert arm_with(GRIPPER).calibration_hash == arm_with(None).calibration_hash


@pytest.mark.parametrize("refused", REFUSED["grippers"], ids=lambda refused: str(refused["says"]))
def test_a_gripper_that_cannot_work_is_refused_with_the_reason(refused: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=refused["says"]):
        arm_with(GRIPPER | refused.get("gripper", {}), **refused.get("joint", {}))


def test_a_thousand_faults_are_counted_and_not_listed() -> None:
    with pytest.raises(ConfigError) as caught:
        validate(Config, {f"key{number}": 1 for number in range(1000)}, "armctl.yaml")
    assert "and 980 more" in str(caught.value)
    assert str(caught.value).count("unknown key") == 20


def test_an_ax_12a_is_not_told_and_another_servo_is() -> None:
    """Hashes and logs of arms that were there before stay as they are."""
    arm = load_arm("ax12-line")
    assert "model" not in arm.model_dump(mode="json")["joints"][0]
    assert arm.calibration_hash == "10542f8f115a0cf0"
    other = validate(ArmConfig, {**arm.model_dump(mode="json"), "joints": [
        {**joint, "model": "ax-18a"} for joint in arm.model_dump(mode="json")["joints"]]}, "arm.yaml")  # fmt: skip
    assert other.model_dump(mode="json")["joints"][0]["model"] == "ax-18a"
    assert other.calibration_hash != arm.calibration_hash


def test_a_servo_that_is_none_is_refused_with_those_there_are() -> None:
    with pytest.raises(ConfigError, match="model 'mx-28': no such servo; known: ax-12a, ax-12w, ax-18a"):
        arm_with(GRIPPER, model="mx-28")


def paired(**pair: Any) -> ArmConfig:
    shoulder = {"name": "shoulder", "servo_id": 2, "zero_tick": 500, "limits_deg": [-60, 60], "pair": pair}
    waist = {"name": "waist", "servo_id": 1, "limits_deg": [-90, 90]}
    return validate(ArmConfig, {"arm_id": "two", "robot": "planar", "joints": [waist, shoulder]}, "FILE")


@pytest.mark.parametrize("row", REFUSED["pairs"], ids=lambda row: row["says"][:40])
def test_a_pair_that_cannot_be_is_refused_with_the_reason(row: dict[str, Any]) -> None:
    with pytest.raises(ConfigError, match=row["says"]):
        paired(**row["pair"])


def test_a_second_servo_faces_the_first_one_unless_its_file_says_otherwise() -> None:
    arm = paired(servo_id=3)
    assert arm.servo_ids == (1, 2, 3)
    assert [servo.name for servo in arm.servos] == ["waist", "shoulder", "shoulder"]
    first, second = arm.servos[1:]
    assert first.limits_tick == (296, 704)
    assert second.limits_tick == (1023 - 704 - 12, 1023 - 296 + 12)
    assert second.linkage is not None
    assert second.linkage.second(500.0) == 523.0
    same = paired(servo_id=3, direction=1, zero_tick=490.5).servos[2].linkage
    assert same is not None
    assert (same.second(510.0), same.first(500.5)) == (500.5, 510.0)


@given(st.lists(st.tuples(st.integers(5, 40), st.integers(-20, 20)), min_size=2, max_size=12), st.floats(0.0, 1023.0))
def test_a_measured_table_is_read_both_ways(steps: list[tuple[int, int]], tick: float) -> None:
    rows, a, b = [(250.0, 800.0)], 250.0, 800.0
    for step, percent in steps:
        a, b = a + step, b - step * (1.0 + percent / 100.0)
        rows.append((a, b))
    link = PairConfig(servo_id=3, table=tuple(rows)).linked(1, 512.0)
    assert [link.second(a) for a, _ in rows] == pytest.approx([b for _, b in rows])
    assert link.first(link.second(tick)) == pytest.approx(tick)


def test_an_arm_has_as_many_servos_as_one_packet_has_goals_for() -> None:
    def arm(pairs: int) -> ArmConfig:
        known = load_arm("ax12-line").model_dump(exclude_unset=True)
        own = [{"name": f"joint-{i}", "servo_id": i, "pair": {"servo_id": 100 + i}} for i in range(pairs)]
        joints = [known["joints"][min(i, 4)] | new for i, new in enumerate(own)]
        return validate(ArmConfig, known | {"joints": joints}, "FILE")

    assert 8 + 5 * len(arm(MOST_SERVOS // 2).servos) <= TXPACKET_MAX_LEN < 8 + 5 * (MOST_SERVOS + 1)
    with pytest.raises(ConfigError, match="50 servos; one packet holds goals for 48, leave some out"):
        arm(25)


def test_an_arm_without_a_pair_is_told_as_before() -> None:
    told = load_arm("ax12-line").model_dump()
    assert all("pair" not in joint for joint in told["joints"])
    assert load_arm("ax12-line").calibration_hash == "10542f8f115a0cf0"
    pair = paired(servo_id=3).model_dump(mode="json", exclude_unset=True)["joints"][1]["pair"]
    assert pair == {"servo_id": 3}
    measured = paired(servo_id=3, table=[[300, 720], [700, 325]])
    assert validate(ArmConfig, measured.model_dump(mode="json", exclude_unset=True), "FILE") == measured


def test_a_gripper_of_its_own_may_have_two_servos() -> None:
    gripper = {"servo_id": 7, "open_tick": 400, "closed_tick": 520, "pair": {"servo_id": 8}}
    joints = [{"name": "waist", "servo_id": 1, "limits_deg": [-90, 90]}]
    arm = validate(ArmConfig, {"arm_id": "two", "robot": "planar", "joints": joints, "gripper": gripper}, "FILE")
    assert arm.servo_ids == (1, 7, 8)
    assert arm.servos[2].limits_tick == (491, 635)
