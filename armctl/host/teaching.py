"""Takes, and the hand that guides a limp arm through them."""

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from armctl.errors import IllegalTransition
from armctl.host.exchange import Exchange
from armctl.host.lease import Client, Leases
from armctl.messages import Mode, Teach, TeachEnd, TickRecord


class TakeRecorder(Protocol):
    """The recorder as far as requests need it."""

    @property
    def log_path(self) -> Path | None: ...
    @property
    def problem(self) -> str: ...
    @property
    def dropped_records(self) -> int: ...
    def put(self, record: TickRecord) -> None: ...
    def note(self, topic: str, text: str, time_ns: int) -> None: ...
    def begin_take(self, name: str) -> Path: ...
    def end_take(self) -> Path | None: ...


class Takes:
    """The take of the moment."""

    def __init__(self, recorder: TakeRecorder) -> None:
        self.name: str | None = None
        self._recorder = recorder
        self._lock = asyncio.Lock()

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


class Teaching:
    """What a teaching client asks for; it holds the lease until `end`, and leaves a limp arm however it goes.

    Args:
        latest: The newest tick record.
        note: Puts a message into the log and the take.
        speed_limit_m_s: A hand that leads the tool faster is warned: the arm's `tool_speed_limit_m_s`.
    """

    def __init__(
        self,
        exchange: Exchange,
        leases: Leases,
        takes: Takes,
        latest: Callable[[], TickRecord | None],
        note: Callable[[dict[str, Any]], None],
        speed_limit_m_s: float,
    ) -> None:
        self._exchange, self._leases, self._takes = exchange, leases, takes
        self._latest, self._note = latest, note
        self._speed_limit_m_s = speed_limit_m_s
        self._hurried = False

    async def begin(self, client: Client) -> None:
        """Make the arm limp, verified so by the servos."""
        with self._leases.commanding(client, "teach_begin") as lease:
            await self._exchange.request(Teach)
            if lease.lost:
                await self._exchange.request(TeachEnd)
        if not lease.lost:
            self._leases.keep(client, "teach")

    async def take_begin(self, client: Client, name: str) -> dict[str, Any]:
        """Start recording a take.

        Raises:
            LogError: the name is taken, or the file cannot be written.
        """
        self._leases.teaching(client)
        if self._takes.name is not None:
            raise IllegalTransition(f"take {self._takes.name} is being recorded; take_end comes first")
        path = await self._takes.begin(name)
        return {"recording": name, "path": str(path)}

    async def take_mark(self, client: Client) -> dict[str, Any]:
        """Mark where the tool is now as a via point, in the take."""
        latest = self._latest()
        self._leases.teaching(client)
        if self._takes.name is None or latest is None or latest.outputs.tool is None:
            raise IllegalTransition("no take is being recorded; take_begin comes first")
        marked = {
            "tick": latest.inputs.tick,
            "position_m": list(latest.outputs.tool.position_m),
            "joints_rad": [joint.position_rad for joint in latest.outputs.joints],
        }
        self._note({"event": "VIA_MARK", **marked})
        return marked

    async def take_end(self, client: Client) -> dict[str, Any]:
        """Finish the take."""
        self._leases.teaching(client)
        if self._takes.name is None:
            raise IllegalTransition("no take is being recorded; take_begin comes first")
        name = self._takes.name
        path = await self._takes.end()
        return {"recording": name, "path": str(path)}

    async def end(self, client: Client) -> None:
        """Leave teach mode, keeping a take that is still open; the arm stays limp."""
        self._leases.teaching(client)
        lease = self._leases.current
        try:
            await self._end()
        finally:
            if self._leases.current is lease:
                self._leases.current = None

    async def abandon(self, client: Client) -> None:
        """The client is gone: keep its take, and leave teach mode."""
        take = await self._takes.end()
        if take is not None:
            self._note({"event": "ORPHAN_TAKE", "who": client.name, "path": str(take)})
        await self._end()

    async def _end(self) -> None:
        await self._takes.end()
        # A fault, or a new control process, has ended the mode already.
        latest = self._latest()
        if latest is not None and latest.outputs.mode is Mode.TEACHING:
            await self._exchange.request(TeachEnd)

    def mind_the_hand(self, mode: Mode, tool_speed_m_s: float | None) -> None:
        """Tell, once an excursion, that the hand is too fast."""
        speed_m_s, limit_m_s = tool_speed_m_s or 0.0, self._speed_limit_m_s
        hurried = mode is Mode.TEACHING and speed_m_s > limit_m_s
        if hurried and not self._hurried:
            text = f"the tool moves at {1e3 * speed_m_s:.0f} mm/s (bound {1e3 * limit_m_s:.0f})"
            self._note({"event": "TEACHING_FAST", "text": text})
        self._hurried = hurried
