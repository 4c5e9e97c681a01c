"""A pick-and-transfer cycle without a daemon: simulated servos, the real control loop, virtual time, a log like any."""

from __future__ import annotations

import json
from dataclasses import asdict
from pathlib import Path

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig, Config, LogConfig
from armctl.control.loop import ControlLoop
from armctl.dynamixel.bus import ServoBus
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.messages import Command, Mode, Run, TickRecord, TorqueOn
from armctl.recording.channels import COMMAND
from armctl.recording.writer import LogContext, LogWriter
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.loopback import LoopbackPort
from armctl.trajectory.transfer import NOTED, Cycle, transfer_trajectory

FIRST_TICKS = 5
MOST_TICKS = 20_000
TAIL_TICKS = 5


def record(arm: ArmConfig, cycle: Cycle, path: Path, *, seed: int = 0, period_s: float = 0.1) -> Path:
    """Run the cycle on a simulated arm and record it at `path`, as the daemon records a run.

    Raises:
        RequestRefused: the cycle cannot be run: UNREACHABLE, PREFLIGHT, or what the arm said.
        LogError: the file exists, or cannot be written.
    """
    robot = robots.get(arm.robot, arm.lengths_m)
    clock = VirtualClock(NS_PER_S)
    bus = ServoBus(LoopbackPort(SimulatedBus(SimulatedArm(arm, seed=seed)), clock), arm.servo_ids, clock)
    loop = ControlLoop(bus, clock, arm, robot, period_s)
    loop.open()
    records = [loop.tick(()) for _ in range(FIRST_TICKS)]
    records += _carried_out(loop, TorqueOn(1))
    goal = loop.state.goal
    assert goal is not None
    q_now = [joint.position_rad(tick) for joint, tick in zip(arm.joints, goal, strict=True)]
    begin = len(records)
    records += _carried_out(loop, Run(2, transfer_trajectory(cycle, q_now, arm, robot, period_s)))
    records += [loop.tick(()) for _ in range(TAIL_TICKS)]
    note = json.dumps({"event": NOTED, "cycle": asdict(cycle)})
    # A bound on free space is the daemon's business: this file is a few hundred kilobytes.
    context = LogContext(arm, robot, Config(log=LogConfig(free_bytes=0)), "loopback", period_s)
    writer = LogWriter(path, context)
    try:
        for index, one in enumerate(records):
            writer.write_tick(one)
            if index == begin:
                writer.write_note(COMMAND, note, one.inputs.sample.time_ns)
    finally:
        writer.close()
    return path


def _carried_out(loop: ControlLoop, command: Command) -> list[TickRecord]:
    """Tick until the command is answered.

    Raises:
        RequestRefused: the answer is no.
    """
    records = [loop.tick((command,))]
    while not records[-1].outputs.replies:
        assert len(records) < MOST_TICKS, f"no answer; the arm is {loop.state.mode}"
        records.append(loop.tick(()))
    reply = records[-1].outputs.replies[0]
    if not reply.ok:
        raise RequestRefused(reply.code, reply.message)
    assert loop.state.mode is Mode.HOLDING
    return records
