"""The dashboard's connections: what is shown, who commands, and what ends when the last page has left."""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

import pytest
from starlette.types import Message

from armctl.config import Config
from armctl.errors import NoDaemon, RequestRefused
from armctl.files import stop_path
from armctl.host.jsonrpc import error_line, notification_line, result_line
from armctl.web import connections as module
from armctl.web import server as server_module
from armctl.web.app import Beats, create_app
from armctl.web.connections import MAX_WAITING, Connections
from armctl.web.guard import TOKEN_HEADER
from tests.web.asking import TOKEN

Answer = Callable[[str], dict[str, Any]]


class Stub:
    """A daemon's socket: counts its clients, and answers as it is told."""

    def __init__(self, path: Path) -> None:
        self.path = path
        # What is not answered.
        self.lasts = ["run", "jog"]
        # Which connection asked for what.
        self.asked: list[tuple[int, str]] = []
        self.left: list[int] = []
        self.changed = asyncio.Event()
        self.writers: list[asyncio.StreamWriter] = []

    async def serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        number = len(self.writers)
        self.writers.append(writer)
        while line := await reader.readline():
            request = json.loads(line)
            self._note(self.asked, (number, request["method"]))
            if request["method"] in self.lasts:
                continue  # until its client leaves
            refused = error_line(request["id"], RequestRefused("BUSY", "no"))
            writer.write(refused if request["method"] == "park" else result_line(request["id"], {"state": "holding"}))
        self._note(self.left, number)
        writer.close()

    def tell(self, number: int, method: str, **params: Any) -> None:
        self.writers[number].write(notification_line(method, params))

    async def until(self, done: Callable[[], bool]) -> None:
        while not done():
            self.changed.clear()
            await self.changed.wait()

    def _note(self, where: list[Any], what: Any) -> None:
        where.append(what)
        self.changed.set()


@contextlib.asynccontextmanager
async def stubbed(path: Path) -> AsyncIterator[tuple[Stub, Connections]]:
    stub = Stub(path)
    server = await asyncio.start_unix_server(stub.serve, path)
    daemon = Connections(path)
    async with daemon.running():
        await stub.until(lambda: (0, "subscribe") in stub.asked)
        yield stub, daemon
    server.close()


async def shown(messages: asyncio.Queue[str]) -> dict[str, Any]:
    found: dict[str, Any] = json.loads(await messages.get())
    return found


async def test_every_page_sees_every_snapshot(tmp_path: Path) -> None:
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon), daemon.page() as first, daemon.page() as second:
        for messages in (first, second):
            assert await shown(messages) == {"kind": "snapshot", "snapshot": None}
        stub.tell(0, "snapshot", state="holding")
        for messages in (first, second):
            assert await shown(messages) == {"kind": "snapshot", "snapshot": {"state": "holding"}}


async def test_a_slow_page_loses_the_oldest_and_holds_up_nobody(tmp_path: Path) -> None:
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon), daemon.page() as slow, daemon.page() as quick:
        await shown(quick)
        for tick in range(MAX_WAITING + 3):
            stub.tell(0, "snapshot", tick=tick)
            assert (await shown(quick))["snapshot"]["tick"] == tick
        assert [(await shown(slow))["snapshot"]["tick"] for _ in range(MAX_WAITING)] == list(range(3, MAX_WAITING + 3))


async def test_commands_share_one_connection_and_stop_takes_the_watchers(tmp_path: Path) -> None:
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon):
        assert await daemon.call("status") == {"state": "holding"}
        running = asyncio.ensure_future(daemon.call("run"))
        await stub.until(lambda: (1, "run") in stub.asked)
        assert await daemon.stop() == {"state": "holding"}
        with pytest.raises(RequestRefused, match="no"):
            await daemon.call("park")
        assert stub.asked[1:] == [(1, "status"), (1, "run"), (0, "stop"), (1, "park")]
        running.cancel()


