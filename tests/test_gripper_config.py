"""The key `gripper` of a calibration file."""

import pytest

from armctl.config import ArmConfig, validate
from armctl.errors import ConfigError
from armctl.files import load_arm

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


@pytest.mark.parametrize(
    ("gripper", "joint", "says"),
    [
        ({**GRIPPER, "joint": "claw"}, {}, "no such joint; known: waist"),
        ({**GRIPPER, "closed_deg": 120.0}, {}, r"120.0 deg lies outside limits_deg \[-5.0, 100.0\]"),
        ({**GRIPPER, "closed_deg": 0.0}, {}, "open and closed are both"),
        ({**GRIPPER, "load_ratio": 0.05}, {}, "greater than or equal to 0.15"),
        ({**GRIPPER, "load_ratio": 0.9}, {}, "less than or equal to 0.5"),
        (
            GRIPPER,
            {"compliance": {"margin": 1, "slope": 128, "punch": 32}},
            "39 ticks behind its goal then, at most 20",
        ),
        ({**GRIPPER, "width_mm": 40.0}, {}, "unknown key"),
    ],
)
def test_a_gripper_that_cannot_work_is_refused_with_the_reason(
    gripper: dict[str, object], joint: dict[str, object], says: str
) -> None:
    with pytest.raises(ConfigError, match=says):
        arm_with(gripper, **joint)
