"""Ticks of a simulated arm: the real control loop and bus in virtual time."""

from collections.abc import Sequence

import numpy as np

from armctl.config import ArmConfig
from armctl.messages import JointTrajectory, Run, TickRecord, TorqueOn
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from tests.recording.factory import ARM, PERIOD_S


def nod(q: Sequence[float], seconds: float = 2.0) -> JointTrajectory:
    """There and back, the way there a plan; every joint a little towards its zero."""
    time_s = np.arange(0.0, seconds + PERIOD_S / 2.0, PERIOD_S)
    swing = 0.25 * (1.0 - np.cos(2.0 * np.pi * time_s / seconds)) / 2.0
    rows = tuple(tuple(value - np.sign(value) * angle for value in q) for angle in swing.tolist())
    return JointTrajectory(PERIOD_S, rows, begin_s=0.0, end_s=seconds / 2.0, label="nod")


def simulated_records(ticks: int = 60, *, arm: ArmConfig = ARM, seed: int = 3) -> list[TickRecord]:
    """Torque on, a nod, and rest."""
    virtual = VirtualArm(SimulatedArm(arm, seed=seed), PERIOD_S)
    virtual.start()
    records = [*virtual.ticks(3), *virtual.ticks(17, TorqueOn(1))]
    return records + virtual.ticks(ticks - len(records), Run(2, nod(virtual.goals_rad)))
