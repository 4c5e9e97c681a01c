"""What a robot is: lengths by name, the chain they make, its joint ranges, and what its paper says of it."""

import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Self

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.structure import ClosedForm, closed_form
from armctl.kinematics.transform import FloatArray


@dataclass(frozen=True)
class Robot:
    """A robot model; `chain` moves the tool point, further servos (gripper, roll) do not."""

    name: str
    source: str
    lengths_m: dict[str, float]
    make_chain: Callable[[dict[str, float]], SerialChain]
    # Lowest and highest position of each joint of the chain; none given: a whole turn each.
    ranges_deg: tuple[tuple[float, float], ...] = ()
    # False: inverse kinematics by numbers alone, whatever its structure.
    closes: bool = True

    @cached_property
    def chain(self) -> SerialChain:
        return self.make_chain(self.lengths_m)

    @cached_property
    def closed_form(self) -> ClosedForm | None:
        """Its inverse kinematics by formula; None: it is solved by numbers."""
        return closed_form(self.chain) if self.closes else None

    @cached_property
    def limits_rad(self) -> FloatArray:
        """Joint ranges, shape (n, 2)."""
        return np.asarray(np.radians(np.array(self.ranges_deg or ((-180.0, 180.0),) * self.chain.n)))

    def with_lengths(self, changes: dict[str, float]) -> Self:
        """The same robot with some lengths [m] replaced.

        Raises:
            ConfigError: a length the robot does not have.
        """
        for key in changes:
            if key not in self.lengths_m:
                raise ConfigError(self.name, key, "no such length", f"known: {', '.join(self.lengths_m)}")
            if not math.isfinite(changes[key]):
                raise ConfigError(self.name, key, f"{changes[key]} is no length", "give metres")
        return replace(self, lengths_m={**self.lengths_m, **changes}) if changes else self
