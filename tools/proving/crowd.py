"""Crowds before a daemon and its dashboard, each in a process of its own; and STOP by every way, from its connect.

A crowd connects again whenever it is sent away: `idle` says nothing, `half_sent` begins an HTTP request, `long_lines`
sends lines of 64 KiB as fast as they are taken, `subscribers` reads every snapshot.

The ways of STOP, each over a connection of its own: its `lane`, the `socket` (`stop`, and `hold` in turn), the `page`
(an HTTP request with its token), and `typed`: `armctl stop`, whose lane is a relay of this module that lets the command
wait, then connects for it. So what the machine needs to start an interpreter beside the load is told and not judged.
"""

from __future__ import annotations

import contextlib
import http.client
import itertools
import json
import math
import multiprocessing
import select
import selectors
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from multiprocessing.sharedctypes import SynchronizedArray
from multiprocessing.synchronize import Barrier, Event, Lock
from pathlib import Path

CROWD = {"idle": 64, "half_sent": 70, "long_lines": 20, "subscribers": 50}
WAYS = ("lane", "socket", "page", "typed")
STOP_EVERY_S = 0.04
AGAIN_S = 0.1
PATIENCE_S = 20.0
# Longest start of a process beside everything else.
START_S = 60.0
# Answers that each stalled subscriber leaves unread from the first: as many as fill a socket.
FILLING = 200
LINE_BYTES = 65536
# What takes a parser longest, and what takes a validator longest.
_LISTS, _KEYS = b"[[[[[[[[]]]]]]]],", b'"%06x":1,'
_HEAD = b'{"jsonrpc":"2.0","id":1,"method":"status","params":{"x":'


@dataclass(frozen=True)
class Place:
    """Where everything is asked; picklable."""

    socket: str
    port: int
    token: str


@dataclass(frozen=True)
class Stopped:
    """One `stop`: by which way, when it connected and was answered [s, monotonic]; infinity: never, or refused."""

    way: str
    connected_s: float
    answered_s: float
    # Of a typed command, from start to end.
    whole_s: float = math.nan


