"""Tick records for tests: the real control step in front of servos that are at their goal at once."""

import random
from collections.abc import Mapping, Sequence

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig, Config, LogConfig
from armctl.control.machine import State
from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.messages import (
    Command,
    Connected,
    Inputs,
    JointTrajectory,
    Run,
    Sample,
    ServoReading,
    TickRecord,
    TorqueOn,
    to_json,
)
from armctl.recording import channels
from armctl.recording.channels import Anchor
from armctl.recording.writer import LogContext

ARM: ArmConfig = load_arm("ax12-line")
ROBOT: Robot = robots.get(ARM.robot, ARM.lengths_m)
PERIOD_S = 0.1
CONTEXT = LogContext(ARM, ROBOT, Config(log=LogConfig(free_bytes=0)), "/dev/ttyUSB0", PERIOD_S)
ANCHOR = Anchor(1_750_000_000_123_456_789, 5 * NS_PER_S)


class Servos:
    """Register blocks of servos that reach their goal within a tick."""

    def __init__(self, seed: int) -> None:
        self._rng = random.Random(seed)
        self._blocks = [bytearray(ax12a.STATUS_SIZE) for _ in ARM.joints]
        for joint, block in zip(ARM.joints, self._blocks, strict=True):
            for register in ax12a.REGISTERS:
                if register.address >= ax12a.STATUS_BEGIN:
                    self._set(block, register.address, register.size, register.default)
            tick = round(joint.tick(0.3))
            self._set(block, ax12a.GOAL.address, 2, tick)
            self._set(block, ax12a.PRESENT_POSITION.address, 2, tick)

    @staticmethod
    def _set(block: bytearray, address: int, size: int, value: int) -> None:
        at = address - ax12a.STATUS_BEGIN
        block[at : at + size] = value.to_bytes(size, "little")

    def sample(self, time_ns: int) -> Sample:
        readings = []
        for joint, block in zip(ARM.joints, self._blocks, strict=True):
            self._set(block, ax12a.PRESENT_TEMPERATURE.address, 1, 30 + self._rng.randrange(3))
            self._set(block, ax12a.PRESENT_LOAD.address, 2, self._rng.randrange(200))
            stamp_ns = time_ns + 700_000 * joint.servo_id
            readings.append(ServoReading(joint.servo_id, bytes(block), stamp_ns, True))
        return Sample(time_ns, tuple(readings), bus_us=4600 + self._rng.randrange(300), retries=0)

    def follow(self, record: TickRecord) -> None:
        for write in record.outputs.writes:
            block = self._blocks[ARM.servo_ids.index(write.servo_id)]
            self._set(block, write.address, write.size, write.value)
        if record.outputs.goal is not None:
            for block, tick in zip(self._blocks, record.outputs.goal.ticks, strict=True):
                self._set(block, ax12a.GOAL.address, 2, tick)
                if ax12a.register_value(ax12a.TORQUE_ENABLE, bytes(block)):
                    self._set(block, ax12a.PRESENT_POSITION.address, 2, tick)


def sweep(begin_rad: Sequence[float], seconds: float = 3.0) -> JointTrajectory:
    """A slow move of every joint, with a plan window inside."""
    n = round(seconds / PERIOD_S)
    positions = tuple(tuple(q - 0.004 * i for q in begin_rad) for i in range(n + 1))
    return JointTrajectory(PERIOD_S, positions, begin_s=0.5, end_s=seconds - 0.5, label="sweep")


def run_command(request_id: int = 2) -> Run:
    """A run from where `make_records` begins."""
    return Run(request_id, sweep([joint.position_rad(round(joint.tick(0.3))) for joint in ARM.joints]))


RUN_SCRIPT: Mapping[int, Sequence[Command]] = {3: (TorqueOn(1),), 20: (run_command(),)}


def make_records(
    ticks: int, script: Mapping[int, Sequence[Command]] = RUN_SCRIPT, *, seed: int = 0, keyframe_ticks: int = 600
) -> list[TickRecord]:
    """`ticks` consecutive records; commands by tick."""
    servos, state, records = Servos(seed), State(), []
    for tick in range(ticks):
        time_ns = 5 * NS_PER_S + tick * NS_PER_S // 10
        commands = ((Connected(),) if tick == 0 else ()) + tuple(script.get(tick, ()))
        inputs = Inputs(tick, time_ns + 4_700_000, servos.sample(time_ns), commands, late_ns=30_000 + tick)
        state, outputs = step(state, inputs, ARM, ROBOT, PERIOD_S)
        keyframe = to_json(state) if tick % keyframe_ticks == 0 else ""
        record = TickRecord(inputs, outputs, lateness_us=30, write_us=210, keyframe=keyframe)
        servos.follow(record)
        records.append(record)
    return records


def tick_messages(record: TickRecord) -> list[channels.Message]:
    """Every message of one tick in file order, without state and diagnostics, which do not come every tick."""
    servos, cycle = channels.servos_row(record, ARM), channels.cycle_row(record)
    return [
        channels.row_message(servos, record, ANCHOR),
        *channels.command_messages(record),
        *channels.output_messages(record, ANCHOR, ARM, ROBOT),
        channels.row_message(cycle, record, ANCHOR),
    ]
