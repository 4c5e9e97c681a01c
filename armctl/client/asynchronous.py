"""The other end of the daemon's socket, for programs that do several things at once.

    async with await AsyncClient.connect() as client:
        print((await client.call("status"))["state"])
        async for snapshot in client.subscribe():
            ...

The same connection, errors and methods as `armctl.client.Client`, but calls may overlap: a `run` answers when it has
ended, and `stop` is served meanwhile.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from armctl.client.blocking import Notification, error_of
from armctl.errors import NoDaemon, RequestRefused
from armctl.files import socket_path

MAX_LINE_BYTES = 16 * 2**20
MAX_WAITING_NOTIFICATIONS = 64


class AsyncClient:
    """One connection to the daemon; made by `connect`."""

    def __init__(self, path: Path, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self.path = path
        self._reader, self._writer = reader, writer
        self._last_id = 0
        self._waiting: dict[int, asyncio.Future[dict[str, Any]]] = {}
        self._notifications: asyncio.Queue[Notification | None] = asyncio.Queue(MAX_WAITING_NOTIFICATIONS)
        self._receiving = asyncio.create_task(self._receive())

    @classmethod
    async def connect(cls, path: str | Path | None = None) -> Self:
        """A connection to the daemon.

        Args:
            path: The daemon's socket; None: `ARMCTL_SOCKET`, else the usual place.
        Raises:
            NoDaemon: nobody answers there.
        """
        chosen = socket_path(None if path is None else str(path))
        try:
            reader, writer = await asyncio.open_unix_connection(chosen, limit=MAX_LINE_BYTES)
        except OSError as error:
            raise _no_daemon(chosen, error.strerror or str(error)) from None
        return cls(chosen, reader, writer)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        await self.close()

    @property
    def closed(self) -> bool:
        """Whether nothing will come any more."""
        return self._receiving.done()

    async def close(self) -> None:
        self._receiving.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await self._receiving
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """The result of a method.

        Raises:
            ArmctlError: whatever the daemon answered.
            NoDaemon: it is gone.
        """
        if self.closed:
            raise _no_daemon(self.path, "the connection is closed")
        self._last_id += 1
        request = {"jsonrpc": "2.0", "id": self._last_id, "method": method, "params": params}
        try:
            line = json.dumps(request, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        except ValueError as error:
            raise RequestRefused("LIMIT", f"{method}: a parameter is not a finite number ({error})") from None
        request_id, answer = self._last_id, asyncio.get_running_loop().create_future()
        self._waiting[request_id] = answer
        try:
            self._writer.write(line)
            await self._writer.drain()
            message = await answer
        except OSError as error:
            raise _no_daemon(self.path, error.strerror or str(error)) from None
        finally:
            self._waiting.pop(request_id, None)
        if "error" in message:
            raise error_of(message["error"])
        result: dict[str, Any] = message["result"]
        return result

    async def subscribe(self) -> AsyncIterator[dict[str, Any]]:
        """Snapshots as they come, one a tick; a consumer that lags loses the oldest."""
        await self.call("subscribe")
        async for method, params in self.notifications():
            if method == "snapshot":
                yield params

    async def notifications(self) -> AsyncIterator[Notification]:
        """Everything the daemon says by itself: (method, params).

        Raises:
            NoDaemon: it is gone.
        """
        while (notification := await self._notifications.get()) is not None:
            yield notification
        raise _no_daemon(self.path, "it closed the connection")

    async def _receive(self) -> None:
        try:
            while line := await self._reader.readline():
                message: dict[str, Any] = json.loads(line)
                if "method" in message:
                    self._put((message["method"], message["params"]))
                elif (answer := self._waiting.get(message["id"])) is not None and not answer.done():
                    answer.set_result(message)
        except (OSError, ValueError):
            pass  # a connection that breaks off, or that is none of ours: it is over either way
        finally:
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(_no_daemon(self.path, "it closed the connection"))
            self._put(None)

    def _put(self, notification: Notification | None) -> None:
        if self._notifications.full():
            self._notifications.get_nowait()
        self._notifications.put_nowait(notification)


def _no_daemon(path: Path, why: str) -> NoDaemon:
    return NoDaemon(f"no daemon answers on {path}: {why}; start it with `armctl daemon --port PORT`")
