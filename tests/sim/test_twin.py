"""The twin of an identified arm: its file, and that the simulator plays what stands in it."""

import json
import math
from pathlib import Path

import pytest

from armctl.config import ArmConfig
from armctl.errors import ConfigError
from armctl.sim.build import build
from armctl.sim.joint import STEP_S
from armctl.sim.spec import DEFAULT_SPEC, put_together
from armctl.sim.twin import load_twin

FOUND = {
    "coulomb_Nm": 0.2, "stiction_ratio": 1.3, "slope_tick": 24.0, "play_deg": 0.9, "delay_ms": 33.0, "stall_Nm": 1.4,
    "no_load_rad_s": 6.0, "load_friction": 0.1, "noise_tick": 1.1,
}  # fmt: skip


def written(folder: Path, arm: ArmConfig, **changes: object) -> Path:
    path = folder / "arm.twin.json"
    told = {
        "arm_id": arm.arm_id, "ramp_from_reference": False, "points_kg": [0.07] * 7,
        "joints": {name: FOUND if name == "elbow" else {} for name in arm.joint_names},
    }  # fmt: skip
    path.write_text(json.dumps(told | changes))
    return path


def test_what_was_found_is_played_and_the_rest_is_drawn(arm: ArmConfig, tmp_path: Path) -> None:
    spec = put_together(DEFAULT_SPEC, "perfect", "new", load_twin(written(tmp_path, arm), arm))
    _, joints, masses = build(arm, spec, 3)
    _, drawn, _ = build(arm, DEFAULT_SPEC, 3)
    elbow, servo = joints[2], joints[2].servo
    assert elbow.coulomb_Nm == 0.2
    assert elbow.stiction_Nm == pytest.approx(0.26)
    assert servo.slope_share * 32.0 == pytest.approx(24.0)
    assert math.degrees(2.0 * elbow.half_play_rad) == pytest.approx(0.9)
    assert elbow.dead_steps * STEP_S == pytest.approx(0.033)
    assert (elbow.stall_Nm, elbow.spec.no_load_speed_rad_s, elbow.load_friction) == (1.4, 6.0, 0.1)
    assert servo.noise_tick == 1.1
    assert masses.points_kg == (0.07,) * 7
    assert not servo.variants.ramp_from_reference
    assert [joint.coulomb_Nm for joint in joints[:2]] == [joint.coulomb_Nm for joint in drawn[:2]]


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"arm_id": "another"}, "of arm another"),
        ({"points_kg": "heavy"}, "points_kg"),
        ({"joints": {}}, "with joints"),
        ({"colour": "red"}, "colour"),
    ],
)
def test_a_file_that_is_no_twin_of_this_arm_is_refused(
    arm: ArmConfig, tmp_path: Path, changes: dict[str, object], text: str
) -> None:
    with pytest.raises(ConfigError, match=text):
        load_twin(written(tmp_path, arm, **changes), arm)


def test_text_that_is_no_json_is_refused(arm: ArmConfig, tmp_path: Path) -> None:
    (tmp_path / "x.json").write_text("joints:")
    with pytest.raises(ConfigError, match="not JSON"):
        load_twin(tmp_path / "x.json", arm)
