"""Requests to the daemon: to its parts in this process on a virtual clock, and to one that runs."""

import asyncio
import contextlib
import json
import logging
import os
import time
from collections.abc import AsyncIterator, Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, ParamSpec, TypeVar

import yaml

from armctl.clock import NS_PER_S, VirtualClock
from armctl.errors import LogError
from armctl.genetic.straight_line import Progress
from armctl.host.daemon import listening_at
from armctl.host.host import Host
from armctl.host.jobs import OptimizeJob
from armctl.host.methods import Methods
from armctl.host.server import Method, Server
from armctl.lab.demo import started
from armctl.messages import Command, TickRecord
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from proving.fuzz import malformed
from proving.fuzz.files import Takes
from proving.fuzz.requests import Asker, Lines, fuzzed_arm, method_of, overlong
from proving.fuzz.tally import HANG_S, Memory, Tally
from proving.hosted_arm import Inline
from proving.log_rig import PERIOD_S

BATCH = 16
CLIENTS = 6
# Requests before a client comes anew: the daemon's allowance of a fresh connection.
PER_CONNECTION = 384
PATIENT_TICKS = 12
STOPPED_TICKS = 30
STOPPED_S = 3.0
TRIES = 3
# Methods whose answer waits for the arm.
LASTING = frozenset(
    (
        "run",
        "path",
        "play",
        "program_run",
        "move",
        "reach",
        "grip",
        "transfer",
        "park",
        "optimize",
        "torque_on",
        "teach_begin",
        "teach_end",
        "release",
        "clear",
    )
)
P = ParamSpec("P")
T = TypeVar("T")


async def in_process(seed: int, count: int, tally: Tally, folder: Path) -> None:
    """Requests to the daemon's server, host and control loop on a virtual clock."""
    lines = Lines(seed, fuzzed_arm())
    memory = Memory()
    with _failures(tally):
        async with served(seed, folder) as rig:
            stopper = await Asker.connect(rig.socket, tally)
            asker = await Asker.connect(rig.socket, tally)
            while tally.runs < count:
                batch = lines.batch(min(BATCH, count - tally.runs))
                begin_s = time.process_time()
                asker.ask(batch)
                settled = await rig.settle(asker, PATIENT_TICKS)
                if not settled:
                    stopper.ask([b'{"jsonrpc":"2.0","id":0,"method":"stop"}'])
                    settled = await rig.settle(asker, STOPPED_TICKS) and await rig.settle(stopper, STOPPED_TICKS)
                tally.took(time.process_time() - begin_s, f"{batch!r}")
                if not settled:
                    tally.violation(f"{asker.owed} answers never came to {batch!r}")
                tally.runs += len(batch)
                if not settled or asker.asked >= PER_CONNECTION:
                    await asker.leave(batch[0][: lines.rng.randrange(len(batch[0]) + 1)])
                    await overlong(rig.socket, malformed.flood(lines.rng), tally)
                    await rig.pass_by()
                    rig.takes.restore()
                    asker = await Asker.connect(rig.socket, tally)
                if not memory.marked and tally.runs > count // 10:
                    memory.mark()
            for one in (asker, stopper):
                await one.leave()
    memory.judge(tally)


class _Control:
    """A control process that is a part of this one and ticks when told to."""

    def __init__(self, virtual: VirtualArm) -> None:
        self._virtual = virtual
        self._waiting: list[Command] = []

    def send(self, command: Command) -> bool:
        self._waiting.append(command)
        return True

    def tick(self) -> TickRecord:
        commands, self._waiting = tuple(self._waiting), []
        return self._virtual.tick(*commands)


@dataclass
class _Recorder:
    """Takes by name, kept nowhere."""

    log_path: Path | None = None
    problem: str = ""
    dropped_records: int = 0
    names: set[str] = field(default_factory=set)
    begun: str | None = None

    def put(self, record: TickRecord) -> None:
        pass

    def note(self, text: str, time_ns: int) -> None:
        json.loads(text)

    def check(self) -> None:
        pass

    def begin_take(self, name: str) -> Path:
        if name in self.names:
            raise LogError(f"take {name}: there is one of that name")
        self.begun = name
        self.names = {name}
        return Path(f"/takes/{name}.mcap")

    def end_take(self) -> Path | None:
        name, self.begun = self.begun, None
        return None if name is None else Path(f"/takes/{name}.mcap")

    def close(self) -> None:
        pass


async def _optimise(job: OptimizeJob, progress: Progress) -> dict[str, Any]:
    progress(1, 2.0, 3.0)
    return {"plans": [], "via": list(job.request.via)}


@dataclass
class _Rig:
    """The daemon's parts, and the time that passes for them."""

    socket: Path
    methods: Mapping[str, Method]
    host: Host
    server: Server
    control: _Control
    takes: Takes

    def tick(self) -> None:
        self.host.receive(self.control.tick())
        self.server.publish(self.host.status)

    async def settle(self, asker: Asker, ticks: int) -> bool:
        """Let ticks pass until every answer has come; whether they have."""
        for _ in range(ticks):
            for _ in range(2 * BATCH):
                await asyncio.sleep(0)
                if not asker.owed:
                    return True
            self.tick()
        return False

    async def pass_by(self) -> None:
        """Time for what a client leaves behind."""
        for _ in range(PATIENT_TICKS):
            for _ in range(BATCH):
                await asyncio.sleep(0)
            self.tick()


