"""The other end of the daemon's socket, for programs that do several things at once.

    async with AsyncClient() as client:
        print((await client.call("status"))["state"])
        async for snapshot in client.subscribe():
            ...

The same connection, errors and methods as `armctl.client.Client`, but every call is awaited, and calls may overlap: a
`run` answers when it has ended, and `stop` is served meanwhile.
"""

import asyncio
import contextlib
import json
import socket
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any, Self, TypeVar

from armctl.client.protocol import CONNECTIONS, MAX_WAITING_NOTIFICATIONS, Message, Notification, Protocol

MAX_LINE_BYTES = 16 * 2**20

T = TypeVar("T")


class AsyncClient(Protocol):
    """One connection to the daemon, from `open` or the begin of `async with` on.

    Args:
        socket: The daemon's; None: `ARMCTL_SOCKET`, else the usual place.
    """

    _reader: asyncio.StreamReader
    _writer: asyncio.StreamWriter
    _receiving: asyncio.Task[None]

    def __init__(self, socket: str | Path | None = None) -> None:
        super().__init__(socket)
        self._waiting: dict[int, asyncio.Future[Message]] = {}
        self._opening = asyncio.Lock()

    async def open(self) -> Self:
        """Connect.

        Raises:
            NoDaemon: nobody answers there.
        """
        connection = socket.socket(socket.AF_UNIX)
        connection.setblocking(False)
        try:
            await asyncio.get_running_loop().sock_connect(connection, str(self.socket_file))
            self._reader, self._writer = await asyncio.open_unix_connection(sock=connection, limit=MAX_LINE_BYTES)
        except OSError as error:
            connection.close()
            raise self.no_daemon(error) from None
        CONNECTIONS.add(connection)
        self._notifications: asyncio.Queue[Notification | None] = asyncio.Queue(MAX_WAITING_NOTIFICATIONS)
        self._receiving = asyncio.create_task(self._receive())
        return self

    async def __aenter__(self) -> Self:
        return await self.open()

    async def __aexit__(self, *_: object) -> None:
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

    async def call(self, method: str, **params: Any) -> Message:
        """The result of a method; as `asked`."""
        return await self.asked(method, params)

    async def asked(self, method: str, params: Message, person: str = "") -> Message:
        """The result of a method.

        Args:
            person: For whom it is asked, where this process serves several people; the daemon's log names them.
        Raises:
            ArmctlError: whatever the daemon answered.
            NoDaemon: it is gone.
        """
        async with self._opening:
            if self.closed and not self._last_id:
                self._writer.close()
                await self.open()  # the daemon keeps no connection that asks nothing for long
        if self.closed:
            raise self.no_daemon("the connection is closed")
        line = self.request(method, params, person)
        request_id, answer = self._last_id, asyncio.get_running_loop().create_future()
        self._waiting[request_id] = answer
        try:
            self._writer.write(line)
            await self._writer.drain()
            return self.result(await answer)
        except OSError as error:
            raise self.no_daemon(error) from None
        finally:
            self._waiting.pop(request_id, None)

    async def subscribe(self) -> AsyncIterator[Message]:
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
        while (told := await self._notifications.get()) is not None:
            yield told
        raise self.no_daemon("it closed the connection")

    async def _receive(self) -> None:
        try:
            while line := await self._reader.readline():
                message: Message = json.loads(line)
                if (told := self.notification(message)) is not None:
                    put_newest(self._notifications, told)
                elif (answer := self._waiting.get(message["id"])) is not None and not answer.done():
                    answer.set_result(message)
        except (OSError, ValueError):
            pass  # a connection that breaks off, or that is none of ours: it is over either way
        finally:
            for answer in self._waiting.values():
                if not answer.done():
                    answer.set_exception(self.no_daemon("it closed the connection"))
            put_newest(self._notifications, None)


def put_newest(queue: asyncio.Queue[T], item: T) -> None:
    """Put something into a queue, which loses its oldest where it is full."""
    if queue.full():
        queue.get_nowait()
    queue.put_nowait(item)
