"""Connections of the daemon's Unix socket.

Rules.
1. A connection's requests are served side by side, so that `stop` never waits behind a `run`.
2. Every line is charged by its bytes before it is parsed (`allowance.py`); a request that is not paid for is refused,
   save methods marked `always` (`stop`, `hold`). After each line the other connections get their turn, so a flood
   slows down nobody but its sender.
3. What is waiting to be sent is bounded: snapshots by dropping the oldest and counting the gap, answers by
   cutting the connection. A client that takes nothing for `STALL_S` is cut. So is one that has sent no whole request
   within `IDLE_S` of connecting, and one that leaves a line unfinished for `LINE_S`; who has asked once may be silent.
4. A client who may not command may look: it is served the methods that `observes`, and those marked `always`.
5. A user has so many places, and all users together (`allowance.py`); who has to make room is told why.
6. End of file means the client is gone. What it began is told so (`on_close`); answers still due are sent.
"""

import asyncio
import logging
import math
import socket
import struct
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from dataclasses import dataclass
from typing import Any

from pydantic import BaseModel

from armctl.clock import NS_PER_S, Clock
from armctl.config import validate
from armctl.errors import ArmctlError, ConfigError, RequestRefused
from armctl.host import allowance, jsonrpc
from armctl.host.allowance import Account, TokenBucket, make_room
from armctl.host.jsonrpc import ProtocolError, Request

STALL_S = 5.0
IDLE_S = 10.0
LINE_S = 5.0
# How many are let in at one turn, so that a crowd does not hold up who is there; the others wait in the kernel.
ACCEPTED = 8
WAITING = 512
MAX_SNAPSHOTS = 64
MAX_UNSENT_BYTES = 1 << 20
MAX_REQUESTS = 32
MAX_ALWAYS_REQUESTS = 1024
# Whether a user may command, by uid.
MayCommand = Callable[[int], bool]

logger = logging.getLogger(__name__)


class Connection:
    """One client: who it is, and what is to be sent to it."""

    def __init__(
        self, writer: asyncio.StreamWriter, may_command: MayCommand, holds_lease: Callable[["Connection"], bool]
    ) -> None:
        peer = writer.get_extra_info("socket")
        # Process, user and group at the other end, an int each.
        pid, self.uid, _ = struct.unpack("3i", peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))
        self.name = f"pid {pid} (uid {self.uid})"
        self.commands = may_command(self.uid)
        self.asked = False
        self.heard_s = 0.0
        self.subscribed = False
        self._holds_lease = holds_lease
        self.requests: set[asyncio.Task[None]] = set()
        self._writer = writer
        self._lines: deque[bytes] = deque()
        self._unsent_bytes = 0
        self._snapshots: deque[bytes] = deque()
        self._gap = 0
        self._finishing = False
        self._wake = asyncio.Event()
        # Whatever the kernel has not taken counts as no progress.
        writer.transport.set_write_buffer_limits(high=0)

    @property
    def closing(self) -> bool:
        return self._writer.transport.is_closing()

    @property
    def commanding(self) -> bool:
        """Whether the arm does what this client wants."""
        return self._holds_lease(self)

    @property
    def in_use(self) -> bool:
        return self.subscribed or bool(self.requests) or self.commanding

    def send(self, line: bytes) -> None:
        """Send an answer or a notification that must not get lost; cuts a client that lets them pile up."""
        if self._unsent_bytes > MAX_UNSENT_BYTES:
            self.cut("it does not read its answers")
            return
        self._lines.append(line)
        self._unsent_bytes += len(line)
        self._wake.set()

    def notify(self, method: str, params: dict[str, Any]) -> None:
        self.send(jsonrpc.notification_line(method, params))

    def send_snapshot(self, body: bytes) -> None:
        """Queue one snapshot (a JSON object), dropping the oldest of too many."""
        if len(self._snapshots) == MAX_SNAPSHOTS:
            self._snapshots.popleft()
            self._gap += 1
        self._snapshots.append(body)
        self._wake.set()

    def finish(self) -> None:
        """Close as soon as everything is sent."""
        self._finishing = True
        self._wake.set()

    def cut(self, why: str) -> None:
        """Close at once."""
        if not self.closing:
            logger.warning("client %s is cut: %s", self.name, why)
        self._writer.transport.abort()

    def dismiss(self, last_words: RequestRefused) -> None:
        """Close at once, with a last line if the client takes it."""
        self._writer.write(jsonrpc.error_line(None, last_words))
        self._writer.transport.abort()
        logger.info("%s", last_words)

    async def send_all(self) -> None:
        """Send what comes until finished, cut or gone; then the transport is closed."""
        try:
            while not (self._finishing and not self._lines):
                if (line := self._next_line()) is None:
                    self._wake.clear()
                    await self._wake.wait()
                    continue
                self._writer.write(line)
                async with asyncio.timeout(STALL_S):
                    await self._writer.drain()
        except TimeoutError:
            self.cut(f"it took nothing for {STALL_S:g} s")
        except ConnectionError:
            pass  # the client is gone; its reader sees the same
        finally:
            self._writer.transport.abort()  # everything sent is with the kernel by now

    def _next_line(self) -> bytes | None:
        if self._lines:
            line = self._lines.popleft()
            self._unsent_bytes -= len(line)
            return line
        if self._snapshots and not self._finishing:
            gap, self._gap = self._gap, 0
            body = self._snapshots.popleft()
            return b'{"jsonrpc":"2.0","method":"snapshot","params":{"gap":%d,%b}\n' % (gap, body[1:])
        return None


