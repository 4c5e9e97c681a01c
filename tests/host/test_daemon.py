"""The daemon as a whole, on ideal servos that tick as fast as the host takes it, spoken to by the real client."""

import asyncio
import json
import os
import signal
import stat
import tempfile
from collections import deque
from collections.abc import AsyncIterator, Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import pytest

from armctl.client import Client
from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import Config
from armctl.control.link import StartFailed
from armctl.control.process import ControlSettings
from armctl.errors import BusError, PortBusy, PortGone, PortMissing, RequestRefused
from armctl.files import load_arm
from armctl.host import daemon, pulse
from armctl.host.daemon import MAX_DEATHS, PATIENT_WAIT_S, Outside, restart_wait_s, run_daemon
from armctl.messages import Hold, Mode
from armctl.recording.writer import LogContext
from proving.hosted_arm import Inline
from tests.control.ideal_arm import IdealArm
from tests.host.doubles import IdealControl, MemoryRecorder, refused, small_plan
from tests.host.peers import PATIENCE_S, until

T = TypeVar("T")


class Bench:
    """A running daemon, its control processes, its recorder, and the ticks that drive it."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.socket = folder / "run" / "s"
        self.clock = VirtualClock()
        self.recorder = MemoryRecorder()
        self.controls: list[IdealControl] = []
        self.ready = asyncio.Event()
        self.failing_start: StartFailed | None = None
        # Longer than any test keeps a motion waiting.
        self.overdue_s = PATIENCE_S
        # Whether a motion waits where it is for the next command.
        self.frozen = False
        # The control process that ticks no more.
        self.hung: IdealControl | None = None
        self.status = 0
        self.lines: list[str] = []
        self.threads = ThreadPoolExecutor()

    def start_control(self, settings: ControlSettings, *, restarted: bool = False) -> IdealControl:
        assert settings.port == "/dev/robot"
        arm = self.controls[-1].arm if self.controls else None
        if arm is not None:  # the servos keep what they were told; the new process knows nothing
            arm.state, arm.tick = type(arm.state)(), 0
        control = IdealControl(self.clock, arm, restarted=restarted)
        if self.failing_start is not None:
            control.say(self.failing_start)
            control.die()
        else:
            control.ready()
        self.controls.append(control)
        return control

    def make_recorder(self, context: LogContext, log_dir: Path, recordings_dir: Path) -> MemoryRecorder:
        assert (log_dir.name, recordings_dir.name) == ("logs", "recordings")
        return self.recorder

    def say_ready(self, line: str) -> None:
        self.lines.append(line)
        self.ready.set()

    async def run(self) -> int:
        return await run_daemon(
            Config(data_dir=str(self.folder)),
            load_arm("ax12-line"),
            port="/dev/robot",
            socket=self.socket,
            log_dir=None,
            ready=self.say_ready,
            outside=Outside(self.start_control, self.make_recorder, self.clock, self.overdue_s),
        )

    async def tick(self) -> None:
        """Tick whatever control process lives, for ever."""
        while True:
            for control in self.controls[-1:]:
                waits = control is self.hung or not control.alive or (self.frozen and control.undisturbed())
                if not waits:
                    control.tick_over_link()
            await asyncio.sleep(0)

    @property
    def arm(self) -> IdealArm:
        return self.controls[-1].arm

    def plan(self) -> dict[str, Any]:
        return small_plan(self.arm).model_dump(mode="json")

    async def client(self) -> Client:
        return await self.in_thread(lambda: Client(self.socket, timeout_s=PATIENCE_S))

    async def call(self, client: Client, method: str, **params: Any) -> dict[str, Any]:
        return await self.in_thread(lambda: client.call(method, **params))

    async def in_thread(self, work: Callable[[], T]) -> T:
        """What a client waits for; the daemon's own work needs no thread here."""
        return await asyncio.get_running_loop().run_in_executor(self.threads, work)


