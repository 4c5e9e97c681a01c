"""One arm behind the daemon's own host, in virtual time: its table of methods, its recorder and what it learns.

What a client would send on the socket is checked and answered here by the same methods; the control step, the bus and
the simulated servos are those of the daemon, and the clock stands still while nobody ticks. Whoever asks is the only
client. The true tool is looked at by whoever gave a way to see it.
"""

import asyncio
import os
from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np

from armctl.config import Config, LogConfig
from armctl.errors import ArmctlError
from armctl.files import load_arm
from armctl.genetic.straight_line import Progress
from armctl.host.host import Host
from armctl.host.jobs import OptimizeJob, optimize_task
from armctl.host.learning import Learner
from armctl.host.methods import Methods
from armctl.host.server import Connection
from armctl.messages import Command, Mode, TickRecord
from armctl.recording.recorder import Recorder
from armctl.recording.writer import LogContext
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec
from armctl.sim.virtual_arm import VirtualArm
from proving.truth import FloatArray

PERIOD_S = 0.1
# No wait of the disk's is the arm's here.
QUEUE_RECORDS = 1_000_000
# A request that takes more ticks has lost its way.
MOST_TICKS = 6_000
# Turns of the event loop after which whatever is under way waits for the next tick.
TURNS = 5

P = ParamSpec("P")
T = TypeVar("T")


class Inline(ThreadPoolExecutor):
    """Does at once what the host gives to a thread: no virtual time passes meanwhile."""

    def submit(self, fn: Callable[P, T], /, *args: P.args, **kwargs: P.kwargs) -> Future[T]:
        future: Future[T] = Future()
        try:
            future.set_result(fn(*args, **kwargs))
        except Exception as error:
            future.set_exception(error)
        return future


class _Client:
    """The only one there is."""

    name, uid, subscribed = "the proof", 0, False

    def notify(self, method: str, params: dict[str, Any]) -> None:
        """Nobody listens to progress."""


class HostedArm:
    """One arm by its file; its recordings, logs and plans go below a folder. To be made where an event loop runs."""

    def __init__(
        self,
        file: Path,
        folder: Path,
        seed: int,
        tool_m: Callable[[FloatArray], FloatArray],
        spec: ArmSpec = DEFAULT_SPEC,
    ) -> None:
        """
        Args:
            tool_m: Where the tool truly is [m], (m, joints) -> (m, 3).
        """
        self.arm = load_arm(str(file))
        self.simulated, self._tool_m = SimulatedArm(self.arm, seed=seed, spec=spec), tool_m
        self.virtual = VirtualArm(self.simulated, PERIOD_S)
        self._config = Config(arm=str(file), data_dir=str(folder), log=LogConfig(free_bytes=0))
        self.serve(folder)
        self._client = cast(Connection, _Client())
        # Modes the arm has been in, codes of faults, and true joint positions at each tick.
        self.modes: set[Mode] = set()
        self.faults: set[str] = set()
        self.shafts_rad: list[FloatArray] = []
        # Where in them the last plan began and ended.
        self._planned = (0, 0)
        asyncio.get_running_loop().set_default_executor(Inline())
        self.virtual.start()
        self.ticks(3)

    def serve(self, folder: Path) -> None:
        """A new host, which knows what is on the disk; nothing of one before is left."""
        arm, robot, config = self.arm, self.virtual.robot, self._config
        self._recorder = Recorder(
            LogContext(arm, robot, config, "loopback", PERIOD_S),
            folder / "logs",
            folder / "recordings",
            queue_records=QUEUE_RECORDS,
            compactor=lambda _: None,
        )
        learner, clock = Learner(config, arm, robot, PERIOD_S), self.virtual.clock
        self._host = Host(arm, robot, PERIOD_S, self._recorder, clock, learner.load, learner.learn)
        self._methods = Methods(self._host, folder / "recordings", _optimised).table()
        self._host.exchange.attach(os.getpid(), self._send)
        self._waiting: list[Command] = []

    def close(self) -> None:
        self._recorder.close()

    def ticks(self, count: int) -> None:
        for _ in range(count):
            commands, self._waiting = self._waiting, []
            record = self.virtual.tick(*commands)
            self._see(record)
            self._host.receive(record)

    async def ask(self, method: str, **params: Any) -> dict[str, Any]:
        """What the daemon answers; virtual time passes meanwhile.

        Raises:
            ArmctlError: it is refused.
        """
        work = self.begin(method, **params)
        await self.pass_by(MOST_TICKS, work)
        if work.done():
            return await work
        work.cancel()
        raise ArmctlError(f"{method}: no answer within {MOST_TICKS * PERIOD_S:g} s")

    def begin(self, method: str, **params: Any) -> "asyncio.Task[dict[str, Any]]":
        """The request, under way as soon as time passes."""
        found = self._methods[method]
        return asyncio.ensure_future(found.handle(self._client, found.params.model_validate(params)))

    async def pass_by(self, count: int, work: "asyncio.Task[Any]") -> None:
        """Let at most so many ticks pass, until some work is done."""
        for left in reversed(range(count + 1)):
            for _ in range(TURNS):
                await asyncio.sleep(0)
            if work.done() or not left:
                return
            self.ticks(1)

    @property
    def tool_m(self) -> FloatArray:
        """Where the tool truly is [m], shape (3,)."""
        return np.asarray(self._tool_m(self.simulated.true_positions()[None])[0])

    @property
    def path_m(self) -> FloatArray:
        """Where it truly was at each tick of the last plan [m], shape (m, 3)."""
        begin, end = self._planned
        return self._tool_m(np.array(self.shafts_rad[begin:end]))

    def _send(self, command: Command) -> bool:
        self._waiting.append(command)
        return True

    def _see(self, record: TickRecord) -> None:
        self.modes.add(record.outputs.mode)
        self.faults |= {fault.code for fault in record.outputs.faults}
        self.shafts_rad.append(self.simulated.true_positions())
        for event in record.outputs.events:
            if event.code == "PLAN_BEGIN":
                self._planned = (len(self.shafts_rad) - 1, len(self.shafts_rad))
            elif event.code == "PLAN_END":
                self._planned = (self._planned[0], len(self.shafts_rad))


async def _optimised(job: OptimizeJob, progress: Progress) -> dict[str, Any]:
    """In this process; the daemon has one of its own for it."""
    return optimize_task(job, progress)
