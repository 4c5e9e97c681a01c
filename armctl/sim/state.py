"""The numbers a simulated arm's physics changes, in flat arrays that both Python and machine code see.

Python's own arrays give plain floats and ints, several times faster than numpy's scalars; numpy's views of the same
memory are what numba takes. `steps.py` names the places.
"""

from __future__ import annotations

import math
from array import array
from typing import Any

import numpy as np

from armctl.sim import steps
from armctl.sim.spec import ArmSpec
from armctl.sim.steps import STEP_S


class State:
    """All numbers of one arm, and the functions of `steps.py` on them."""

    def __init__(self, spec: ArmSpec, joints: int, links: int, chain: array[float]) -> None:
        """An arm that is to be weighed when its first chunk begins; `Joint` fills in each of its joints.

        Args:
            links: How many of the joints are the chain's.
            chain: As `gravity.laid_out` gives it.
        """
        self.numbers = array("d", bytes(8 * (steps.ARM_NUMBERS + joints * steps.JOINT_NUMBERS)))
        self.counts = array("q", bytes(8 * (steps.ARM_COUNTS + joints * steps.JOINT_COUNTS)))
        self.counts[steps.JOINTS], self.counts[steps.LINKS], self.counts[steps.STILL] = joints, links, 1
        shared = (
            *(spec.supply_V, spec.supply_V, spec.no_load_speed_rad_s),
            *(spec.shaft_friction_Nm, spec.play_speed_rad_s * STEP_S),
            *(spec.overload_output, spec.overload_s, spec.supply_ohm, spec.stall_current_A),
            *(spec.idle_degC, spec.stall_heating_degC, spec.rotor_inertia_kg_m2, math.radians(spec.rest_support_deg)),
        )
        for place, value in enumerate(shared, steps.SUPPLY_V):
            self.numbers[place] = value
        self.plain = self.numbers, self.counts, chain
        """What the functions of `steps.py` take, as they stand and as machine code."""
        self.views: Any = (
            np.frombuffer(self.numbers, np.float64),
            np.frombuffer(self.counts, np.int64),
            np.frombuffer(chain, np.float64),
        )

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
