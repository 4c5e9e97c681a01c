"""What proofs of logs have in common: records of a simulated arm that moves, a folder in memory, a recorder in step."""

import contextlib
import logging
import math
import tempfile
import threading
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import Config, LogConfig
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.messages import Command, JointTrajectory, Mode, Run, ServoReading, TickRecord, TorqueOn
from armctl.recording.recorder import Recorder
from armctl.recording.writer import LogContext
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm

ARM = "ax12-line"
PERIOD_S = 0.1
AMPLITUDE_RAD = 0.25
SWING_TICKS = 70
TORQUE_TICK = 3


def log_context(log: LogConfig | None = None) -> LogContext:
    """What logs of the simulated arm have in common; without a bound on free space, unless `log` has one."""
    arm = load_arm(ARM)
    config = Config(log=log or LogConfig(free_bytes=0))
    return LogContext(arm, robots.get(arm.robot, arm.lengths_m), config, "loopback", PERIOD_S)


def simulated_records(seed: int, ticks: int, *, moving: bool = True) -> list[TickRecord]:
    """Consecutive ticks of an arm that is switched on and holds, or swings all its joints one swing after another."""
    virtual = VirtualArm(SimulatedArm(load_arm(ARM), seed=seed), PERIOD_S, clock=VirtualClock(5 * NS_PER_S))
    virtual.start()
    records: list[TickRecord] = []
    for tick in range(ticks):
        commands: tuple[Command, ...] = (TorqueOn(1),) if tick == TORQUE_TICK else ()
        if moving and tick > TORQUE_TICK and virtual.loop.state.mode is Mode.HOLDING:
            commands = (Run(tick, _swing(virtual)),)
        records.append(virtual.tick(*commands))
    return records


def repeated(records: list[TickRecord], ticks: int) -> Iterator[TickRecord]:
    """`ticks` records: the given ones again and again, at later times and with later numbers."""
    first, span = records[0].inputs, len(records)
    for tick in range(ticks):
        record = records[tick % span]
        shift = tick - tick % span
        if shift == 0:
            yield record
            continue
        later_ns = shift * round(PERIOD_S * NS_PER_S)
        sample = record.inputs.sample
        servos = tuple(_later(reading, later_ns) for reading in sample.servos)
        inputs = replace(
            record.inputs,
            tick=first.tick + tick,
            now_ns=record.inputs.now_ns + later_ns,
            sample=replace(sample, time_ns=sample.time_ns + later_ns, servos=servos),
            commands=(),
        )
        yield replace(record, inputs=inputs)


def _later(reading: ServoReading, later_ns: int) -> ServoReading:
    return replace(reading, stamp_ns=reading.stamp_ns + later_ns)


def _swing(virtual: VirtualArm) -> JointTrajectory:
    """All joints away and back, from where the arm is told to be."""
    begin_rad = virtual.goals_rad
    towards_rad = [
        math.copysign(AMPLITUDE_RAD, sum(joint.limits_rad) / 2.0 - q)
        for joint, q in zip(virtual.arm.joints, begin_rad, strict=True)
    ]
    phases = [0.5 - 0.5 * math.cos(2.0 * math.pi * i / SWING_TICKS) for i in range(SWING_TICKS + 1)]
    positions = tuple(
        tuple(q + phase * amplitude for q, amplitude in zip(begin_rad, towards_rad, strict=True)) for phase in phases
    )
    return JointTrajectory(PERIOD_S, positions)


@contextlib.contextmanager
def quietly() -> Iterator[None]:
    """Without a word in the log on what the disk does wrong here: it does it on purpose."""
    logger = logging.getLogger("armctl")
    level = logger.level
    logger.setLevel(logging.CRITICAL)
    try:
        yield
    finally:
        logger.setLevel(level)


def settle(recorder: Recorder) -> None:
    """Return when its thread has done everything queued before."""
    done = threading.Event()
    recorder._queue.put(done.set)
    while not done.wait(0.5):
        if not recorder._thread.is_alive():
            raise RuntimeError("the recorder's thread is gone")


@contextlib.contextmanager
def memory_folder() -> Iterator[Path]:
    """A folder that is gone afterwards."""
    memory = Path("/dev/shm")
    with tempfile.TemporaryDirectory(prefix="armctl-", dir=memory if memory.is_dir() else None) as folder:
        yield Path(folder)
