"""The one connection between the control process and the host.

Each message is one pickled object in one SOCK_SEQPACKET datagram: whole or not at all, in order, and never
blocking. Both ends are armctl's own processes; nothing foreign is ever unpickled. A host that does not read
costs the control process nothing but dropped records, which are counted.
"""

from __future__ import annotations

import mmap
import pickle
import socket
from typing import NamedTuple

from armctl.errors import BusError

_MAX_MESSAGE = 4 * 2**20


class LinkClosed(Exception):
    """The other process is gone."""


class Ready(NamedTuple):
    """The control process owns the port and ticks from now on."""

    pid: int


class StartFailed(NamedTuple):
    """The control process could not take the port, and has ended."""

    error: BusError


class StopAsked(NamedTuple):
    """Somebody asked for a stop on its own lane."""

    who: str


def heartbeat(descriptor: int) -> memoryview:
    """The one number in a file of 8 bytes: when the host was last there [ns, monotonic], 0 before it ever was.

    A host that hangs does not close its end. To say that it is there wakes nobody, since both processes have the file
    in their memory.
    """
    return memoryview(mmap.mmap(descriptor, 8)).cast("q")


class Link:
    """One end of the connection."""

    def __init__(self, sock: socket.socket) -> None:
        sock.setblocking(False)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _MAX_MESSAGE)
        self._socket = sock

    @classmethod
    def pair(cls) -> tuple[Link, socket.socket]:
        """A link and the raw socket for the other process to make its link of."""
        ours, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return cls(ours), theirs

    def fileno(self) -> int:
        return self._socket.fileno()

    def send(self, message: object) -> bool:
        """Whether the kernel took the message; False when the other side does not keep up or is gone."""
        try:
            self._socket.send(pickle.dumps(message, protocol=5))
        except OSError:
            return False
        return True

    def receive(self) -> list[object]:
        """Everything that waits.

        Raises:
            LinkClosed: nothing waits and the other side has closed.
        """
        messages: list[object] = []
        reset = False
        while True:
            try:
                data = self._socket.recv(_MAX_MESSAGE)
            except BlockingIOError:
                return messages
            except ConnectionError:
                # Told once where the other side left something unread; its last words come behind it.
                if not reset:
                    reset = True
                    continue
                data = b""
            if not data:
                if messages:
                    return messages
                raise LinkClosed
            messages.append(pickle.loads(data))

    def close(self) -> None:
        self._socket.close()
