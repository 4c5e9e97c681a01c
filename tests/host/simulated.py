"""A host over simulated servos: the real control loop and bus in virtual time, everything in one process."""

import asyncio
import math
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Self

import numpy as np

from armctl.config import ArmConfig, Config, LogConfig
from armctl.files import load_arm
from armctl.messages import Command, Mode, TickRecord
from armctl.recording import replay
from armctl.recording.writer import LogContext
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault
from armctl.sim.virtual_arm import VirtualArm
from proving.hosted_arm import Inline
from tests.control.ideal_arm import PERIOD_S
from tests.host.bench import HostBench
from tests.recording.logs import write


class SimulatedBench(HostBench):
    """The bench; an arm under torque once `holding` returns."""

    def __init__(self, arm: ArmConfig, seed: int = 0) -> None:
        self.arm = arm
        self.simulated = SimulatedArm(arm, seed=seed)
        self.virtual = VirtualArm(self.simulated, PERIOD_S)
        self.virtual.start()
        self.robot, self.loop = self.virtual.robot, self.virtual.loop
        super().__init__(arm, self.robot, self.virtual.clock)
        self._waiting: list[Command] = []
        self.host.exchange.attach(4242, self._send)
        self.on_tick: Callable[[TickRecord], None] = lambda _: None
        self.modes: set[Mode] = set()

    def _send(self, command: Command) -> bool:
        self._waiting.append(command)
        return True

    def tick(self) -> TickRecord:
        commands, self._waiting = self._waiting, []
        record = self.virtual.tick(*commands)
        self.modes.add(record.outputs.mode)
        self.host.receive(record)
        self.on_tick(record)
        return record

    async def holding(self) -> Self:
        self.tick()  # the first one only takes the arm over
        return await super().holding()

    def place_object(self, at_rad: float) -> Callable[[], None]:
        """Something hard in the gripper, so thick that it stops it at `at_rad`; returns how to take it away."""
        assert self.arm.gripper is not None
        index = self.arm.joint_names.index(self.arm.gripper.joint)
        servo_id = self.arm.joints[index].servo_id
        numbers: list[int] = []

        def met(_: TickRecord) -> None:
            if not numbers and self.simulated.true_positions()[index] >= at_rad:
                fault = Fault(kind="blocked_joint", servo_id=servo_id)
                numbers.append(self.simulated.faults.begin(fault, self.simulated.time_s))

        self.on_tick = met

        def take_away() -> None:
            self.on_tick = lambda _: None
            self.simulated.faults.end(numbers[0])

        return take_away

    def off_mm(self, point_m: tuple[float, ...]) -> float:
        """How far the true tool point is from a point."""
        return 1e3 * math.dist(self.simulated.true_tool_position(), point_m)

    def true_deg(self) -> list[float]:
        return [float(angle) for angle in np.degrees(self.simulated.true_positions())]

    def replayed(self, path: Path) -> replay.ReplayResult:
        """Everything so far as a log, and its replay."""
        context = LogContext(self.arm, self.robot, Config(log=LogConfig(free_bytes=0)), "loopback", PERIOD_S)
        records = self.recorder.records
        return replay.check(write(path, records, notes={records[-1].inputs.tick: self.recorder.notes}, context=context))


@asynccontextmanager
async def on_arm(name: str, seed: int = 0) -> AsyncIterator[SimulatedBench]:
    """A fresh bench with that arm, holding."""
    asyncio.get_running_loop().set_default_executor(Inline())
    yield await SimulatedBench(load_arm(name), seed).holding()
