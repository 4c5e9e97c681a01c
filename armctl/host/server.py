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
import contextlib
import logging
import math
import socket
from collections import deque
from collections.abc import Awaitable, Callable, Mapping
from contextvars import ContextVar
from dataclasses import dataclass
from typing import Any, NamedTuple

from pydantic import BaseModel

from armctl.clock import NS_PER_S, Clock
from armctl.config import validate
from armctl.control.stop_lane import credentials
from armctl.errors import ArmctlError, ConfigError, RequestRefused
from armctl.host import allowance, jsonrpc
from armctl.host.allowance import Account, User, make_room
from armctl.host.jsonrpc import ProtocolError, Request

STALL_S = 5.0
IDLE_S = 10.0
LINE_S = 5.0
# How many are let in at one turn, so that a crowd does not hold up who is there; the others wait in the kernel.
ACCEPTED = 8
WAITING = 512
AGAIN_S = 0.5
MAX_SNAPSHOTS = 64
MAX_UNSENT_BYTES = 1 << 20
MAX_REQUESTS = 32
MAX_ALWAYS_REQUESTS = 1024
# Whether a user may command, by uid; whether the arm does what a client wants.
MayCommand = Callable[[int], bool]
HoldsLease = Callable[["Connection"], bool]

# For whom the request is that a task serves.
PERSON: ContextVar[str] = ContextVar("person", default="")

logger = logging.getLogger(__name__)


class Connection:
    """One client: who it is, and what is to be sent to it."""

    def __init__(self, writer: asyncio.StreamWriter, may_command: MayCommand, holds_lease: HoldsLease) -> None:
        pid, self.uid = credentials(writer.get_extra_info("socket"))
        self.name = f"pid {pid} (uid {self.uid})"
        self.commands = may_command(self.uid)
        self.asked, self.heard_s, self.subscribed, self._holds_lease = False, 0.0, False, holds_lease
        self.requests: set[asyncio.Task[None]] = set()
        self._writer = writer
        self._lines: deque[bytes] = deque()
        self._unsent_bytes = 0
        self._snapshots: deque[bytes] = deque(maxlen=MAX_SNAPSHOTS)
        self._gap, self._finishing = 0, False
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
        self._gap += len(self._snapshots) == MAX_SNAPSHOTS
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


class Method(NamedTuple):
    """One thing a client can ask for: its parameters, and what carries it out."""

    params: type[BaseModel]
    handle: Callable[[Connection, Any], Awaitable[dict[str, Any]]]
    always: bool = False
    # Whether it changes nothing.
    observes: bool = False


