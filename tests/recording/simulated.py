"""Ticks of a simulated arm: the real control loop and bus in virtual time."""

from armctl.config import ArmConfig
from armctl.messages import Run, TickRecord, TorqueOn
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from tests.recording.factory import ARM, PERIOD_S, nod


def simulated_records(ticks: int = 60, *, arm: ArmConfig = ARM, seed: int = 3) -> list[TickRecord]:
    """Torque on, a nod, and rest."""
    virtual = VirtualArm(SimulatedArm(arm, seed=seed), PERIOD_S)
    virtual.start()
    records = [*virtual.ticks(3), *virtual.ticks(17, TorqueOn(1))]
    return records + virtual.ticks(ticks - len(records), Run(2, nod(virtual.goals_rad)))
