"""The other end of the daemon's socket, for programs that wait for their answers.

    with Client() as client:
        print(client.call("status")["state"])
        for snapshot in client.subscribe():
            ...

What fails in the daemon is raised here as the same error. One connection is one client: it holds the lease of a
`run` or of teaching, and closing it ends both.
"""

import json
import select
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, Self, cast

from armctl.client.protocol import CONNECTIONS, MAX_WAITING_NOTIFICATIONS, Message, Notification, Protocol


class Client(Protocol):
    """One connection to the daemon."""

    def __init__(self, socket: str | Path | None = None, *, timeout_s: float | None = None) -> None:
        """Connect.

        Args:
            socket: The daemon's; None: `ARMCTL_SOCKET`, else the usual place.
            timeout_s: Longest wait for anything from the daemon; None: as long as it takes (a `run` takes long).
        Raises:
            NoDaemon: nobody answers there.
        """
        super().__init__(socket)
        self._timeout_s = timeout_s
        self._received = bytearray()
        self._notifications: deque[Notification] = deque(maxlen=MAX_WAITING_NOTIFICATIONS)
        self._connect()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    def call(self, method: str, *, on_progress: Callable[[Message], None] | None = None, **params: Any) -> Message:
        """The result of a method.

        Args:
            on_progress: Called with each `progress` notification that comes before the answer.
        Raises:
            ArmctlError: whatever the daemon answered.
            NoDaemon: it is gone, or does not answer in time.
        """
        if not self._last_id and select.select([self._socket], [], [], 0.0)[0]:
            self.close()  # the daemon keeps no connection that asks nothing for long
            self._connect()
        line = self.request(method, params)
        try:
            self._socket.sendall(line)
        except OSError as error:
            raise self.no_daemon(error) from None
        while True:
            message = self._receive()
            if (told := self.notification(message)) is None:
                # Another id is the late answer to a call that was interrupted; none is that of the whole connection.
                if message["id"] in (self._last_id, None):
                    return self.result(message)
            elif told[0] == "progress" and on_progress is not None:
                on_progress(told[1])
            else:
                self._notifications.append(told)

    def subscribe(self) -> Iterator[Message]:
        """Snapshots as they come, one a tick; `gap` counts those lost just before each one."""
        self.call("subscribe")
        return (params for method, params in self.notifications() if method == "snapshot")

    def notifications(self) -> Iterator[Notification]:
        """Everything the daemon says by itself: (method, params)."""
        while True:
            while self._notifications:
                yield self._notifications.popleft()
            if (told := self.notification(self._receive())) is not None:
                yield told

    def _connect(self) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(self._timeout_s)
        try:
            self._socket.connect(str(self.socket_file))
        except OSError as error:
            self._socket.close()
            raise self.no_daemon(error) from None
        CONNECTIONS.add(self._socket)

    def _receive(self) -> Message:
        while (end := self._received.find(b"\n")) < 0:
            try:
                data = self._socket.recv(1 << 16)
            except TimeoutError:
                raise self.no_daemon(f"no answer in {self._timeout_s:g} s") from None
            except OSError as error:
                raise self.no_daemon(error) from None
            if not data:
                raise self.no_daemon("it closed the connection")
            self._received += data
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        return cast(Message, json.loads(line))
