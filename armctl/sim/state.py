"""The numbers a simulated arm's physics changes, in flat arrays that both Python and machine code see.

Python's own arrays give plain floats and ints, several times faster than numpy's scalars; numpy's views of the same
memory are what numba takes. `steps.py` names the places. A joint's places are its own and its servo's: what the
physics makes of a servo is there for it to report without anybody carrying it over.
"""

from __future__ import annotations

import math
from array import array
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.sim import steps
from armctl.sim.steps import STEP_S

if TYPE_CHECKING:
    from armctl.sim.spec import ArmSpec


class Seat:
    """The places of one joint, and of its servo, in a state."""

    def __init__(self, state: State, i: int) -> None:
        self.state, self.i = state, i
        self.numbers, self.counts = state.numbers, state.counts
        self.at, self.of = steps.ARM_NUMBERS + i * steps.JOINT_NUMBERS, steps.ARM_COUNTS + i * steps.JOINT_COUNTS


class Number:
    """A number that lies in the seat of who has it."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, one: Seat, _: type[Seat]) -> float:
        return one.numbers[one.at + self._place]

    def __set__(self, one: Seat, value: float) -> None:
        one.numbers[one.at + self._place] = value


class Count:
    """A whole number, or a bool, that lies in the seat of who has it."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, one: Seat, _: type[Seat]) -> int:
        return one.counts[one.of + self._place]

    def __set__(self, one: Seat, value: int) -> None:
        one.counts[one.of + self._place] = value


class State:
    """All numbers of one arm, and the functions of `steps.py` on them."""

    def __init__(self, joints: int, links: int = 0, chain: array[float] | None = None) -> None:
        """An arm that is to be weighed when its first chunk begins; `Joint` fills in each of its joints.

        Args:
            links: How many of the joints are the chain's.
            chain: As `gravity.laid_out` gives it; None: no links.
        """
        chain = array("d", bytes(8 * steps.CHAIN_NUMBERS)) if chain is None else chain
        self.numbers = array("d", bytes(8 * (steps.ARM_NUMBERS + joints * steps.JOINT_NUMBERS)))
        self.counts = array("q", bytes(8 * (steps.ARM_COUNTS + joints * steps.JOINT_COUNTS)))
        self.counts[steps.JOINTS], self.counts[steps.LINKS], self.counts[steps.STILL] = joints, links, 1
        self.plain = self.numbers, self.counts, chain
        """What the functions of `steps.py` take, as they stand and as machine code."""
        self.views: Any = (
            np.frombuffer(self.numbers, np.float64),
            np.frombuffer(self.counts, np.int64),
            np.frombuffer(chain, np.float64),
        )

    def set_spec(self, spec: ArmSpec) -> None:
        """Say what the arm is made of."""
        shared = (
            *(spec.supply_V, spec.supply_V, spec.no_load_speed_rad_s),
            *(spec.shaft_friction_Nm, spec.play_speed_rad_s * STEP_S),
            *(spec.overload_output, spec.overload_s, spec.supply_ohm, spec.stall_current_A),
            *(spec.idle_degC, spec.stall_heating_degC, spec.rotor_inertia_kg_m2, math.radians(spec.rest_support_deg)),
        )
        for place, value in enumerate(shared, steps.SUPPLY_V):
            self.numbers[place] = value

    def set_pace(self, chunk_steps: tuple[int, int], fast_rad_s: float, weighed_rad: float, heating_s: float) -> None:
        """Say when to look at what couples the joints.

        Args:
            chunk_steps: Steps of a chunk, and of one while a joint turns faster than `fast_rad_s`.
            weighed_rad: Gravity stays while no joint is further than this from where it was weighed.
            heating_s: Time constant of the temperatures, which change from chunk to chunk.
        """
        self.counts[steps.CHUNK_STEPS], self.counts[steps.FAST_CHUNK_STEPS] = chunk_steps
        decays = (math.exp(-count * STEP_S / heating_s) for count in chunk_steps)
        for place, value in enumerate((fast_rad_s, weighed_rad, *decays), steps.FAST_RAD_S):
            self.numbers[place] = value

    def play(self, until: int, only: int) -> bool:
        """See `steps.play`."""
        numbers, counts, chain = self.views if steps.machine_code else self.plain
        return steps.play(numbers, counts, chain, until, only)

    def turn(self, i: int, ahead: int) -> None:
        """See `steps.turn`."""
        numbers, counts, _ = self.views if steps.machine_code else self.plain
        steps.turn(numbers, counts, i, ahead)

    def drain(self) -> None:
        """See `steps.drain`."""
        numbers, counts, _ = self.views if steps.machine_code else self.plain
        steps.drain(numbers, counts)

    def close_chunk(self) -> None:
        """See `steps.close_chunk`."""
        numbers, counts, _ = self.views if steps.machine_code else self.plain
        steps.close_chunk(numbers, counts)

    def warm(self, decay: float) -> None:
        """See `steps.warm`."""
        numbers, counts, _ = self.views if steps.machine_code else self.plain
        steps.warm(numbers, counts, decay)
