"""The sag model of an arm on disk: NAME.sag.json beside the calibration file NAME.yaml."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from armctl.config import ArmConfig, Config, validate
from armctl.errors import ConfigError
from armctl.files import find_arm_file, read_text
from armctl.lab.sag_model import SagModel

_log = logging.getLogger(__name__)


def path_of(config: Config) -> Path:
    """Where the model of the configured arm lies."""
    return find_arm_file(config.arm).with_suffix(".sag.json")


def load(config: Config, arm: ArmConfig) -> SagModel | None:
    """The model of this arm and calibration; None where there is none, or it is of another calibration.

    Raises:
        ConfigError: the file is no sag model.
    """
    path = path_of(config)
    if not path.exists():
        return None
    try:
        data = json.loads(read_text(path, "sag model"))
    except ValueError as error:
        raise ConfigError(str(path), "", f"not JSON: {error}", "identify it again") from None
    model = validate(SagModel, data, str(path))
    if (model.arm_id, model.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        _log.warning(
            "%s: of calibration %s, the arm has %s; not used", path, model.calibration_hash, arm.calibration_hash
        )
        return None
    return model


def save(config: Config, model: SagModel) -> Path:
    """Write the model beside the calibration.

    Raises:
        ConfigError: it cannot be written there.
    """
    path = path_of(config)
    try:
        path.write_text(json.dumps(model.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot write the sag model: {error.strerror}") from None
    return path
