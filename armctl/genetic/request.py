"""What an optimisation is asked for: one object from the command line and the socket to the job and to `optimize`."""

import json
from dataclasses import asdict
from typing import Annotated

from pydantic import Field, TypeAdapter, field_validator

from armctl.config import Frozen
from armctl.errors import ConfigError
from armctl.genetic.algorithm import DEFAULT, Settings
from armctl.trajectory.bounds import Point
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.placement import Objective

MAX_VIA = 20
LONGEST_DURATION_S = 600.0

ViaCounts = Annotated[tuple[Annotated[int, Field(ge=0, le=MAX_VIA)], ...], Field(max_length=MAX_VIA + 1, strict=False)]
"""Numbers of via points, one for each plan wanted."""


class OptimizeRequest(Frozen):
    """A line, and how the straightest motion along it is looked for."""

    from_m: Point
    """A, where the line begins."""
    to_m: Point
    """B, where it ends."""
    via: ViaCounts
    duration_s: float = Field(5.0, gt=0.0, le=LONGEST_DURATION_S)
    """Nominal time from A to B."""
    seed: int = Field(0, ge=0, lt=2**63)
    """Same seed, same result, bit for bit."""
    interpolation: Interpolation = "cubic"
    objective: Objective = "mean"
    """What is made small: the mean distance, its root mean square ("mix"), or the 10-norm ("max")."""
    free: bool = True
    """Whether genes may leave the recordings, and via points the path that was found."""
    settings: Settings = DEFAULT
    """Of the genetic algorithm; as a mapping those that differ from its defaults."""

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