def long_lines() -> list[bytes]:
    """Requests as long as a line may be."""
    room = LINE_BYTES - len(_HEAD) - 10
    keys = b"".join(_KEYS % number for number in range(room // 11)).rstrip(b",")
    inside = (
        b"[" + (_LISTS * (room // len(_LISTS))).rstrip(b",") + b"]",
        b"{" + keys + b"}",
        b'"' + b"x" * room + b'"',
    )
    return [_HEAD + one + b"}}\n" for one in inside]


@contextlib.contextmanager
def crowded(place: Place, crowd: Mapping[str, int]) -> Iterator[dict[str, SynchronizedArray[int]]]:
    """Such crowds while inside; how often each kind connected and was sent away so far, and MiB that it sent."""
    context = multiprocessing.get_context("spawn")
    ending, there = context.Event(), context.Barrier(len(crowd) + 1)
    tallies = {kind: context.Array("q", 3) for kind in crowd}
    processes = [
        context.Process(target=_crowd, args=(kind, count, place, tallies[kind], there, ending), daemon=True)
        for kind, count in crowd.items()
    ]
    for process in processes:
        process.start()
    try:
        there.wait(START_S)
        yield tallies
    finally:
        ending.set()
        for process in processes:
            process.join(PATIENCE_S)
            process.kill()


def _crowd(kind: str, count: int, place: Place, tally: SynchronizedArray[int], there: Barrier, ending: Event) -> None:
    """Body of one crowd's process."""
    lines = itertools.cycle(long_lines())
    left: dict[socket.socket, memoryview] = {}
    away: list[float] = [0.0] * count
    arrived = False
    with selectors.DefaultSelector() as selector:
        while not ending.is_set():
            now_s = time.monotonic()
            for _ in [due for due in away if due <= now_s]:
                away.remove(min(away))
                if (new := _connected(kind, place)) is None:
                    away.append(now_s + AGAIN_S)
                    continue
                tally[0] += 1
                left[new] = memoryview(b"")
                writes = selectors.EVENT_WRITE if kind == "long_lines" else 0
                selector.register(new, selectors.EVENT_READ | writes)
            if not arrived:
                arrived = bool(there.wait(START_S)) or True
            for key, events in selector.select(AGAIN_S):
                connection = key.fileobj
                assert isinstance(connection, socket.socket)
                try:
                    gone = bool(events & selectors.EVENT_READ) and not connection.recv(1 << 18)
                    if events & selectors.EVENT_WRITE and not gone:
                        rest = left[connection] or memoryview(next(lines))
                        sent = connection.send(rest)
                        left[connection] = rest[sent:]
                        tally[2] += sent
                except BlockingIOError:
                    continue
                except OSError:
                    gone = True
                if gone:
                    selector.unregister(connection)
                    connection.close()
                    del left[connection]
                    tally[1] += 1
                    away.append(time.monotonic() + AGAIN_S)
        for connection in left:
            connection.close()


def _connected(kind: str, place: Place) -> socket.socket | None:
    """A new connection of a crowd; None: it was not let in."""
    connection = socket.socket(socket.AF_INET if kind == "half_sent" else socket.AF_UNIX)
    try:
        connection.settimeout(PATIENCE_S)
        connection.connect(("127.0.0.1", place.port) if kind == "half_sent" else place.socket)
        if kind == "half_sent":
            connection.sendall(b"POST /api/stop HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Le")
        elif kind == "subscribers":
            connection.sendall(b'{"jsonrpc":"2.0","id":1,"method":"subscribe"}\n')
    except OSError:
        connection.close()
        return None
    connection.setblocking(False)
    return connection


class Stalled:
    """Subscribers that never read, and connect again when they are cut."""

    def __init__(self, path: Path, count: int) -> None:
        self.connections = self.cuts = 0
        self._path, self._count = path, count
        self._ending = threading.Event()
        self._thread = threading.Thread(target=self._keep_up, daemon=True)

    def __enter__(self) -> Stalled:
        self._sockets = [self._connect() for _ in range(self._count)]
        for one in self._sockets:
            one.sendall(b'{"jsonrpc":"2.0","id":1,"method":"status"}\n' * FILLING)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ending.set()
        self._thread.join()
        for one in self._sockets:
            one.close()

    def _connect(self) -> socket.socket:
        connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        connection.connect(str(self._path))
        self.connections += 1
        connection.sendall(b'{"jsonrpc":"2.0","id":0,"method":"subscribe"}\n')
        return connection

    def _keep_up(self) -> None:
        poll = select.poll()
        while not self._ending.wait(0.25):
            for index, connection in enumerate(self._sockets):
                poll.register(connection, 0)
                gone = poll.poll(0)  # only a hang-up is told: nothing is read
                poll.unregister(connection)
                if gone:
                    connection.close()
                    self.cuts += 1
                    self._sockets[index] = self._connect()


def stop_by_ways(place: Place, still: Lock, begin_s: float, end_s: float) -> list[Stopped]:
    """Body of a process: stop again and again, by lane, socket and page in turn, while nobody moves the arm."""
    stops: list[Stopped] = []
    ways = itertools.cycle(
        (("lane", b""), ("socket", b"stop"), ("page", b""), ("lane", b""), ("socket", b"hold"), ("page", b""))
    )
    time.sleep(max(0.0, begin_s - time.monotonic()))
    while time.monotonic() < end_s:
        way, method = next(ways)
        with still:
            connected_s = time.monotonic()
            try:
                done = _STOPS[way](place, method)
            except (OSError, http.client.HTTPException, ValueError):
                done = False
            stops.append(Stopped(way, connected_s, time.monotonic() if done else math.inf))
        time.sleep(STOP_EVERY_S)
    return stops


def stop_typed(place: Place, still: Lock, begin_s: float, end_s: float) -> list[Stopped]:
    """Body of a process: type `armctl stop` again and again."""
    stops: list[Stopped] = []
    script = Path(sys.executable).with_name("armctl")
    relay = Path(place.socket).with_name("relay.sock")
    command = [
        *([str(script)] if script.exists() else [sys.executable, "-m", "armctl"]),
        "stop",
        "--socket",
        str(relay),
    ]
    time.sleep(max(0.0, begin_s - time.monotonic()))
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(f"{relay}.stop")
        listening.listen()
        listening.settimeout(PATIENCE_S)
        while (typed_s := time.monotonic()) < end_s:
            typed = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
            done, connected_s, answered_s = False, math.nan, math.inf
            with contextlib.suppress(OSError):
                caller, _ = listening.accept()
                with caller:
                    caller.settimeout(PATIENCE_S)
                    line = caller.recv(256)
                    with still:
                        connected_s = time.monotonic()
                        answer = _said(f"{place.socket}.stop", line)
                        caller.sendall(answer)
                        done, answered_s = answer.startswith(b"ok "), time.monotonic()
            done = typed.wait(PATIENCE_S) == 0 and done
            whole_s = time.monotonic() - typed_s
            stops.append(Stopped("typed", connected_s, answered_s if done else math.inf, whole_s))
    return stops


def _by_lane(place: Place, _: bytes) -> bool:
    return _said(f"{place.socket}.stop", b"stop\n").startswith(b"ok ")


def _by_socket(place: Place, method: bytes) -> bool:
    return "result" in json.loads(_said(place.socket, b'{"jsonrpc":"2.0","id":1,"method":"%b"}\n' % method))


def _by_page(place: Place, _: bytes) -> bool:
    page = http.client.HTTPConnection("127.0.0.1", place.port, timeout=PATIENCE_S)
    with contextlib.closing(page):
        headers = {"X-Armctl-Token": place.token, "Content-Type": "application/json"}
        page.request("POST", "/api/stop", b"{}", headers)
        answer = page.getresponse()
        return "state" in json.loads(answer.read()) and answer.status == 200


_STOPS = {"lane": _by_lane, "socket": _by_socket, "page": _by_page}


def _said(path: str, line: bytes) -> bytes:
    """The line that answers a line on a fresh connection."""
    with socket.socket(socket.AF_UNIX) as connection:
        connection.settimeout(PATIENCE_S)
        connection.connect(path)
        connection.sendall(line)
        received = b""
        while not received.endswith(b"\n") and (data := connection.recv(1 << 16)):
            received += data
        return received
