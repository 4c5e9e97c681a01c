from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armctl.commissioning import sag_file
from armctl.config import Config
from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.trajectory.lag import Summary, nominal, summary
from armctl.trajectory.learning import Experience, Lesson
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


def some_history(motions: int = 3, models: int = 2) -> sag_file.History:
    rng, arm = np.random.default_rng(0), hand.arm()
    history = sag_file.History(arm_id=arm.arm_id, calibration_hash=arm.calibration_hash, motions=(), models=())
    sums: tuple[Summary, ...] = ()
    for _ in range(motions):
        sums += (summary(rng.standard_normal((9, 5)), rng.standard_normal((5, 9, 8))),)
    for _ in range(models):
        history = history.after(Lesson(Experience(sums, strange=2), MODEL), "2026-01-01T00:00:00+00:00")
    return history


def test_a_history_that_was_saved_is_loaded_bit_for_bit(config: Config) -> None:
    history = some_history()
    sag_file.save_history(config, history)
    assert sag_file.history_path(config).name == "mine.sag-history.json"
    found = sag_file.load_history(config, load_arm(config.arm), 5)
    assert found == history
    for one, other in zip(found.experience().motions, some_history().experience().motions, strict=True):
        for name, values in vars(one).items():
            np.testing.assert_array_equal(values, getattr(other, name))
            assert values.shape[0] == 5


def test_learnt_models_have_numbers_and_are_bounded(config: Config) -> None:
    history = some_history(models=sag_file.MODELS + 3)
    assert [found.version for found in history.models] == list(range(4, sag_file.MODELS + 4))
    sag_file.save(config, MODEL, version=history.version, made="2026-01-01T00:00:00+00:00")
    assert sag_file.load(config, load_arm(config.arm)) == MODEL


@pytest.mark.parametrize(
    "text", ["{", "[]", '{"arm_id": "other", "calibration_hash": "", "motions": [], "models": []}']
)
def test_a_history_that_is_none_or_of_another_arm_is_begun_anew(config: Config, text: str) -> None:
    sag_file.history_path(config).write_text(text, encoding="utf-8")
    assert sag_file.load_history(config, load_arm(config.arm), 5).motions == ()


def test_a_history_of_another_shape_is_begun_anew(config: Config) -> None:
    sag_file.save_history(config, some_history())
    assert sag_file.load_history(config, load_arm(config.arm), 4).motions == ()
