import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Awaitable, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

import pytest

from armctl.client.asynchronous import AsyncClient
from armctl.errors import NoDaemon, RequestRefused
from tests.host.doubles import refused

Serve = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]


@asynccontextmanager
async def served(tmp_path: Path, serve: Serve) -> AsyncIterator[AsyncClient]:
    """A client of a daemon that does this with its connection and then closes it."""

    async def closing(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await serve(reader, writer)
        writer.close()

    server = await asyncio.start_unix_server(closing, tmp_path / "sock")
    async with server, await AsyncClient.connect(tmp_path / "sock") as client:
        yield client


def line(message: dict[str, Any]) -> bytes:
    return json.dumps({"jsonrpc": "2.0", **message}).encode() + b"\n"


async def requests(reader: asyncio.StreamReader, count: int) -> list[dict[str, Any]]:
    return [json.loads(await reader.readline()) for _ in range(count)]


async def test_answers_find_their_calls_in_any_order(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for request in reversed(await requests(reader, 2)):
            writer.write(line({"id": request["id"], "result": {"method": request["method"]}}))
        await writer.drain()

    async with served(tmp_path, serve) as client:
        answers = await asyncio.gather(client.call("run"), client.call("stop"))
        assert [answer["method"] for answer in answers] == ["run", "stop"]


async def test_what_fails_in_the_daemon_is_raised_here(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        [request] = await requests(reader, 1)
        data = {"type": "RequestRefused", "code": "BUSY", "reasons": ["another commands"], "fields": {"code": "BUSY"}}
        error = {"code": -32000, "message": "BUSY: another commands", "data": data}
        writer.write(line({"id": request["id"], "error": error}))
        await writer.drain()

    async with served(tmp_path, serve) as client:
        with refused("BUSY"):
            await client.call("run")


async def test_a_daemon_that_goes_ends_calls_and_notifications(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(line({"method": "snapshot", "params": {"tick": 1}}))
        await requests(reader, 1)

    async with served(tmp_path, serve) as client:
        with pytest.raises(NoDaemon, match="closed the connection"):
            await client.call("status")
        seen = client.notifications()
        assert await anext(seen) == ("snapshot", {"tick": 1})
        with pytest.raises(NoDaemon):
            await anext(seen)
        with pytest.raises(NoDaemon, match="closed"):
            await client.call("status")


async def test_a_consumer_that_lags_loses_the_oldest(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        [request] = await requests(reader, 1)
        writer.write(line({"id": request["id"], "result": {"subscribed": True}}))
        for tick in range(100):
            writer.write(line({"method": "snapshot", "params": {"tick": tick}}))
        writer.write(line({"id": None, "result": {}}))
        await writer.drain()

    async with served(tmp_path, serve) as client:
        snapshots = client.subscribe()
        first = await anext(snapshots)
        while not client.closed:
            await asyncio.sleep(0)
        rest = [first["tick"]]
        with contextlib.suppress(NoDaemon):
            while True:
                rest.append((await anext(snapshots))["tick"])
        assert rest[-1] == 99
        assert rest == sorted(set(rest))


async def test_nobody_there_is_said_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(NoDaemon, match="armctl daemon --port"):
        await AsyncClient.connect(tmp_path / "nobody")


async def test_a_number_that_is_none_is_not_sent(tmp_path: Path) -> None:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        await reader.read()

    async with served(tmp_path, serve) as client:
        with pytest.raises(RequestRefused, match="finite"):
            await client.call("move", x=float("nan"))
