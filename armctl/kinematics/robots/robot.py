"""What a robot is: lengths by name, and the chain they make."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property

from armctl.errors import ConfigError
from armctl.kinematics.chain import SerialChain


@dataclass(frozen=True)
class Robot:
    """A robot model; `chain` moves the tool point, further servos (gripper, roll) do not."""

    name: str
    source: str
    lengths_m: dict[str, float]
    make_chain: Callable[[dict[str, float]], SerialChain]

    @cached_property
    def chain(self) -> SerialChain:
        return self.make_chain(self.lengths_m)

    def with_lengths(self, changes: dict[str, float]) -> Robot:
        """The same robot with some lengths [m] replaced.

        Raises:
            ConfigError: a length the robot does not have.
        """
        for key in changes:
            if key not in self.lengths_m:
                raise ConfigError(self.name, key, "no such length", f"known: {', '.join(self.lengths_m)}")
        return replace(self, lengths_m={**self.lengths_m, **changes}) if changes else self
