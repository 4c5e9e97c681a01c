"""What an optimisation is asked for: one object from the command line and the socket to the job and to `optimize`."""

import json
from dataclasses import asdict
from typing import Annotated

from pydantic import Field, TypeAdapter, field_validator

from armctl.config import Frozen
from armctl.errors import ConfigError
from armctl.genetic.algorithm import DEFAULT, Settings
from armctl.messages import LONGEST_S
from armctl.trajectory.bounds import Point
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.placement import Objective

MAX_VIA = 20

# Numbers of via points, one for each plan wanted.
ViaCounts = Annotated[tuple[Annotated[int, Field(ge=0, le=MAX_VIA)], ...], Field(max_length=MAX_VIA + 1, strict=False)]


class OptimizeRequest(Frozen):
    """A line, and how the straightest motion along it is looked for."""

    # A, where the line begins.
    from_m: Point
    # B, where it ends.
    to_m: Point
    via: ViaCounts
    # Nominal time from A to B.
    duration_s: float = Field(5.0, gt=0.0, le=LONGEST_S)
    # Same seed, same result, bit for bit.
    seed: int = Field(0, ge=0, lt=2**63)
    interpolation: Interpolation = "cubic"
    # What is made small: the mean distance, its root mean square ("mix"), or the 10-norm ("max").
    objective: Objective = "mean"
    # Whether genes may leave the recordings, and via points the path that was found.
    free: bool = True
    # Settings of the genetic algorithm; a mapping names those that differ from its defaults.
    settings: Settings = DEFAULT

    @field_validator("settings", mode="before")
    @classmethod
    def _complete(cls, value: object) -> object:
        if not isinstance(value, dict):
            return value
        known = asdict(DEFAULT)
        for key in value:
            if key not in known:
                raise ValueError(f"{key}: unknown setting; known: {', '.join(known)}")
        try:
            return TypeAdapter(Settings).validate_json(json.dumps(known | value), strict=True)
        except ConfigError as error:
            raise ValueError(str(error)) from None
