"""A host over servos behind the real control step, on a virtual clock; nothing happens but by its ticks."""

import asyncio
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any, Self

from armctl.clock import Clock, VirtualClock
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.host import teaching
from armctl.host.host import Host
from armctl.host.motions import run
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Mode, TickRecord
from armctl.trajectory.plan import Plan
from tests.control.ideal_arm import PERIOD_S, IdealArm
from tests.host.doubles import IdealControl, MemoryRecorder, NamedClient, refused, small_plan


class HostBench:
    """A host and its clients; `tick` is one tick, `served` ticks until something is done."""

    def __init__(self, arm: ArmConfig, robot: Robot, clock: Clock) -> None:
        self.recorder = MemoryRecorder()
        self.host = Host(arm, robot, PERIOD_S, self.recorder, clock)
        self.anna, self.ben = NamedClient("anna"), NamedClient("ben")

    def tick(self) -> TickRecord:
        raise NotImplementedError

    def ticks(self, count: int) -> None:
        for _ in range(count):
            self.tick()

    async def until(self, condition: Callable[[], bool]) -> None:
        for _ in range(5_000):
            for _ in range(5):  # what is under way takes a few turns of the loop
                await asyncio.sleep(0)
            if condition():
                return
            self.tick()
        raise AssertionError("it never came to pass")

    async def served(self, work: Awaitable[dict[str, Any]]) -> dict[str, Any]:
        task = asyncio.ensure_future(work)
        await self.until(task.done)
        return task.result()

    async def refused(self, work: Awaitable[dict[str, Any]], code: str) -> RequestRefused:
        """The refusal, of that code, that the work ends with."""
        with refused(code) as caught:
            await self.served(work)
        return caught.value

    async def holding(self) -> Self:
        self.tick()
        assert await self.served(self.host.command(self.anna, "torque_on")) == {"state": "holding"}
        return self


class Bench(HostBench):
    """A host over ideal servos."""

    def __init__(self, ideal: IdealArm | None = None, **calibration: Any) -> None:
        self.clock = VirtualClock()
        self.control = IdealControl(self.clock, ideal)
        self.arm = self.control.arm
        super().__init__(self.arm.arm.model_copy(update=calibration), self.arm.robot, self.clock)
        self.attach()

    def attach(self) -> None:
        """The control process is there, from the beginning or again."""
        self.host.exchange.attach(self.control.pid, self.control.link.send)

    def tick(self, **changes: Any) -> TickRecord:
        record = replace(self.control.tick(), **changes)
        self.host.receive(record)
        return record

    async def beat(self, client: NamedClient, *, begin: bool = False, **velocity: tuple[float, ...]) -> dict[str, Any]:
        """One heartbeat of a jog and the tick that answers it, and no tick more."""
        turn, lead = velocity.get("turn", ()), velocity.get("lead", ())
        task = asyncio.ensure_future(self.host.jog(client, turn, lead, begin))
        for _ in range(5):
            await asyncio.sleep(0)
        if not task.done():
            self.tick()
        return await task

    async def taking(self, name: str) -> None:
        """Anna teaches, and records a take."""
        await self.served(teaching.begin(self.host, self.anna))
        await self.served(teaching.take_begin(self.host, self.anna, name))

    def plan(self, **changes: object) -> Plan:
        return small_plan(self.arm, **changes)

    async def running(self) -> asyncio.Task[dict[str, Any]]:
        """Anna's run, under way."""
        task = asyncio.ensure_future(run(self.host, self.anna, self.plan()))
        await self.until(lambda: self.arm.mode() is Mode.MOVING)
        return task
