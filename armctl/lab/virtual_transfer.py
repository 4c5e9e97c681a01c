"""A pick-and-transfer cycle without a daemon: simulated servos, the real control loop, virtual time, a usual log."""

import json
from contextlib import closing
from pathlib import Path

from armctl.config import ArmConfig, Config, LogConfig
from armctl.messages import Run
from armctl.recording.writer import LogContext, LogWriter
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.transfer import NOTED, TransferRequest, transfer_trajectory

# Ticks at rest before torque comes on, and after the cycle.
FIRST_TICKS = TAIL_TICKS = 5


def record(arm: ArmConfig, cycle: TransferRequest, path: Path, *, seed: int = 0, period_s: float = 0.1) -> Path:
    """Run the cycle on a simulated arm and record it at `path`, as the daemon records a run.

    Raises:
        RequestRefused: the cycle cannot be run: UNREACHABLE, PREFLIGHT, or what the arm said.
        LogError: the file exists, or cannot be written.
    """
    virtual = VirtualArm(SimulatedArm(arm, seed=seed), period_s)
    records = virtual.energise(FIRST_TICKS)
    begin = len(records)
    records += virtual.carry_out(Run(virtual.next_id(), transfer_trajectory(cycle, virtual.goals_rad, virtual)))
    records += virtual.ticks(TAIL_TICKS)
    note = json.dumps({"event": NOTED, "cycle": cycle.model_dump()})
    # A bound on free space is the daemon's business: this file is a few hundred kilobytes.
    context = LogContext(arm, virtual.robot, Config(log=LogConfig(free_bytes=0)), "loopback", period_s)
    with closing(LogWriter(path, context)) as writer:
        for index, record in enumerate(records):
            writer.write_tick(record)
            if index == begin:
                writer.write_note(note, record.inputs.sample.time_ns)
    return path
