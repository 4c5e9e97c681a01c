"""A simulated arm on a pseudo terminal, in real time, whose hand obeys lines: `python -m tests.commissioning.held_arm`.

Arguments are the link and the arm's file. `lead A B ...` leads the joints there [deg], `free N` leaves a joint free,
`release` lets go. Each is answered by `there`, once the hand has come to rest.
"""

import sys
import threading
import time
from collections import deque
from dataclasses import replace
from pathlib import Path

import click
import numpy as np

from armctl.files import load_arm
from armctl.sim import pty
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import DEFAULT_SPEC
from proving.put_together import SteadyHand


class ObedientHand(SteadyHand):
    """Does what another thread wants, when the arm looks at its hand."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm)
        self._from_rad = self.to_rad = np.array([joint.rest_rad for joint in arm.config.joints])
        self.orders: deque[str] = deque()

    @property
    def holding(self) -> bool:
        while self.orders:
            order, *values = self.orders[0].split()
            if order == "lead":
                self._from_rad, self._begin_s = np.array(self.aim(self._arm.time_s)[0]), self._arm.time_s
                self.to_rad, self.free = np.radians([float(value) for value in values]), None
            elif order == "free":
                self.free = int(values[0])
            else:
                self.release()
            self.orders.popleft()
        return super().holding

    def obey(self) -> None:
        """Do what every line of standard input says."""
        for line in sys.stdin:
            self.orders.append(line)
            while self.orders or self._arm.time_s < self._begin_s + self.CARRY_S + 0.3:
                time.sleep(0.02)
            click.echo("there")


def run(link: Path, arm_file: str) -> None:
    """The arm, until it is ended."""
    arm = SimulatedArm(load_arm(arm_file), spec=replace(DEFAULT_SPEC, zero_offset_tick=0.0))
    hand = arm.hand = ObedientHand(arm)
    threading.Thread(target=hand.obey, daemon=True).start()
    pty.run(arm, link=link, ready=click.echo)


if __name__ == "__main__":
    run(Path(sys.argv[1]), sys.argv[2])
