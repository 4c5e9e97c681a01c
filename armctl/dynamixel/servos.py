"""Which servos there are, from the table `servos.yaml`: what tells one model from another."""

import math
from importlib import resources
from typing import NamedTuple

import yaml

DEFAULT = "ax-12a"


class ServoModel(NamedTuple):
    """One row of the table."""

    name: str
    # What the servo says of itself.
    model_number: int
    # At 12 V, as the speed.
    stall_torque_Nm: float
    no_load_rpm: float

    @property
    def no_load_speed_rad_s(self) -> float:
        return self.no_load_rpm * 2.0 * math.pi / 60.0


_TABLE = yaml.safe_load(resources.files(__package__).joinpath("servos.yaml").read_text("utf-8"))
# By name.
MODELS = {name: ServoModel(name, **row) for name, row in _TABLE.items()}


def by_number(model_number: int) -> ServoModel | None:
    """The model whose servos give this number; None: no servo that armctl drives."""
    return next((model for model in MODELS.values() if model.model_number == model_number), None)