@contextlib.asynccontextmanager
async def served(seed: int, folder: Path) -> AsyncIterator[_Rig]:
    """The daemon without its processes: virtual time, simulated servos, a socket in `folder`."""
    arm = fuzzed_arm()
    clock = VirtualClock(5 * NS_PER_S)
    virtual = VirtualArm(SimulatedArm(arm, seed=seed), PERIOD_S, clock=clock)
    virtual.start()
    asyncio.get_running_loop().set_default_executor(Inline())
    host = Host(arm, virtual.robot, PERIOD_S, _Recorder(), clock)
    control = _Control(virtual)
    host.exchange.attach(os.getpid(), control.send)
    takes = Takes(folder / "template", folder / "recordings")
    methods = Methods(host, folder / "recordings", _optimise)
    table = methods.table()
    server = Server(table, clock, on_close=methods.client_gone, may_command=lambda _uid: True)
    with listening_at(folder / "fuzz.sock") as listening:
        server.start(listening)
        rig = _Rig(folder / "fuzz.sock", table, host, server, control, takes)
        rig.tick()
        yield rig
        await server.close()


@contextlib.contextmanager
def _failures(tally: Tally) -> Iterator[None]:
    """Tracebacks that the daemon would log are examples; its other words are for nobody here."""

    class Failures(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            if record.exc_info:
                trace = logging.Formatter().formatException(record.exc_info)
                tally.violation(f"{record.getMessage()}: ...{trace[-400:]}")

    logger, handler = logging.getLogger("armctl"), Failures()
    logger.addHandler(handler)
    try:
        yield
    finally:
        logger.removeHandler(handler)


def on_socket(seed: int, count: int, tally: Tally, folder: Path) -> None:
    """Requests to a daemon of its own on simulated servos, in real time, from several clients."""
    port, path, config = folder / "servos", folder / "daemon.sock", folder / "armctl.yaml"
    arm = folder / "arm.yaml"
    arm.write_text(yaml.safe_dump(fuzzed_arm().model_dump(mode="json", exclude_none=True)), encoding="utf-8")
    config.write_text(yaml.safe_dump({"port": str(port), "arm": str(arm), "data_dir": str(folder)}), encoding="utf-8")
    takes = Takes(folder / "template", folder / "recordings")
    with contextlib.ExitStack() as cleanup:
        cleanup.enter_context(
            started(folder / "simulator.log", "sim", "--arm", str(arm), "--link", str(port), "--seed", str(seed))
        )
        command = ("daemon", "--config", str(config), "--socket", str(path))
        daemon, _ = cleanup.enter_context(started(folder / "daemon.log", *command))
        asyncio.run(_ask_daemon(seed, count, tally, path, daemon.pid, takes))
        if daemon.poll() is not None:
            tally.violation(f"the daemon ended with status {daemon.poll()}")
    log = (folder / "daemon.log").read_text(encoding="utf-8", errors="replace")
    if "Traceback" in log:
        tally.violation(log[log.index("Traceback") :])


async def _ask_daemon(seed: int, count: int, tally: Tally, path: Path, pid: int, takes: Takes) -> None:
    memory = Memory(pid)
    ending = asyncio.Event()

    async def client(number: int) -> None:
        lines = Lines(seed + number, fuzzed_arm())
        asker = await Asker.connect(path, tally)
        while tally.runs < count:
            batch = lines.batch(min(BATCH, count - tally.runs))
            tally.runs += len(batch)
            lasting = not LASTING.isdisjoint(map(method_of, batch))
            asker.ask(batch)
            settled = await asker.settle(HANG_S if lasting else TRIES * HANG_S)
            if not settled and lasting:
                await _stop(path, tally)
                settled = await asker.settle(STOPPED_S)
            if not settled:
                tally.violation(f"{asker.owed} answers never came to {batch!r}")
            if not settled or asker.asked >= PER_CONNECTION:
                await asker.leave(batch[0][: lines.rng.randrange(len(batch[0]) + 1)])
                await overlong(path, malformed.flood(lines.rng), tally)
                if number == 0:
                    takes.restore()
                asker = await Asker.connect(path, tally)
            if not memory.marked and tally.runs > count // 10:
                memory.mark()
        await asker.leave()

    async def watch() -> None:
        """Another client, who wants to know how the arm is."""
        asker = await Asker.connect(path, tally)
        slow = 0
        while not ending.is_set():
            begin_s = time.monotonic()
            asker.ask([b'{"jsonrpc":"2.0","id":"watch","method":"status"}'])
            answered = await asker.settle(10.0 * HANG_S)
            seconds = time.monotonic() - begin_s
            tally.slowest_s = max(tally.slowest_s, seconds)
            slow = slow + 1 if seconds > HANG_S else 0
            if not answered or slow == TRIES:  # once may be the machine's doing
                tally.violation(f"{seconds:.2f} s for the status beside it all")
            await asyncio.sleep(0.05)
        await asker.leave()

    watching = asyncio.create_task(watch())
    await asyncio.gather(*map(client, range(CLIENTS)))
    ending.set()
    await watching
    memory.judge(tally)


async def _stop(path: Path, tally: Tally) -> None:
    stopper = await Asker.connect(path, tally)
    stopper.ask([b'{"jsonrpc":"2.0","id":"stop","method":"stop"}'])
    if not await stopper.settle(STOPPED_S):
        tally.violation("stop was not answered")
    await stopper.leave()
