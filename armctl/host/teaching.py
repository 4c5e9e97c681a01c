"""Takes, and the hand that guides a limp arm through them."""

import asyncio
from pathlib import Path
from typing import Any, Protocol

from armctl.config import ArmConfig
from armctl.errors import IllegalTransition
from armctl.host.exchange import Exchange
from armctl.host.lease import Client, Leases
from armctl.messages import Mode, Teach, TeachEnd, TickRecord

_NO_TAKE = "no take is being recorded; take_begin comes first"


class TakeRecorder(Protocol):
    """The recorder as far as the host needs it."""

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
    def close(self) -> None: ...


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


class TeachingHost(Protocol):
    """The host as far as teaching needs it."""

    arm: ArmConfig
    exchange: Exchange
    leases: Leases
    takes: Takes
    latest: TickRecord | None

    def note(self, message: dict[str, Any]) -> None: ...
    def state(self) -> dict[str, Any]: ...


class Teaching:
    """What a teaching client asks for; it holds the lease until `end`, and leaves a limp arm however it goes."""

    def __init__(self, host: TeachingHost) -> None:
        self._host = host
        self._hurried = False

    async def begin(self, client: Client) -> dict[str, Any]:
        """Make the arm limp, verified so by the servos; the client keeps the lease until `end`."""
        with self._host.leases.commanding(client, "teach_begin") as lease:
            await self._host.exchange.request(Teach)
            if lease.lost:
                await self._host.exchange.request(TeachEnd)
        if not lease.lost:
            self._host.leases.keep(client, "teach")
        return self._host.state()

    async def take_begin(self, client: Client, name: str) -> dict[str, Any]:
        """Start recording a take.

        Raises:
            LogError: the name is taken, or the file cannot be written.
        """
        self._host.leases.teaching(client)
        if self._host.takes.name is not None:
            raise IllegalTransition(f"take {self._host.takes.name} is being recorded; take_end comes first")
        path = await self._host.takes.begin(name)
        return {"recording": name, "path": str(path)}

    async def take_mark(self, client: Client) -> dict[str, Any]:
        """Mark where the tool is now as a via point, in the take."""
        self._taking(client)
        latest = self._host.latest
        if latest is None or latest.outputs.tool is None:
            raise IllegalTransition(_NO_TAKE)
        marked = {
            "tick": latest.inputs.tick,
            "position_m": list(latest.outputs.tool.position_m),
            "joints_rad": [joint.position_rad for joint in latest.outputs.joints],
        }
        self._host.note({"event": "VIA_MARK", **marked})
        return marked

    async def take_end(self, client: Client) -> dict[str, Any]:
        """Finish the take."""
        name = self._taking(client)
        path = await self._host.takes.end()
        return {"recording": name, "path": str(path)}

    async def end(self, client: Client) -> dict[str, Any]:
        """Leave teach mode, keeping a take that is still open; the arm stays limp."""
        self._host.leases.teaching(client)
        lease = self._host.leases.current
        try:
            await self._end()
        finally:
            if self._host.leases.current is lease:
                self._host.leases.current = None
        return self._host.state()

    async def abandon(self, client: Client) -> None:
        """The client is gone: keep its take, and leave teach mode."""
        take = await self._host.takes.end()
        if take is not None:
            self._host.note({"event": "ORPHAN_TAKE", "who": client.name, "path": str(take)})
        await self._end()

    def _taking(self, client: Client) -> str:
        """The name of the take that this teaching client records."""
        self._host.leases.teaching(client)
        if self._host.takes.name is None:
            raise IllegalTransition(_NO_TAKE)
        return self._host.takes.name

    async def _end(self) -> None:
        await self._host.takes.end()
        # A fault, or a new control process, has ended the mode already.
        latest = self._host.latest
        if latest is not None and latest.outputs.mode is Mode.TEACHING:
            await self._host.exchange.request(TeachEnd)

    def mind_the_hand(self, mode: Mode, tool_speed_m_s: float | None) -> None:
        """Tell, once an excursion, that the hand is too fast."""
        speed_m_s, limit_m_s = tool_speed_m_s or 0.0, self._host.arm.tool_speed_limit_m_s
        hurried = mode is Mode.TEACHING and speed_m_s > limit_m_s
        if hurried and not self._hurried:
            text = f"the tool moves at {1e3 * speed_m_s:.0f} mm/s (bound {1e3 * limit_m_s:.0f})"
            self._host.note({"event": "TEACHING_FAST", "text": text})
        self._hurried = hurried
