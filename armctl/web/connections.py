"""The dashboard's connections to the daemon.

Rules.
1. One connection watches: it is made again whenever it breaks, and everything seen goes to every page. `stop` has its
   own way to the control process; where there is none it goes over this connection, before any request under way.
2. One connection commands, for all pages together: it is made with the first command and closed when the last page
   has left, which ends teaching and lets go of the arm as for any client that leaves.
"""

import asyncio
import contextlib
import json
from collections.abc import AsyncIterator, Callable
from pathlib import Path
from typing import Any

from armctl.client.asynchronous import AsyncClient, put_newest
from armctl.errors import ArmctlError, NoDaemon
from armctl.files import stop_path

RETRY_S = 0.5
# Longest wait for an answer to STOP on its own way.
STOP_S = 1.0
# How long a page may be away, as while it is loaded again, before it counts as left.
LEAVE_S = 3.0
# Messages a slow page may lag behind; then it loses the oldest.
MAX_WAITING = 4


class Connections:
    """The daemon as the dashboard sees it."""

    def __init__(self, socket: Path, person: Callable[[], str] = str) -> None:
        """
        Args:
            socket: The daemon's socket.
            person: Who makes the request that is being served; the log names them.
        """
        self.socket = socket
        self.snapshot: dict[str, Any] | None = None
        self._person = person
        self._pages: set[asyncio.Queue[str]] = set()
        self._watcher: AsyncClient | None = None
        self._commander: AsyncClient | None = None
        self._connecting = asyncio.Lock()
        self._tasks: set[asyncio.Task[None]] = set()

    @contextlib.asynccontextmanager
    async def running(self) -> AsyncIterator[None]:
        """Watch while inside."""
        watching = asyncio.create_task(self._watch())
        try:
            yield
        finally:
            for task in (watching, *self._tasks):
                task.cancel()
            await asyncio.gather(watching, *self._tasks, return_exceptions=True)
            await self._leave()

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        """A request of the commanding connection.

        Raises:
            ArmctlError: what the daemon answered, or that it is gone.
        """
        async with self._connecting:
            if self._commander is None or self._commander.closed:
                self._commander = await AsyncClient(self.socket).open()
                self._start(self._forward(self._commander))
            commander = self._commander
        return await commander.asked(method, params, self._person())

    async def stop(self) -> dict[str, Any]:
        """`stop`, straight to the control process; else over whatever connection there is."""
        with contextlib.suppress(OSError):
            async with asyncio.timeout(STOP_S):
                reader, writer = await asyncio.open_unix_connection(stop_path(self.socket))
                with contextlib.closing(writer):
                    writer.write(b"stop\n")
                    done, _, state = (await reader.readline()).decode().strip().partition(" ")
                if done == "ok":
                    return {"state": state}
        watcher = self._watcher
        if watcher is not None and not watcher.closed:
            return await watcher.call("stop")
        async with AsyncClient(self.socket) as client:
            return await client.call("stop")

    @contextlib.asynccontextmanager
    async def page(self) -> AsyncIterator[asyncio.Queue[str]]:
        """Messages for one page, as JSON texts, while inside."""
        queue: asyncio.Queue[str] = asyncio.Queue(MAX_WAITING)
        self._pages.add(queue)
        put_newest(queue, json.dumps({"kind": "snapshot", "snapshot": self.snapshot}))
        try:
            yield queue
        finally:
            self._pages.remove(queue)
            if not self._pages:
                self._start(self._leave_unless_back())

    async def _watch(self) -> None:
        while True:
            with contextlib.suppress(NoDaemon):
                async with AsyncClient(self.socket) as self._watcher:
                    async for snapshot in self._watcher.subscribe():
                        self._see(snapshot)
            self._see(None)
            await asyncio.sleep(RETRY_S)

    def _see(self, snapshot: dict[str, Any] | None) -> None:
        self.snapshot = snapshot
        if self._pages:
            self.tell({"kind": "snapshot", "snapshot": self.snapshot})

    def tell(self, message: dict[str, Any]) -> None:
        """Send a message to every page."""
        text = json.dumps(message, separators=(",", ":"))
        for page in self._pages:
            put_newest(page, text)

    async def _forward(self, commander: AsyncClient) -> None:
        """Tell the pages how far an optimisation or a refinement is, and what a motion warns of."""
        with contextlib.suppress(ArmctlError):
            async for method, params in commander.notifications():
                if method == "progress":
                    self.tell({"kind": "progress", **params})

    async def _leave_unless_back(self) -> None:
        await asyncio.sleep(LEAVE_S)
        if not self._pages:
            await self._leave()

    async def _leave(self) -> None:
        commander, self._commander = self._commander, None
        if commander is not None:
            await commander.close()

    def _start(self, work: Any) -> None:
        task = asyncio.create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)
