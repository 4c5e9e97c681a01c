"""What a robot is: lengths by name, the chain they make, its joint ranges, and what its paper says of it."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Protocol, Self

import numpy as np

from armctl.errors import ConfigError
from armctl.kinematics.chain import SerialChain
from armctl.kinematics.transform import FloatArray


class ClosedForm(Protocol):
    """Inverse kinematics by formula. Joint ranges play no part in it; angles lie within +-pi."""

    def poses(self, T: FloatArray) -> FloatArray:
        """Every configuration [rad] of poses (m, 4, 4), shape (m, branches, n); NaN where a branch does not exist."""

    def pose(self, T: Sequence[Sequence[float]]) -> list[tuple[float, ...]]:
        """Every configuration [rad] of one pose in plain floats; none where it is singular or out of reach."""

    def pose_families(self, T: FloatArray) -> FloatArray:
        """Configurations [rad] of one pose (4, 4), over what a pose leaves free, shape (branches, k, n)."""

    def positions(self, points: FloatArray) -> FloatArray:
        """Configurations [rad] with the tool on points [m] (m, 3), over what a point leaves free.

        Shape (m, branches, k, n); NaN where one does not exist.
        """

    def nearest_pose(self, T: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] (k, n) near a pose that is out of reach, and the least distance [m]."""

    def nearest_position(self, point: FloatArray) -> tuple[FloatArray, float]:
        """Configurations [rad] (k, n) of the tool's place nearest to a point, and its distance [m]."""


@dataclass(frozen=True)
class Robot:
    """A robot model; `chain` moves the tool point, further servos (gripper, roll) do not."""

    name: str
    source: str
    lengths_m: dict[str, float]
    make_chain: Callable[[dict[str, float]], SerialChain]
    make_closed_form: Callable[[dict[str, float]], ClosedForm | None] | None = None
    # Lowest and highest position of each joint of the chain; none given: a whole turn each.
    ranges_deg: tuple[tuple[float, float], ...] = ()

    @cached_property
    def chain(self) -> SerialChain:
        return self.make_chain(self.lengths_m)

    @cached_property
    def closed_form(self) -> ClosedForm | None:
        return None if self.make_closed_form is None else self.make_closed_form(self.lengths_m)

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
