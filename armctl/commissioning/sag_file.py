"""The lag model of an arm on disk: NAME.sag.json beside its calibration file NAME.yaml.

What it is learnt from, and what it was before, lies beside it: NAME.sag-history.json. An arm that comes with armctl has
both in the data folder: nobody writes into a package.
"""

import json
import logging
from dataclasses import asdict
from operator import attrgetter
from pathlib import Path
from typing import Annotated, Self

import numpy as np
from pydantic import Field

from armctl.commissioning.arm_file import write
from armctl.config import ArmConfig, Config, Frozen, Name, validate
from armctl.errors import ConfigError
from armctl.files import data_dir, find_arm_file, read_text, shipped_dirs
from armctl.messages import LagModel
from armctl.strict_yaml import parse_json
from armctl.trajectory.lag import Summary
from armctl.trajectory.learning import KEPT, Experience, Lesson

_log = logging.getLogger(__name__)

# Learnt models that are remembered.
MODELS = 10
# Of a row of a `LagModel`, behind the downstream links.
COLUMNS = ("friction_rad", "damping_s", "constant_rad")

Row = Annotated[tuple[float, ...], Field(strict=False)]
Rows = Annotated[tuple[Row, ...], Field(strict=False)]


class SagFile(Frozen):
    """Coefficients of one arm, a row a joint."""

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    # Of each downstream link [rad/m], shape (n, n).
    gravity_rad_m: Rows
    friction_rad: Row
    damping_s: Row
    constant_rad: Row
    # Standard deviation of what the equation leaves, one encoder reading's noise included.
    residual_tick: Row
    # How many motions it was identified or learnt from; 0: it is the nominal arm's.
    lines: int = Field(ge=0)
    # 0: it was identified by calibration lines; else its number among those that were learnt of this arm.
    version: int = Field(0, ge=0)
    # When, as ISO 8601; empty: nobody noted it.
    made: str = Field("", max_length=40)

    def _check(self) -> None:
        n = len(self.gravity_rad_m)
        if any(len(row) != n for row in (*self.gravity_rad_m, *attrgetter(*COLUMNS)(self), self.residual_tick)):
            raise ValueError(f"every row must have {n} numbers, one a joint")


def path_of(config: Config) -> Path:
    """Where the model of the configured arm lies."""
    path = find_arm_file(config.arm)
    if path.resolve().parent in shipped_dirs():
        path = data_dir(config) / "sag" / path.name
    return path.with_suffix(".sag.json")


def load(config: Config, arm: ArmConfig) -> LagModel | None:
    """The model of this arm and calibration; None where there is none, or it is of another calibration.

    Raises:
        ConfigError: the file is no sag model.
    """
    if not (path := path_of(config)).exists():
        return None
    found = validate(SagFile, parse_json(read_text(path, "sag model"), str(path), "identify it again"), str(path))
    if (found.arm_id, found.calibration_hash) != (arm.arm_id, arm.calibration_hash):
        text = "%s: of calibration %s, the arm has %s; not used"
        _log.warning(text, path, found.calibration_hash, arm.calibration_hash)
        return None
    rows = np.column_stack([found.gravity_rad_m, *attrgetter(*COLUMNS)(found)]).tolist()
    return LagModel(found.arm_id, found.calibration_hash, tuple(map(tuple, rows)), found.residual_tick, found.lines)


def save(config: Config, model: LagModel, *, version: int = 0, made: str = "") -> Path:
    """Write the model beside the calibration.

    Args:
        version, made: See `SagFile`.
    Raises:
        ConfigError: it cannot be written there.
    """
    path, rows = path_of(config), np.array(model.rows)
    told = asdict(model) | {"gravity_rad_m": rows[:, : len(rows)].tolist(), "version": version, "made": made}
    told |= zip(COLUMNS, rows[:, len(rows) :].T.tolist(), strict=True)
    del told["rows"]
    write(path, json.dumps(SagFile(**told).model_dump(mode="json"), indent=1) + "\n")
    return path


# ------------------------------------------------------------------------------------------------- history


class Found(Frozen):
    """A model that was learnt."""

    version: int
    made: str
    motions: int
    rows: Rows


class History(Frozen):
    """What a model is learnt from, and what was learnt before."""

    arm_id: Name
    calibration_hash: str = Field(max_length=64)
    # See `learning.Experience`.
    strange: int = Field(0, ge=0)
    # Of each motion, the oldest first: of each joint the upper triangle of XX, Xy, yy and the count.
    motions: Annotated[tuple[Rows, ...], Field(max_length=KEPT, strict=False)]
    # The newest last.
    models: Annotated[tuple[Found, ...], Field(max_length=MODELS, strict=False)]

    @property
    def version(self) -> int:
        return self.models[-1].version if self.models else 0

    def experience(self) -> Experience:
        return Experience(tuple(map(_summary, self.motions)), self.strange)

    def after(self, lesson: Lesson, made: str) -> Self:
        """The history once a motion more has been learnt from."""
        models = self.models
        if (model := lesson.model) is not None:
            found = Found(version=self.version + 1, made=made, motions=model.lines, rows=model.rows)
            models = (*models, found)[-MODELS:]
        motions = tuple(map(_flat, lesson.experience.motions))
        return self.model_copy(update={"strange": lesson.experience.strange, "motions": motions, "models": models})


def _flat(of: Summary) -> tuple[tuple[float, ...], ...]:
    upper = np.triu_indices(of.XX.shape[1])
    columns = [of.XX[:, upper[0], upper[1]], of.Xy, of.yy[:, None], of.count[:, None]]
    return tuple(map(tuple, np.concatenate(columns, axis=1).tolist()))


def _summary(flat: tuple[tuple[float, ...], ...]) -> Summary:
    table = np.array(flat)
    n = len(table)
    k = n + 3
    upper, size = np.triu_indices(k), k * (k + 1) // 2
    XX = np.zeros((n, k, k))
    XX[:, upper[0], upper[1]] = XX[:, upper[1], upper[0]] = table[:, :size]
    return Summary(XX, table[:, size : size + k], table[:, -2], table[:, -1])


def load_history(config: Config, arm: ArmConfig, joints: int) -> History:
    """What was learnt of this arm and calibration; an empty one where there is none, or none that can be read.

    Args:
        joints: Of the arm's chain.
    """
    none = History(arm_id=arm.arm_id, calibration_hash=arm.calibration_hash, motions=(), models=())
    path = history_path(config)
    if not path.exists():
        return none
    width = (joints + 3) * (joints + 4) // 2 + joints + 5
    try:
        found = validate(History, parse_json(read_text(path, "sag history"), str(path)), str(path))
    except ConfigError as error:
        _log.warning("%s: not read, begun anew: %s", path, error)
        return none
    fits = all(len(motion) == joints and {len(row) for row in motion} == {width} for motion in found.motions)
    return found if (found.arm_id, found.calibration_hash) == (arm.arm_id, arm.calibration_hash) and fits else none


def save_history(config: Config, history: History) -> None:
    """Write it.

    Raises:
        ConfigError: it cannot be written there.
    """
    write(history_path(config), json.dumps(history.model_dump(mode="json")) + "\n")


def history_path(config: Config) -> Path:
    """Where it lies."""
    return path_of(config).with_suffix("").with_suffix(".sag-history.json")
