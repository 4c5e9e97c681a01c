"""The asynchronous client: calls side by side, and notifications that a consumer may lag behind."""

import asyncio
import contextlib
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path

import pytest

from armctl.client.asynchronous import AsyncClient
from armctl.errors import NoDaemon, RequestRefused
from armctl.host import jsonrpc
from tests.host.doubles import refused


@asynccontextmanager
async def served(tmp_path: Path, *lines: bytes, requests: int = 1) -> AsyncIterator[AsyncClient]:
    """A client of a daemon that reads so many requests, says these lines, and closes."""

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        for _ in range(requests):
            await reader.readline()
        writer.writelines(lines)
        writer.close()

    server = await asyncio.start_unix_server(serve, tmp_path / "sock")
    async with server, AsyncClient(tmp_path / "sock") as client:
        yield client


async def test_answers_find_their_calls_in_any_order(tmp_path: Path) -> None:
    lines = [jsonrpc.result_line(number, {"answer": number}) for number in (2, 1)]
    async with served(tmp_path, *lines, requests=2) as client:
        answers = await asyncio.gather(client.call("run"), client.call("stop"))
        assert [answer["answer"] for answer in answers] == [1, 2]


async def test_what_fails_in_the_daemon_is_raised_here(tmp_path: Path) -> None:
    line = jsonrpc.error_line(1, RequestRefused("BUSY", "another commands"))
    async with served(tmp_path, line) as client:
        with refused("BUSY"):
            await client.call("run")


async def test_a_daemon_that_goes_ends_calls_and_notifications(tmp_path: Path) -> None:
    async with served(tmp_path, jsonrpc.notification_line("snapshot", {"tick": 1})) as client:
        with pytest.raises(NoDaemon, match="closed the connection"):
            await client.call("status")
        seen = client.notifications()
        assert await anext(seen) == ("snapshot", {"tick": 1})
        with pytest.raises(NoDaemon):
            await anext(seen)
        with pytest.raises(NoDaemon, match="closed"):
            await client.call("status")


async def test_a_client_that_was_sent_away_before_it_asked_anything_connects_again_once(tmp_path: Path) -> None:
    away = asyncio.Event()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        if not away.is_set():
            writer.write(jsonrpc.error_line(None, RequestRefused("IDLE", "it sent no whole request")))
            away.set()
        else:
            for number in (1, 2):
                await reader.readline()
                writer.write(jsonrpc.result_line(number, {"answer": number}))
        writer.close()

    server = await asyncio.start_unix_server(serve, tmp_path / "sock")
    async with server, AsyncClient(tmp_path / "sock") as client:
        while not client.closed:
            await asyncio.sleep(0)
        answers = await asyncio.gather(client.call("status"), client.call("status"))
        assert [answer["answer"] for answer in answers] == [1, 2]


async def test_a_consumer_that_lags_loses_the_oldest(tmp_path: Path) -> None:
    snapshots = [jsonrpc.notification_line("snapshot", {"tick": tick}) for tick in range(100)]
    end = jsonrpc.result_line(None, {})
    async with served(tmp_path, jsonrpc.result_line(1, {"subscribed": True}), *snapshots, end) as client:
        subscription = client.subscribe()
        ticks = [(await anext(subscription))["tick"]]
        while not client.closed:
            await asyncio.sleep(0)
        with contextlib.suppress(NoDaemon):
            while True:
                ticks.append((await anext(subscription))["tick"])
        assert ticks[-1] == 99
        assert ticks == sorted(set(ticks))


async def test_nobody_there_is_said_with_the_remedy(tmp_path: Path) -> None:
    with pytest.raises(NoDaemon, match="armctl daemon --port"):
        await AsyncClient(tmp_path / "nobody").open()