@dataclass(eq=False)
class Server:
    """Serves `methods` on a listening Unix socket."""

    methods: Mapping[str, Method]
    clock: Clock
    on_close: Callable[[Connection], None]
    may_command: MayCommand
    holds_lease: HoldsLease = lambda _: False

    def __post_init__(self) -> None:
        # The oldest first.
        self._connections: dict[Connection, None] = {}
        # By uid; kept, so that nobody gets a new allowance by leaving.
        self._users: dict[int, User] = {}
        self._tasks: set[asyncio.Task[None]] = set()
        self._listening: socket.socket | None = None

    def start(self, listening: socket.socket) -> None:
        """Accept connections on a bound socket."""
        listening.setblocking(False)
        listening.listen(WAITING)
        self._listening = listening
        self._listen()

    def _listen(self) -> None:
        if self._listening is not None:
            asyncio.get_running_loop().add_reader(self._listening, self._accept)

    def _accept(self) -> None:
        """Let in who waits; whoever's user comes too often is sent away before anything is made for it."""
        assert self._listening is not None
        for _ in range(ACCEPTED):
            try:
                peer, _address = self._listening.accept()
            except BlockingIOError:
                return
            except OSError as error:  # no files left, say; not asked again at every turn
                logger.warning("no connection can be let in: %s", error)
                asyncio.get_running_loop().remove_reader(self._listening)
                asyncio.get_running_loop().call_later(AGAIN_S, self._listen)
                return
            now_s = self._now_s()
            _, uid = credentials(peer)
            user = self._users.setdefault(uid, User(now_s))
            if not user.comings.take(now_s):
                with contextlib.suppress(OSError):
                    peer.send(jsonrpc.error_line(None, allowance.too_often(uid)))
                peer.close()
                continue
            # A task of asyncio's own would leave a traceback in the log where `close` has to cancel it.
            task = asyncio.create_task(self._connected(peer, user))
            self._tasks.add(task)
            task.add_done_callback(self._tasks.discard)

    async def close(self) -> None:
        """Send what is still due, briefly, and close every connection."""
        if self._listening is not None:
            asyncio.get_running_loop().remove_reader(self._listening)
            self._listening.close()
            self._listening = None
            await asyncio.sleep(0)  # who was let in just now has begun
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

    async def _connected(self, peer: socket.socket, user: User) -> None:
        reader, writer = await asyncio.open_unix_connection(sock=peer, limit=jsonrpc.MAX_LINE_BYTES)
        connection = Connection(writer, self.may_command, self.holds_lease)
        connection.heard_s = now_s = self._now_s()
        try:
            if (victim := make_room(self._connections, connection.uid)) is not None:
                del self._connections[victim]
                victim.dismiss(allowance.displaced(victim.name, connection.name))
        except RequestRefused as refusal:
            connection.dismiss(refusal)
            return
        account = Account(user, now_s)
        sender = asyncio.create_task(connection.send_all())
        self._connections[connection] = None
        logger.debug("client %s connected", connection.name)
        try:
            try:
                await self._read(connection, account, reader)
            finally:
                connection.subscribed = False
                self.on_close(connection)
            if connection.requests:
                await asyncio.wait(connection.requests)
            connection.finish()
            await sender
        finally:
            for request in connection.requests:
                request.cancel()
            sender.cancel()
            self._connections.pop(connection, None)
            logger.debug("client %s is gone", connection.name)

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
                within_s = LINE_S if unfinished else IDLE_S
                connection.dismiss(allowance.too_slow(connection.name, len(unfinished), within_s))
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
            connection.send(jsonrpc.error_line(None, allowance.unpaid(len(line))))
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
            params = validate(method.params, request.params, request.method)
        except (ConfigError, ProtocolError, RequestRefused) as error:
            told = ProtocolError(jsonrpc.INVALID_PARAMS, str(error)) if isinstance(error, ConfigError) else error
            if request.answered:
                connection.send(jsonrpc.error_line(request.id, told))
            return
        task = asyncio.create_task(_serve(connection, request, method, params))
        connection.requests.add(task)
        task.add_done_callback(connection.requests.discard)

    def _admit(self, connection: Connection, request: Request, paid: bool) -> Method:
        method = self.methods.get(request.method)
        if method is None:
            known = ", ".join(self.methods)
            raise ProtocolError(jsonrpc.METHOD_NOT_FOUND, f"no method {request.method[:60]!r}; known: {known}")
        if not (connection.commands or method.always or method.observes):
            remedy = "who may command stands under `commanders` in the daemon's configuration"
            text = f"{request.method}: {connection.name} may look, and stop the arm; {remedy}"
            raise RequestRefused("NOT_A_COMMANDER", text)
        if not paid and not method.always:
            text = f"more than {allowance.RATE:g} requests a second; wait (`stop` is served always)"
            raise RequestRefused("RATE_LIMIT", text)
        bound = MAX_ALWAYS_REQUESTS if method.always else MAX_REQUESTS
        if len(connection.requests) >= bound:
            raise RequestRefused("RATE_LIMIT", f"{bound} requests of this client are under way already; wait")
        return method

    def _now_s(self) -> float:
        return self.clock.now_ns() / NS_PER_S


async def _serve(connection: Connection, request: Request, method: Method, params: BaseModel) -> None:
    PERSON.set(request.person)
    try:
        line = jsonrpc.result_line(request.id, await method.handle(connection, params))
    except ArmctlError as error:
        line = jsonrpc.error_line(request.id, error)
    except Exception as error:  # the daemon and its other clients go on; the defect is in its log
        logger.exception("request %s of client %s failed", request.method, connection.name)
        line = jsonrpc.error_line(request.id, error)
    if request.answered:
        connection.send(line)
