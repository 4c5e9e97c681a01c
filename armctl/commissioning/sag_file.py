"""The lag model of an arm on disk: NAME.sag.json beside its calibration file NAME.yaml."""

import json
import logging
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field, model_validator

from armctl.config import ArmConfig, Config, Frozen, Name, validate
from armctl.errors import ConfigError
from armctl.files import find_arm_file, read_text
from armctl.messages import LagModel

_log = logging.getLogger(__name__)

Row = Annotated[tuple[float, ...], Field(strict=False)]


class SagFile(Frozen):
    """Coefficients of one arm, a row a joint."""

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    # Of each downstream link [rad/m], shape (n, n).
    gravity_rad_m: tuple[Row, ...] = Field(strict=False)
    friction_rad: Row
    damping_s: Row
    constant_rad: Row
    # Standard deviation of what the equation leaves, one encoder reading's noise included.
    residual_tick: Row
    # How many it was identified from; 0: it is the nominal arm's.
    lines: int = Field(ge=0)

    @model_validator(mode="after")
    def _check(self) -> Self:
        n = len(self.gravity_rad_m)
        of_joints = (*self.gravity_rad_m, self.friction_rad, self.damping_s, self.constant_rad, self.residual_tick)
        if any(len(row) != n for row in of_joints):
            raise ValueError(f"every row must have {n} numbers, one a joint")
        return self


def path_of(config: Config) -> Path:
    """Where the model of the configured arm lies."""
    return find_arm_file(config.arm).with_suffix(".sag.json")


def load(config: Config, arm: ArmConfig) -> LagModel | None:
    """The model of this arm and calibration; None where there is none, or it is of another calibration.

    Raises:
        ConfigError: the file is no sag model.
    """
    if not (path := path_of(config)).exists():
        return None
    try:
        data = json.loads(read_text(path, "sag model"))
    except ValueError as error:
        raise ConfigError(str(path), "", f"not JSON: {error}", "identify it again") from None
    found = validate(SagFile, data, str(path))
    if (found.arm_id, found.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        _log.warning(
            "%s: of calibration %s, the arm has %s; not used", path, found.calibration_hash, arm.calibration_hash
        )
        return None
    columns = (found.friction_rad, found.damping_s, found.constant_rad)
    rows = np.column_stack([found.gravity_rad_m, *columns]).tolist()
    return LagModel(found.arm_id, found.calibration_hash, tuple(map(tuple, rows)), found.residual_tick, found.lines)


def save(config: Config, model: LagModel) -> Path:
    """Write the model beside the calibration.

    Raises:
        ConfigError: it cannot be written there.
    """
    path, rows = path_of(config), np.array(model.rows)
    n = len(rows)
    friction, damping, constant = rows[:, n:].T.tolist()
    told = SagFile(
        arm_id=model.arm_id,
        calibration_hash=model.calibration_hash,
        gravity_rad_m=tuple(map(tuple, rows[:, :n].tolist())),
        friction_rad=tuple(friction),
        damping_s=tuple(damping),
        constant_rad=tuple(constant),
        residual_tick=model.residual_tick,
        lines=model.lines,
    )
    try:
        path.write_text(json.dumps(told.model_dump(mode="json"), indent=1) + "\n", encoding="utf-8")
    except OSError as error:
        raise ConfigError(str(path), "", f"cannot write the sag model: {error.strerror}") from None
    return path