@asynccontextmanager
async def bench() -> AsyncIterator[Bench]:
    """A bench whose daemon is not yet running."""
    with tempfile.TemporaryDirectory() as folder:
        found = Bench(Path(folder))
        asyncio.get_running_loop().set_default_executor(Inline())
        ticking = asyncio.create_task(found.tick())
        try:
            yield found
        finally:
            ticking.cancel()
            found.threads.shutdown(wait=False)
            for control in found.controls:
                control.die()
                control.link.close()


@asynccontextmanager
async def running() -> AsyncIterator[Bench]:
    """A bench whose daemon serves; it is ended by SIGTERM."""
    async with bench() as found:
        task = asyncio.create_task(found.run())
        async with asyncio.timeout(PATIENCE_S):
            await asyncio.wait((task, asyncio.create_task(found.ready.wait())), return_when=asyncio.FIRST_COMPLETED)
        if task.done():
            task.result()
        try:
            yield found
        finally:
            os.kill(os.getpid(), signal.SIGTERM)
            async with asyncio.timeout(PATIENCE_S):
                found.status = await task


async def holding(b: Bench) -> Client:
    client = await b.client()
    assert await b.call(client, "torque_on") == {"state": "holding"}
    return client


async def moving(b: Bench, client: Client) -> asyncio.Task[dict[str, Any]]:
    """The client's run, under way until something stops it."""
    b.frozen = True
    run = asyncio.create_task(b.call(client, "run", plan=b.plan()))
    await until(lambda: b.arm.mode() is Mode.MOVING)
    return run


@pytest.fixture
def idle() -> AbstractAsyncContextManager[Bench]:
    return bench()


@pytest.fixture
def b() -> AbstractAsyncContextManager[Bench]:
    return running()


# ------------------------------------------------------------------------------------------------- serving


async def test_the_daemon_says_ready_and_serves_on_a_socket_for_owner_and_group(b: Bench) -> None:
    assert b.lines == [str(b.socket)]
    assert stat.S_IMODE(b.socket.stat().st_mode) == 0o660
    assert stat.S_IMODE(b.socket.parent.stat().st_mode) == 0o750
    with await b.client() as client:
        status = await b.call(client, "status")
        assert status["state"] == "off"
        assert status["pids"] == {"daemon": os.getpid(), "control": 4242}
        log = await b.call(client, "log")
        assert log == {"path": "/logs/log.mcap.part", "problem": "", "dropped": 0, "recorder_dropped": 0}


async def test_commands_and_their_outcome_stand_in_the_log(b: Bench) -> None:
    with await holding(b) as client:
        await b.call(client, "torque_on")
        with pytest.raises(RequestRefused):
            await b.call(client, "teach_end")
        with pytest.raises(RequestRefused):
            await b.call(client, "take_begin", name="x")
        await b.call(client, "stop")
    notes = [json.loads(note) for note in b.recorder.notes]
    assert [(note["request"], note["outcome"]) for note in notes] == [
        ("torque_on", "ok"),
        ("torque_on", "ok"),
        ("teach_end", "ILLEGAL_TRANSITION"),
        ("take_begin", "ILLEGAL_TRANSITION"),
        ("stop", "ok"),
    ]
    assert notes[3]["params"] == {"name": "x"}
    assert f"uid {os.getuid()}" in notes[0]["who"]


async def test_subscribers_see_every_tick(b: Bench) -> None:
    with await b.client() as client:

        def watch() -> list[dict[str, Any]]:
            snapshots = client.subscribe()
            return [next(snapshots) for _ in range(50)]

        seen = await b.in_thread(watch)
    for before, after in pairwise(seen):
        assert after["tick"] == before["tick"] + 1 + after["gap"]


async def test_a_client_killed_during_its_run_stops_the_arm(b: Bench) -> None:
    client = await holding(b)
    b.frozen = True
    run = {"jsonrpc": "2.0", "id": 9, "method": "run", "params": {"plan": b.plan()}}
    client._socket.sendall(json.dumps(run).encode() + b"\n")
    await until(lambda: b.arm.mode() is Mode.MOVING)
    client.close()
    await until(lambda: b.arm.mode() is Mode.HOLDING)
    await until(lambda: len(b.recorder.takes) == 1)
    assert any("LEASE_LOST" in note for note in b.recorder.notes)


