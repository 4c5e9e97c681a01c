"""A server with a few methods of its own, and clients that write and read lines."""

import asyncio
import json
import socket
import tempfile
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager, suppress
from pathlib import Path
from typing import Any

from pydantic import Field

from armctl.clock import Clock, VirtualClock
from armctl.config import Frozen
from armctl.errors import RequestRefused
from armctl.host.methods import Nothing
from armctl.host.server import Connection, Method, Server

PATIENCE_S = 20.0


class Numbered(Frozen):
    number: int = Field(ge=0, le=10)


class Peer:
    """A client that writes and reads lines."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.reader, self.writer = reader, writer

    def send(self, method: str, request_id: int | None = 1, **params: Any) -> None:
        request = {"jsonrpc": "2.0", "method": method, "params": params}
        self.send_raw(json.dumps(request | ({} if request_id is None else {"id": request_id})).encode() + b"\n")

    def send_raw(self, data: bytes) -> None:
        self.writer.write(data)

    async def receive(self) -> dict[str, Any]:
        async with asyncio.timeout(PATIENCE_S):
            line = await self.reader.readline()
        assert line, "the connection was closed"
        message: dict[str, Any] = json.loads(line)
        return message

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.send(method, **params)
        return await self.receive()

    async def ended(self) -> bool:
        """Read until the other side closes."""
        async with asyncio.timeout(PATIENCE_S):
            try:
                while await self.reader.read(1 << 16):
                    pass
            except ConnectionError:
                pass
        return True

    async def close(self) -> None:
        self.writer.transport.abort()
        with suppress(ConnectionError):
            await self.writer.wait_closed()


class Bench:
    """A server with a few methods, and clients of it."""

    peer: Peer

    def __init__(self, path: Path, clock: Clock | None, may_command: bool) -> None:
        self.path, self.clock = path, VirtualClock()
        self.gone: list[Connection] = []
        self.seen: list[Connection] = []
        self.peers: list[Peer] = []
        self.gate = asyncio.Event()
        methods = {
            "echo": Method(Numbered, self._echo),
            "wait": Method(Nothing, self._wait),
            "stop": Method(Nothing, self._stop, always=True),
            "subscribe": Method(Nothing, self._subscribe),
            "refuse": Method(Nothing, self._refuse),
            "break": Method(Nothing, self._break),
            "large": Method(Nothing, self._large),
            "look": Method(Nothing, self._stop, observes=True),
        }
        self.server = Server(
            methods, clock or self.clock, on_close=self.gone.append, may_command=lambda _uid: may_command
        )

    async def _echo(self, client: Connection, p: Numbered) -> dict[str, Any]:
        return {"number": p.number}

    async def _wait(self, client: Connection, p: Nothing) -> dict[str, Any]:
        await self.gate.wait()
        return {"waited": True}

    async def _stop(self, client: Connection, p: Nothing) -> dict[str, Any]:
        return {"state": "holding"}

    async def _subscribe(self, client: Connection, p: Nothing) -> dict[str, Any]:
        client.subscribed = True
        self.seen.append(client)
        return {}

    async def _refuse(self, client: Connection, p: Nothing) -> dict[str, Any]:
        raise RequestRefused("PREFLIGHT", ["too fast", "too low"])

    async def _break(self, client: Connection, p: Nothing) -> dict[str, Any]:
        raise KeyError("a defect")

    async def _large(self, client: Connection, p: Nothing) -> dict[str, Any]:
        return {"text": "x" * 300_000}

    async def connect(self) -> Peer:
        peer = Peer(*await asyncio.open_unix_connection(str(self.path), limit=1 << 20))
        self.peers.append(peer)
        return peer


@asynccontextmanager
async def bench(clock: Clock | None = None, may_command: bool = True) -> AsyncIterator[Bench]:
    """A bench and its first client."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "s"
        listening = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        listening.bind(str(path))
        listening.listen()
        found = Bench(path, clock, may_command)
        found.server.start(listening)
        found.peer = await found.connect()
        try:
            yield found
        finally:
            for peer in found.peers:
                await peer.close()
            await found.server.close()


async def until(condition: Callable[[], bool]) -> None:
    async with asyncio.timeout(PATIENCE_S):
        while not condition():
            await asyncio.sleep(0)
