"""The dashboard's port in a crowd: half-sent requests, one byte at a time, unread answers, too many of everything."""

import asyncio
import contextlib
import json
import re
from collections.abc import AsyncIterator, Callable

import pytest
import uvicorn
from starlette.types import Receive, Scope, Send
from uvicorn.server import ServerState

from armctl.web import crowd
from armctl.web.crowd import PLACES, Connection

PATIENCE_S = 20.0
WHOLE = b"POST /stop HTTP/1.1\r\nhost: a\r\ncontent-length: 2\r\n\r\n{}"
UPGRADE = (
    b"GET /view HTTP/1.1\r\nhost: a\r\nconnection: upgrade\r\nupgrade: websocket\r\n"
    b"sec-websocket-version: 13\r\nsec-websocket-key: AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n"
)
Client = tuple[asyncio.StreamReader, asyncio.StreamWriter]


class Port:
    """An HTTP server whose application reads the body and answers `ok`, much (/much) or when `gate` opens (/wait)."""

    def __init__(self) -> None:
        self.gate = asyncio.Event()
        self.served = 0
        self.state = ServerState()
        self._clients: list[Client] = []

    @contextlib.asynccontextmanager
    async def open(self) -> AsyncIterator["Port"]:
        config = uvicorn.Config(self._application, interface="asgi3", lifespan="off", log_level="critical")
        loop = asyncio.get_running_loop()
        server = await loop.create_server(lambda: Connection(config, self.state, {}), "127.0.0.1", 0)
        self._port = server.sockets[0].getsockname()[1]
        try:
            yield self
        finally:
            for _, writer in self._clients:
                writer.transport.abort()
            server.close()
            await until(lambda: not self.state.connections and not self.state.tasks)

    async def _application(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] == "websocket":
            await send({"type": "websocket.accept"})
            while (await receive())["type"] != "websocket.disconnect":
                pass
            return
        while (await receive()).get("more_body"):
            pass
        self.served += 1
        if scope["path"] == "/wait":
            await self.gate.wait()
        body = b"x" * (1 << 24) if scope["path"] == "/much" else b"ok"
        length = str(len(body)).encode()
        await send({"type": "http.response.start", "status": 200, "headers": [(b"content-length", length)]})
        await send({"type": "http.response.body", "body": body})

    async def say(self, *said: bytes) -> Client:
        """A new connection that has sent this."""
        client = await asyncio.open_connection("127.0.0.1", self._port)
        self._clients.append(client)
        for piece in said:
            client[1].write(piece)
        return client


async def answer(client: Client) -> tuple[int, bytes]:
    """Status and body of the next answer."""
    async with asyncio.timeout(PATIENCE_S):
        head = (await client[0].readuntil(b"\r\n\r\n")).decode().lower()
        length = int(head.partition("content-length: ")[2].split()[0])
        return int(head.split()[1]), await client[0].readexactly(length)


async def refusal(client: Client) -> str:
    """Status, code and message of a refusal; the connection is over after it."""
    status, body = await answer(client)
    async with asyncio.timeout(PATIENCE_S):
        assert await client[0].read() == b""
    return "{} {code}: {message}".format(status, **json.loads(body)["error"])


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0)


@pytest.fixture
def port() -> contextlib.AbstractAsyncContextManager[Port]:
    return Port().open()


@pytest.mark.parametrize("half", [b"", b"POST /stop HT", WHOLE[:-10], WHOLE[:-1]])
async def test_stop_is_served_beside_70_half_sent_requests_and_the_oldest_make_room(port: Port, half: bytes) -> None:
    halves = [await port.say(half) for _ in range(70)]
    await until(lambda: len(port.state.connections) == PLACES)
    assert await answer(await port.say(WHOLE)) == (200, b"ok")
    for client in halves[: 70 - PLACES + 1]:
        assert re.match(rf"503 BUSY: .*{PLACES} connections.*ask again", await refusal(client))


@pytest.mark.parametrize("begun", [b"", b"POST /stop HT", WHOLE[:-1]])
async def test_what_is_not_a_whole_request_in_time_ends_with_a_word_however_slowly_bytes_come(
    port: Port, begun: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(crowd.DUE_S, "request", 0.2)
    client, slow = await port.say(begun), await port.say(b"GET / HTTP/1.1\r\nx: ")

    async def trickle() -> None:
        while True:
            slow[1].write(b"x")
            await asyncio.sleep(0.02)

    trickling = asyncio.create_task(trickle())
    for one in (client, slow):
        status, body = await answer(one)
        assert status == 408
        assert "after 0.2 s" in json.loads(body)["error"]["message"]
    trickling.cancel()
    await until(lambda: not port.state.connections)


async def test_a_client_that_has_nothing_to_ask_is_left_alone_and_its_next_half_request_is_not(
    port: Port, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(crowd.DUE_S, "request", 0.1)
    client = await port.say(WHOLE)
    assert await answer(client) == (200, b"ok")
    assert (await refusal(await port.say(b"POST"))).startswith("408 ")
    client[1].write(WHOLE)
    assert await answer(client) == (200, b"ok")
    client[1].write(WHOLE[:30])
    assert (await refusal(client)).startswith("408 ")


async def test_who_does_not_take_the_answer_is_cut_off(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(crowd.DUE_S, "answer", 0.1)
    client = await port.say(WHOLE.replace(b"/stop", b"/much"))
    client[1].transport.pause_reading()  # type: ignore[attr-defined]
    await until(lambda: port.served == 1)
    await until(lambda: not port.state.connections)


async def test_requests_under_way_keep_their_places_and_the_newcomer_is_told(port: Port) -> None:
    waiting = [await port.say(WHOLE.replace(b"/stop", b"/wait")) for _ in range(PLACES)]
    await until(lambda: port.served == PLACES)
    assert re.match("503 BUSY: .*all with a request under way", await refusal(await port.say()))
    port.gate.set()
    assert [await answer(client) for client in waiting] == [(200, b"ok")] * PLACES


async def test_a_half_sent_request_makes_room_before_a_client_that_has_nothing_to_ask(port: Port) -> None:
    quiet = await port.say(WHOLE)
    await answer(quiet)
    half = [await port.say(b"POST") for _ in range(PLACES - 1)]
    await until(lambda: len(port.state.connections) == PLACES)
    assert await answer(await port.say(WHOLE)) == (200, b"ok")
    assert (await refusal(half[0])).startswith("503 ")
    quiet[1].write(WHOLE)
    assert await answer(quiet) == (200, b"ok")


async def test_live_views_take_no_places_and_have_their_own_bound(port: Port, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(crowd, "VIEWS", 2)
    for _ in range(2):
        client = await port.say(UPGRADE)
        assert b" 101 " in await client[0].readuntil(b"\r\n\r\n")
    assert (await refusal(await port.say(UPGRADE))).startswith("503 BUSY: ")
    assert await answer(await port.say(WHOLE)) == (200, b"ok")


async def test_connections_that_die_leave_nothing_behind(port: Port) -> None:
    for said in (b"", b"POST", WHOLE, WHOLE[:-1], WHOLE.replace(b"/stop", b"/much"), UPGRADE):
        for _ in range(20):
            (await port.say(said))[1].transport.abort()
    await until(lambda: not port.state.connections and not port.state.tasks)
    assert await answer(await port.say(WHOLE)) == (200, b"ok")
