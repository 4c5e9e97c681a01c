"""Tick records for tests: the real control loop and bus on a simulated arm, in virtual time."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig, Config, LogConfig
from armctl.files import load_arm
from armctl.json_text import to_json
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Command, JointTrajectory, Run, TickRecord, TorqueOn
from armctl.recording import channels
from armctl.recording.channels import Anchor
from armctl.recording.writer import LogContext
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm

ARM: ArmConfig = load_arm("ax12-line")
ROBOT: Robot = robots.get(ARM.robot, ARM.lengths_m)
PERIOD_S = 0.1
CONTEXT = LogContext(ARM, ROBOT, Config(log=LogConfig(free_bytes=0)), "/dev/ttyUSB0", PERIOD_S)
ANCHOR = Anchor(1_750_000_000_123_456_789, 5 * NS_PER_S)


def nod(q: Sequence[float], seconds: float = 2.0) -> JointTrajectory:
    """There and back, the way there a plan; every joint a little towards its zero."""
    time_s = np.arange(0.0, seconds + PERIOD_S / 2.0, PERIOD_S)
    swing = 0.25 * (1.0 - np.cos(2.0 * np.pi * time_s / seconds)) / 2.0
    rows = tuple(tuple(value - np.sign(value) * angle for value in q) for angle in swing.tolist())
    return JointTrajectory(PERIOD_S, rows, begin_s=0.0, end_s=seconds / 2.0, label="nod")


# Commands by tick, or what makes them of the arm as it is then.
Script = Mapping[int, Sequence[Command] | Callable[[VirtualArm], Sequence[Command]]]
RUN_SCRIPT: Script = {3: (TorqueOn(1),), 20: lambda arm: (Run(2, nod(arm.goals_rad)),)}


def make_records(
    ticks: int, script: Script = RUN_SCRIPT, *, seed: int = 0, keyframe_ticks: int = 600
) -> list[TickRecord]:
    """`ticks` consecutive records."""
    virtual = VirtualArm(SimulatedArm(ARM, seed=seed), PERIOD_S, clock=VirtualClock(5 * NS_PER_S))
    virtual.start()
    records = []
    for tick in range(ticks):
        commands = script.get(tick, ())
        record = virtual.tick(*(commands(virtual) if callable(commands) else commands))
        keyframe = to_json(virtual.loop.state) if tick % keyframe_ticks == 0 else ""
        records.append(replace(record, keyframe=keyframe))
    return records


def times_s(records: Sequence[TickRecord]) -> list[float]:
    """When each tick was sampled, since the first one; that one identifies the servos, and is 31 ms late."""
    times_ns = [record.inputs.sample.time_ns for record in records]
    return [(time_ns - times_ns[0]) / NS_PER_S for time_ns in times_ns]


def tick_messages(record: TickRecord) -> list[channels.Message]:
    """Every message of one tick in file order, without state and diagnostics, which do not come every tick."""
    servos, cycle = channels.servos_row(record, ANCHOR, ARM), channels.cycle_row(record, ANCHOR)
    return [
        (servos.topic, servos.value()),
        *channels.command_messages(record),
        *((row.topic, row.value()) for row in channels.output_rows(record, ANCHOR, ARM, ROBOT)),
        *channels.event_messages(record, ANCHOR, ARM),
        (cycle.topic, cycle.value()),
    ]
