"""Requests to the control process of the moment, and its answers."""

import asyncio
import itertools
from collections.abc import Callable

from armctl.errors import IllegalTransition, RequestRefused
from armctl.messages import Clear, Command, Hold, Park, Release, Reply, TorqueOn

# Longest wait for the control process's answer to anything but the end of a motion.
ANSWER_S = 10.0
# Makes the command of a request id.
MakeCommand = Callable[[int], Command]
# What a commander asks for in one word.
COMMANDS: dict[str, MakeCommand] = {"release": Release, "torque_on": TorqueOn, "park": Park, "clear": Clear}


class Exchange:
    """Every request is answered once, by the control process or by its end."""

    def __init__(self) -> None:
        # Of the control process; None: there is none now.
        self.pid: int | None = None
        self._send: Callable[[Command], bool] = lambda _: False
        self._ids = itertools.count(1)
        self._pending: dict[int, asyncio.Future[Reply]] = {}
        # The last one, if nothing that may move something was sent since; and when it was sent.
        self._hold: asyncio.Task[Reply] | None = None
        self._held_ns = 0

    def attach(self, pid: int, send: Callable[[Command], bool]) -> None:
        """Commands go to this control process from now on.

        Args:
            send: Whether it took the command; False: it does not keep up, try again.
        """
        self.pid, self._send = pid, send

    def lost(self) -> None:
        """The control process is gone: what it still owed an answer fails."""
        self.pid = None
        for future in self._pending.values():
            if not future.done():
                future.set_exception(restarting())

    def answer(self, reply: Reply) -> None:
        """Hand an answer to whoever waits for it."""
        future = self._pending.get(reply.request_id)
        if future is not None and not future.done():
            future.set_result(reply)

    async def request(self, make: MakeCommand, timeout_s: float | None = ANSWER_S) -> Reply:
        """Send a command and wait for what became of it.

        Args:
            timeout_s: Longest wait; None: as long as it takes.
        Raises:
            RequestRefused: it was refused, or the control process died or stayed silent.
        """
        request_id = next(self._ids)
        future: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._pending[request_id] = future
        try:
            async with asyncio.timeout(timeout_s):
                while not self._sent(make(request_id)) and not future.done():
                    await asyncio.sleep(0.01)
                reply = await future
        except TimeoutError:
            why = f"the control process did not answer within {timeout_s:g} s; see `armctl status`"
            raise RequestRefused("NO_ANSWER", why) from None
        finally:
            del self._pending[request_id]
        if reply.ok:
            return reply
        if reply.code == "ILLEGAL_TRANSITION":
            raise IllegalTransition(reply.message)
        raise RequestRefused(reply.code, reply.message)

    async def hold(self, now_ns: int, shared_ns: int) -> None:
        """Stop the arm, by the command that is under way where there is one.

        Args:
            shared_ns: For how long after it was sent an answered command still counts, if nothing else was asked since.
        Raises:
            RequestRefused: as `request`.
        """
        hold, since_ns = self._hold, now_ns - self._held_ns
        if hold is None or (hold.done() and (since_ns > shared_ns or hold.exception() is not None)):
            hold = self._hold = asyncio.create_task(self.request(Hold))
            self._held_ns = now_ns
        await asyncio.shield(hold)

    def forget_hold(self) -> None:
        """The next `hold` is a command of its own."""
        self._hold = None

    def _sent(self, command: Command) -> bool:
        if self.pid is None:
            raise restarting()
        if not isinstance(command, Hold):
            self.forget_hold()
        return self._send(command)


def restarting() -> RequestRefused:
    """Why nothing can be asked of the arm for a moment."""
    why = "the control process died and is being started again; the arm keeps its last goal; try again"
    return RequestRefused("RESTARTED", why)
