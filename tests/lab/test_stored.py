from __future__ import annotations

from pathlib import Path

import pytest

from armctl.config import Config
from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.lab import sag_model, stored
from tests.genetic import hand


@pytest.fixture
def config(tmp_path: Path) -> Config:
    file = tmp_path / "mine.yaml"
    file.write_text(Path("calibration/ax12-line.yaml").read_text(encoding="utf-8"), encoding="utf-8")
    return Config(arm=str(file))


def test_a_model_that_was_saved_is_loaded_bit_for_bit(config: Config) -> None:
    model = sag_model.nominal(hand.arm(), hand.robot().chain)
    assert stored.save(config, model).name == "mine.sag.json"
    assert stored.load(config, load_arm(config.arm)) == model


def test_without_a_model_there_is_none(config: Config) -> None:
    assert stored.load(config, load_arm(config.arm)) is None


def test_a_model_of_another_calibration_is_not_used(config: Config) -> None:
    model = sag_model.nominal(hand.arm(), hand.robot().chain)
    stored.save(config, model.model_copy(update={"calibration_hash": "other"}))
    assert stored.load(config, load_arm(config.arm)) is None


@pytest.mark.parametrize(("text", "match"), [("{", "not JSON"), ("{}", "arm_id: Field required")])
def test_what_is_no_model_is_refused(config: Config, text: str, match: str) -> None:
    stored.path_of(config).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=match):
        stored.load(config, load_arm(config.arm))