@pytest.mark.parametrize("leaves", ["at once", "unanswered", "answered"])
async def test_a_page_that_leaves_while_it_leads_the_tool_stops_the_arm(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, leaves: str
) -> None:
    monkeypatch.setattr(Beats, "kept_s", lambda *_: 60.0)
    said: list[Message] = [{"type": "http.request", "body": b'{"tool_m_s": [0.0, 0.0, 0.03], "begin": true}'}]
    stub = Stub(tmp_path / "daemon.sock")
    stub.lasts = [] if leaves == "answered" else ["jog"]

    async def receive() -> Message:
        if not said and leaves != "at once":
            await stub.until(lambda: "jog" in [method for _, method in stub.asked])
            await asyncio.sleep(0.05)  # its answer has come, if there is one
        return said.pop() if said else {"type": "http.disconnect"}

    async def send(_: Message) -> None:
        pass

    headers = {"host": "127.0.0.1:8080", "content-type": "application/json", TOKEN_HEADER: TOKEN}
    scope = {"type": "http", "method": "POST", "path": "/api/jog", "query_string": b"",
             "headers": [(name.encode(), value.encode()) for name, value in headers.items()]}  # fmt: skip
    app, guard = create_app(Config(data_dir=str(tmp_path)), socket=stub.path, token=TOKEN, port=8080)
    server = await asyncio.start_unix_server(stub.serve, stub.path)
    async with asyncio.timeout(10.0), server, app.router.lifespan_context(app):
        await stub.until(lambda: stub.asked == [(0, "subscribe")])
        await guard(scope, receive, send)
    assert (0, "stop") in stub.asked
    assert leaves == "at once" or stub.asked[1:] == [(1, "jog"), (0, "stop")]


async def test_stop_goes_its_own_way_where_there_is_one(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"ok holding\n" if await reader.readline() == b"stop\n" else b"no\n")
        writer.close()

    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon):
        lane = await asyncio.start_unix_server(serve, stop_path(daemon.socket))
        async with lane:
            assert await daemon.stop() == {"state": "holding"}
        assert all(method != "stop" for _, method in stub.asked)


async def test_the_commander_leaves_with_the_last_page(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LEAVE_S", 0.0)
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon):
        async with daemon.page():
            async with daemon.page():
                await daemon.call("teach_begin")
            await asyncio.sleep(0)
            assert stub.left == []
        await stub.until(lambda: stub.left == [1])
        await daemon.call("status")
        assert stub.asked[-1] == (2, "status")


async def test_a_page_that_is_back_in_time_keeps_the_commander(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(module, "LEAVE_S", 0.0)
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon):
        async with daemon.page():
            await daemon.call("teach_begin")
        async with daemon.page():  # before whoever looks whether it is back had its turn
            for _ in range(3):
                await daemon.call("status")
            assert (stub.left, stub.asked[-1]) == ([], (1, "status"))


async def test_progress_of_an_optimisation_reaches_the_pages(tmp_path: Path) -> None:
    async with stubbed(tmp_path / "daemon.sock") as (stub, daemon), daemon.page() as messages:
        await shown(messages)
        await daemon.call("status")
        stub.tell(1, "progress", generation=3, best=1.5)
        assert await shown(messages) == {"kind": "progress", "generation": 3, "best": 1.5}


async def test_without_a_daemon_commands_and_stop_say_so_and_pages_see_nothing(tmp_path: Path) -> None:
    daemon = Connections(tmp_path / "nobody.sock")
    async with daemon.running(), daemon.page() as messages:
        assert await shown(messages) == {"kind": "snapshot", "snapshot": None}
        for work in (daemon.call("status"), daemon.stop()):
            with pytest.raises(NoDaemon, match="armctl daemon --port"):
                await work


def test_no_answer_waits_for_word_that_its_head_has_come() -> None:
    with server_module._listening("127.0.0.1", 0) as listening, socket.create_connection(listening.getsockname()):
        taken, _ = listening.accept()
        with taken:
            assert taken.getsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY)


def test_heartbeats_come_late_in_the_tick_however_long_their_way_is() -> None:
    for way_s in (0.003, 0.02, 0.05, 0.09):
        beats, tick_s = Beats(0.1), 0.0
        kept_s = beats.kept_s(tick_s - 0.01, begin=True)
        for _ in range(20):
            beats.answered_s = tick_s + kept_s
            came_s = beats.answered_s + way_s
            kept_s = beats.kept_s(came_s, begin=False)
            tick_s += 0.1
        beats.kept_s(came_s + 5.0, begin=False)
        assert beats.way_s == 0.1, "a page that was gone for long is no farther away than a tick"
        assert came_s - (tick_s - 0.1) == pytest.approx(max(way_s, 0.08), abs=0.002)
