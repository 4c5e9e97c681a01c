from dataclasses import replace
from pathlib import Path

import pytest

from armctl.commissioning import sag_file
from armctl.config import Config
from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.trajectory.lag import nominal
from tests.genetic import hand

MODEL = replace(nominal(hand.arm(), hand.robot().chain), residual_tick=(0.5,) * 5, lines=8)


@pytest.fixture
def config(tmp_path: Path) -> Config:
    file = tmp_path / "mine.yaml"
    file.write_text(Path("calibration/ax12-line.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    return Config(arm=str(file))


def test_a_model_that_was_saved_is_loaded_bit_for_bit(config: Config) -> None:
    assert sag_file.save(config, MODEL).name == "mine.sag.json"
    assert sag_file.load(config, load_arm(config.arm)) == MODEL


def test_without_a_model_of_this_calibration_there_is_none(config: Config) -> None:
    assert sag_file.load(config, load_arm(config.arm)) is None
    sag_file.save(config, replace(MODEL, calibration_hash="other"))
    assert sag_file.load(config, load_arm(config.arm)) is None


@pytest.mark.parametrize(("text", "match"), [("{", "not JSON"), ("{}", "arm_id: Field required")])
def test_what_is_no_model_is_refused(config: Config, text: str, match: str) -> None:
    sag_file.path_of(config).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=match):
        sag_file.load(config, load_arm(config.arm))
