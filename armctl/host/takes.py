"""The take of the moment, and the recorder that writes it."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any, Protocol

from armctl.messages import TickRecord


class TakeRecorder(Protocol):
    """The recorder as far as the host needs it."""

    @property
    def log_path(self) -> Path | None: ...
    @property
    def problem(self) -> str: ...
    @property
    def dropped_records(self) -> int: ...
    def put(self, record: TickRecord) -> None: ...
    def note(self, text: str, time_ns: int) -> None: ...
    def check(self) -> None: ...
    def begin_take(self, name: str) -> Path: ...
    def end_take(self) -> Path | None: ...
    def close(self) -> None: ...


class Takes:
    """The take of the moment."""

    def __init__(self, recorder: TakeRecorder) -> None:
        self.name: str | None = None
        self._recorder = recorder
        self._lock = asyncio.Lock()

    def check(self) -> None:
        """Raises LogError where no take can be begun now."""
        self._recorder.check()

    async def begin(self, name: str) -> Path:
        async with self._lock:  # whoever ends a take waits until it has begun
            path = await asyncio.to_thread(self._recorder.begin_take, name)
            self.name = name
            return path

    async def end(self) -> Path | None:
        async with self._lock:
            try:
                return await asyncio.to_thread(self._recorder.end_take)
            finally:
                self.name = None

    def log(self) -> dict[str, Any]:
        """Where the log goes, why it does not, and how many ticks the recorder was too slow for."""
        of = self._recorder
        return {"path": of.log_path and str(of.log_path), "problem": of.problem, "recorder_dropped": of.dropped_records}

    @asynccontextmanager
    async def around(self, name: str) -> AsyncIterator[str]:
        """A take around a motion, or of several motions the one that is around them all; its name."""
        if self.name is not None:
            yield self.name
            return
        await self.begin(name)
        try:
            yield name
        finally:
            await self.end()
