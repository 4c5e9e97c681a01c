"""A log of a simulated arm: the real control loop and bus in virtual time, written by the real writer."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from armctl.clock import VirtualClock
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.dynamixel.bus import ServoBus
from armctl.kinematics import robots
from armctl.messages import Command, JointTrajectory, Run, TickRecord, TorqueOn
from armctl.recording.writer import LogContext, LogWriter
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.loopback import LoopbackPort
from tests.recording.factory import ANCHOR, ARM, CONTEXT, PERIOD_S


def nod(q: Sequence[float], seconds: float = 2.0) -> JointTrajectory:
    """There and back, the way there a plan; every joint a little towards its zero."""
    time_s = np.arange(0.0, seconds + PERIOD_S / 2.0, PERIOD_S)
    swing = 0.25 * (1.0 - np.cos(2.0 * np.pi * time_s / seconds)) / 2.0
    rows = tuple(tuple(value - np.sign(value) * angle for value in q) for angle in swing.tolist())
    return JointTrajectory(PERIOD_S, rows, begin_s=0.0, end_s=seconds / 2.0, label="nod")


def simulated_records(ticks: int = 60, *, arm: ArmConfig = ARM, seed: int = 3) -> list[TickRecord]:
    """Torque on, a nod, and rest."""
    clock = VirtualClock()
    bus = ServoBus(LoopbackPort(SimulatedBus(SimulatedArm(arm, seed=seed)), clock), arm.servo_ids, clock)
    loop = ControlLoop(bus, clock, arm, robots.get(arm.robot, arm.lengths_m), PERIOD_S)
    loop.open()
    records: list[TickRecord] = []
    for tick in range(ticks):
        commands: tuple[Command, ...] = ()
        if tick == 3:
            commands = (TorqueOn(1),)
        if tick == 20:
            goal = loop.state.goal
            assert goal is not None
            commands = (Run(2, nod([joint.position_rad(one) for joint, one in zip(arm.joints, goal, strict=True)])),)
        records.append(loop.tick(commands))
    return records


def write_log(path: Path, records: Sequence[TickRecord], context: LogContext = CONTEXT) -> Path:
    """A finished file of these records."""
    writer = LogWriter(path, context, anchor=ANCHOR)
    for record in records:
        writer.write_tick(record)
    writer.close()
    return path
