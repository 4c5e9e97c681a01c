"""STOP's own way to the control process: a socket that needs neither the host nor a parser.

Rules.
1. One line is one request, `stop`. One line answers it, `ok STATE` once the arm is still, and the connection closes.
2. A user has `PLACES` places; one more takes that user's oldest, so that nobody can fill the lane for others.
3. Who has sent no line after `IDLE_S`, or more than `MAX_LINE` bytes, is sent away.
4. The host makes the socket and keeps it: requests that come while no control process runs wait for the next one.
"""

import contextlib
import os
import socket
import struct
from dataclasses import dataclass

from armctl.clock import NS_PER_S, Clock

# A reply with this id is for this lane; the host's own ids begin with 1.
REQUEST_ID = -1
PLACES = 8
# All users together.
ALL_PLACES = 512
# How many are let in at one look.
ACCEPTED = 32
MAX_LINE = 256
IDLE_S = 1.0
_CREDENTIALS = struct.Struct("3i")


@dataclass(eq=False, slots=True)
class _Caller:
    """Somebody who has connected."""

    socket: socket.socket
    uid: int
    pid: int
    since_ns: int
    received: bytes = b""
    asked: bool = False


class StopLane:
    """The callers of one listening socket."""

    def __init__(self, listening: socket.socket, clock: Clock) -> None:
        listening.setblocking(False)
        self._listening, self._clock = listening, clock
        # Oldest first.
        self._callers: list[_Caller] = []
        # A signal asks through a pipe, so that a wait ends at once.
        self._read_end, self._write_end = os.pipe2(os.O_NONBLOCK | os.O_CLOEXEC)

    def close(self) -> None:
        """Leave; the listening socket stays the host's."""
        for caller in list(self._callers):
            self._close(caller)
        self._listening.close()
        os.close(self._read_end)
        os.close(self._write_end)

    def ends(self) -> list[int | socket.socket]:
        """What to wait for: whatever is readable is for `receive`."""
        return [self._listening, self._read_end, *(caller.socket for caller in self._callers if not caller.asked)]

    def signal(self) -> None:
        """Ask for a stop; for a signal handler."""
        with contextlib.suppress(BlockingIOError):  # it is full of them
            os.write(self._write_end, b"!")

    def receive(self) -> list[str]:
        """Take in what has come; who has asked for a stop."""
        askers: list[str] = []
        with contextlib.suppress(BlockingIOError):  # there was no signal
            os.read(self._read_end, 64)
            askers.append("a signal")
        for caller in [caller for caller in self._callers if not caller.asked]:
            askers += self._hear(caller)
        for _ in range(ACCEPTED):
            try:
                connection, _address = self._listening.accept()
            except OSError:
                break
            # At once: who has said it already loses its place to nobody.
            askers += self._hear(self._take_in(connection))
        return askers

    def answer(self, text: str) -> None:
        """Tell everybody who has asked what became of it."""
        for caller in [caller for caller in self._callers if caller.asked]:
            with contextlib.suppress(OSError):  # gone meanwhile
                caller.socket.send(text.encode() + b"\n")
            self._close(caller)

    def _take_in(self, connection: socket.socket) -> _Caller:
        connection.setblocking(False)
        pid, uid = credentials(connection)
        same = [caller for caller in self._callers if caller.uid == uid]
        if len(same) >= PLACES:
            self._close(next((caller for caller in same if not caller.asked), same[0]))
        if len(self._callers) >= ALL_PLACES:
            self._close(self._callers[0])
        self._callers.append(caller := _Caller(connection, uid, pid, self._clock.now_ns()))
        return caller

    def _hear(self, caller: _Caller) -> list[str]:
        """Who asks for a stop, if this caller does; one that says something else, or nothing for long, is sent away."""
        line = self._line(caller)
        if line is not None and line.strip() == b"stop":
            caller.asked = True
            return [f"uid {caller.uid}, pid {caller.pid}"]
        if line is not None or self._clock.now_ns() - caller.since_ns > IDLE_S * NS_PER_S:
            self._close(caller)
        return []

    def _line(self, caller: _Caller) -> bytes | None:
        """The line of a caller, empty if it has hung up or says too much; None: it is not yet complete."""
        try:
            data = caller.socket.recv(MAX_LINE + 1)
        except BlockingIOError:
            return None
        except OSError:
            data = b""
        caller.received += data
        line, end, _ = caller.received.partition(b"\n")
        return line if end else None if data and len(caller.received) <= MAX_LINE else b""

    def _close(self, caller: _Caller) -> None:
        self._callers.remove(caller)
        caller.socket.close()


def credentials(peer: socket.socket) -> tuple[int, int]:
    """Process and user at the other end."""
    pid, uid, _ = _CREDENTIALS.unpack(peer.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size))
    return pid, uid