@dataclass(frozen=True)
class Method:
    """One thing a client can ask for: its parameters, and what carries it out."""

    params: type[BaseModel]
    handle: Callable[[Connection, Any], Awaitable[dict[str, Any]]]
    always: bool = False
    # Whether it changes nothing.
    observes: bool = False


class Server:
    """Serves `methods` on a listening Unix socket."""

    def __init__(
        self,
        methods: Mapping[str, Method],
        clock: Clock,
        on_close: Callable[[Connection], None],
        may_command: MayCommand,
        holds_lease: Callable[[Connection], bool] = lambda _: False,
    ) -> None:
        self._methods = methods
        self._holds_lease = holds_lease
        self._may_command = may_command
        self._clock = clock
        self._on_close = on_close
        # The oldest first.
        self._connections: dict[Connection, None] = {}
        # By uid; kept, so that nobody gets a new allowance by leaving.
        self._users: dict[int, TokenBucket] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._server: asyncio.Server | None = None

    async def start(self, listening: socket.socket) -> None:
        """Accept connections on a bound socket."""
        self._server = await asyncio.start_unix_server(
            self._accept, sock=listening, limit=jsonrpc.MAX_LINE_BYTES, backlog=ACCEPTED
        )
        listening.listen(WAITING)

    def _accept(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # A task of asyncio's own would leave a traceback in the log where `close` has to cancel it.
        task = asyncio.create_task(self._connected(reader, writer))
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Send what is still due, briefly, and close every connection."""
        if self._server is not None:
            self._server.close()
        tasks = tuple(self._tasks)
        requests = [request for connection in self._connections for request in connection.requests]
        if requests:
            await asyncio.wait(requests, timeout=0.2)
        for connection in tuple(self._connections):
            connection.finish()
        if tasks:
            _, late = await asyncio.wait(tasks, timeout=0.2)
            for task in late:
                task.cancel()
            await asyncio.gather(*late, return_exceptions=True)

    def publish(self, snapshot: Callable[[], dict[str, Any]]) -> None:
        """Queue the snapshot for every subscriber; it is made only if there is one."""
        subscribers = [connection for connection in self._connections if connection.subscribed]
        if subscribers:
            body = jsonrpc.encode(snapshot()).rstrip(b"\n")
            for connection in subscribers:
                connection.send_snapshot(body)

    async def _connected(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        connection = Connection(writer, self._may_command, self._holds_lease)
        connection.heard_s = now_s = self._now_s()
        try:
            if (victim := make_room(self._connections, connection.uid)) is not None:
                del self._connections[victim]
                victim.dismiss(_displaced(victim, connection))
        except RequestRefused as refusal:
            connection.dismiss(refusal)
            return
        bucket = TokenBucket(allowance.USER_RATE, allowance.USER_BURST, now_s)
        account = Account(self._users.setdefault(connection.uid, bucket), now_s)
        sender = asyncio.create_task(connection.send_all())
        self._connections[connection] = None
        logger.info("client %s connected", connection.name)
        try:
            try:
                await self._read(connection, account, reader)
            finally:
                connection.subscribed = False
                self._on_close(connection)
            if connection.requests:
                await asyncio.wait(connection.requests)
            connection.finish()
            await sender
        finally:
            for request in connection.requests:
                request.cancel()
            sender.cancel()
            self._connections.pop(connection, None)
            logger.info("client %s is gone", connection.name)

    async def _read(self, connection: Connection, account: Account, reader: asyncio.StreamReader) -> None:
        """Dispatch lines until the client is gone, takes too long over one, or sends one that is too long."""
        loop = asyncio.get_running_loop()
        idle_until_s, line_until_s = loop.time() + IDLE_S, math.inf
        unfinished = b""
        while True:
            until_s = line_until_s if connection.asked else min(idle_until_s, line_until_s)
            try:
                async with asyncio.timeout_at(until_s if until_s < math.inf else None):
                    data = await reader.read(jsonrpc.MAX_LINE_BYTES)
            except TimeoutError:
                connection.dismiss(_too_slow(connection, len(unfinished)))
                return
            except ConnectionError:
                return
            if not data:
                return
            *lines, rest = (unfinished + data).split(b"\n")
            for line in lines:
                if len(line) > jsonrpc.MAX_LINE_BYTES or connection.closing:
                    break
                await asyncio.sleep(self._dispatch(connection, account, line))
            if max(map(len, (*lines, rest))) > jsonrpc.MAX_LINE_BYTES:
                problem = f"a line is longer than {jsonrpc.MAX_LINE_BYTES} bytes; the connection is closed"
                connection.send(jsonrpc.error_line(None, ProtocolError(jsonrpc.PARSE_ERROR, problem)))
                return
            if not rest:
                line_until_s = math.inf
            elif lines or not unfinished:
                line_until_s = loop.time() + LINE_S
            unfinished = rest

    def _dispatch(self, connection: Connection, account: Account, line: bytes) -> float:
        """Begin what a line asks for; how long the connection rests after it [s]."""
        connection.heard_s = now_s = self._now_s()
        paid, rest_s = account.charge(len(line), now_s)
        if paid or len(line) <= allowance.SHORT_BYTES:
            self._begin(connection, line, paid)
        else:
            connection.send(jsonrpc.error_line(None, _unpaid(len(line))))
        return rest_s

    def _begin(self, connection: Connection, line: bytes, paid: bool) -> None:
        try:
            request = jsonrpc.decode(line)
        except ProtocolError as error:
            connection.send(jsonrpc.error_line(error.id, error))
            return
        connection.asked = True
        try:
            method = self._admit(connection, request, paid)
            params = _parameters(method, request)
        except (ProtocolError, RequestRefused) as error:
            if request.answered:
                connection.send(jsonrpc.error_line(request.id, error))
            return
        task = asyncio.create_task(_serve(connection, request, method, params))
        connection.requests.add(task)
        task.add_done_callback(connection.requests.discard)

    def _admit(self, connection: Connection, request: Request, paid: bool) -> Method:
        method = self._methods.get(request.method)
        if method is None:
            known = ", ".join(self._methods)
            raise ProtocolError(jsonrpc.METHOD_NOT_FOUND, f"no method {request.method[:60]!r}; known: {known}")
        if not (connection.commands or method.always or method.observes):
            raise RequestRefused(
                "NOT_A_COMMANDER",
                f"{request.method}: {connection.name} may look, and stop the arm; who may command stands under "
                "`commanders` in the daemon's configuration",
            )
        if not paid and not method.always:
            raise RequestRefused(
                "RATE_LIMIT", f"more than {allowance.RATE:g} requests a second; wait (`stop` is served always)"
            )
        bound = MAX_ALWAYS_REQUESTS if method.always else MAX_REQUESTS
        if len(connection.requests) >= bound:
            raise RequestRefused("RATE_LIMIT", f"{bound} requests of this client are under way already; wait")
        return method

    def _now_s(self) -> float:
        return self._clock.now_ns() / NS_PER_S


def _unpaid(size: int) -> RequestRefused:
    short, long_bytes_s = size // allowance.TOKEN_BYTES, allowance.USER_RATE * allowance.TOKEN_BYTES
    return RequestRefused(
        "RATE_LIMIT",
        f"a line of {size} bytes is not read: it costs as much as {short} short ones; a connection has "
        f"{allowance.RATE:g} of these a second, and its user {long_bytes_s:.0f} bytes of long lines; wait",
    )


def _displaced(victim: Connection, newcomer: Connection) -> RequestRefused:
    return RequestRefused(
        "BUSY",
        f"{victim.name} gives its place to {newcomer.name}: {allowance.USER_PLACES} connections a user or "
        f"{allowance.PLACES} in all are open, and it was silent longest; connect again when there is something to ask",
    )


def _too_slow(connection: Connection, unfinished: int) -> RequestRefused:
    if unfinished:
        what = f"its line of {unfinished} bytes so far is not finished after {LINE_S:g} s; send a request at once"
    else:
        what = f"it sent no whole request within {IDLE_S:g} s; connect when there is something to ask"
    return RequestRefused("IDLE", f"{connection.name} is disconnected: {what}")


def _parameters(method: Method, request: Request) -> BaseModel:
    try:
        return validate(method.params, request.params, request.method)
    except ConfigError as error:
        raise ProtocolError(jsonrpc.INVALID_PARAMS, str(error)) from error


async def _serve(connection: Connection, request: Request, method: Method, params: BaseModel) -> None:
    try:
        line = jsonrpc.result_line(request.id, await method.handle(connection, params))
    except ArmctlError as error:
        line = jsonrpc.error_line(request.id, error)
    except Exception as error:  # the daemon and its other clients go on; the defect is in its log
        logger.exception("request %s of client %s failed", request.method, connection.name)
        line = jsonrpc.error_line(request.id, error)
    if request.answered:
        connection.send(line)