# ------------------------------------------------------------------------------------------------ lifetime


async def test_sigterm_stops_the_arm_closes_the_log_and_leaves_torque_on() -> None:
    async with running() as b:
        client = await holding(b)
        run = await moving(b, client)
        os.kill(os.getpid(), signal.SIGTERM)
        with refused("STOPPED"):
            await run
        client.close()
    assert b.arm.mode() is Mode.HOLDING
    assert sum(isinstance(command, Hold) for command in b.controls[0].commands) == 1
    assert b.recorder.closed
    assert b.controls[0].terminated
    assert not b.socket.exists()
    assert b.status == 0


@pytest.mark.parametrize(
    "error", [PortMissing("no such port"), PortBusy("held"), PortGone("gone"), BusError("ODD", "?")]
)
async def test_a_port_that_cannot_be_had_is_one_clear_error(idle: Bench, error: BusError) -> None:
    idle.failing_start = StartFailed(error)
    with pytest.raises(type(error)) as caught:
        await idle.run()
    assert (caught.value.code, str(caught.value)) == (error.code, str(error))
    assert idle.recorder.closed
    assert not idle.ready.is_set()
    assert not idle.socket.exists()


async def test_a_control_process_that_never_ticks_is_an_error(idle: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(daemon, "START_S", 0.05)
    mute = IdealControl(idle.clock)
    monkeypatch.setattr(idle, "start_control", lambda settings: mute)
    with pytest.raises(RequestRefused, match="did not tick"):
        await idle.run()
    assert mute.terminated
    mute.die()


async def test_a_recorder_that_cannot_be_made_ends_the_control_process(
    idle: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    def broken(*_: object) -> MemoryRecorder:
        raise OSError("no disk")

    monkeypatch.setattr(idle, "make_recorder", broken)
    with pytest.raises(OSError, match="no disk"):
        await idle.run()
    assert idle.controls[0].terminated


async def test_a_dead_control_process_fails_the_run_and_another_takes_the_arm_over(b: Bench) -> None:
    with await holding(b) as client:
        run = await moving(b, client)
        b.controls[0].die()
        with refused("RESTARTED"):
            await run
        await until(lambda: len(b.controls) == 2)
        await until(lambda: b.arm.mode() is Mode.HOLDING)
        assert b.controls[0].terminated
        assert "RESTARTED" in b.arm.events
        assert await b.call(client, "stop") == {"state": "holding"}
        assert any("RESTARTED" in note for note in b.recorder.notes)


async def test_a_control_process_that_hangs_is_killed_and_another_adopts_the_arm(
    idle: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(pulse, "BEAT_S", 0.001)
    idle.overdue_s = 0.0
    run = asyncio.create_task(idle.run())
    await until(idle.ready.is_set)
    hung, ticks = idle.controls[0], idle.clock.now_ns()
    idle.hung = hung
    await until(lambda: len(idle.controls) == 2 and idle.clock.now_ns() > ticks)
    assert not hung.alive
    assert "RESTARTED" in idle.arm.events
    run.cancel()
    await asyncio.gather(run, return_exceptions=True)


async def test_control_processes_that_fail_to_start_again_are_tried_again(b: Bench) -> None:
    b.failing_start = StartFailed(PortGone("unplugged"))
    b.controls[0].die()
    await until(lambda: len(b.controls) == 3)
    b.failing_start = None
    with await b.client() as client:
        async with asyncio.timeout(PATIENCE_S):
            while (await b.call(client, "status"))["state"] != "off":
                await asyncio.sleep(0)


def test_restarts_come_at_once_until_they_come_often() -> None:
    second = NS_PER_S
    assert restart_wait_s(deque([0])) == 0.0
    assert restart_wait_s(deque(range(0, MAX_DEATHS * second, second))) == 0.0
    assert restart_wait_s(deque(range(0, (MAX_DEATHS + 1) * second, second))) == PATIENT_WAIT_S
    assert restart_wait_s(deque(range(0, (MAX_DEATHS + 1) * 20 * second, 20 * second))) == 0.0
