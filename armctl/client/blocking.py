"""The other end of the daemon's socket, for programs that wait for their answers.

    with Client() as client:
        print(client.call("status")["state"])
        for snapshot in client.subscribe():
            ...

What fails in the daemon is raised here as the same error. One connection is one client: it holds the lease of a
`run` or of teaching, and closing it ends both.
"""

from __future__ import annotations

import json
import socket
from collections import deque
from collections.abc import Callable, Iterator
from pathlib import Path
from types import TracebackType
from typing import Any

from armctl import errors
from armctl.errors import ArmctlError, NoDaemon, RequestRefused, rebuilt
from armctl.files import socket_path

MAX_WAITING_NOTIFICATIONS = 64

Notification = tuple[str, dict[str, Any]]


class Client:
    """One connection to the daemon."""

    def __init__(self, path: str | Path | None = None, *, timeout_s: float | None = None) -> None:
        """Connect.

        Args:
            path: The daemon's socket; None: `ARMCTL_SOCKET`, else the usual place.
            timeout_s: Longest wait for anything from the daemon; None: as long as it takes (a `run` takes long).
        Raises:
            NoDaemon: nobody answers there.
        """
        self.path = socket_path(None if path is None else str(path))
        self._timeout_s = timeout_s
        self._received = bytearray()
        self._notifications: deque[Notification] = deque(maxlen=MAX_WAITING_NOTIFICATIONS)
        self._last_id = 0
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._socket.settimeout(timeout_s)
        try:
            self._socket.connect(str(self.path))
        except OSError as error:
            self._socket.close()
            raise self._no_daemon(error.strerror or str(error)) from None

    def __enter__(self) -> Client:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        self._socket.close()

    def call(
        self, method: str, *, on_progress: Callable[[dict[str, Any]], None] | None = None, **params: Any
    ) -> dict[str, Any]:
        """The result of a method.

        Args:
            on_progress: Called with each `progress` notification that comes before the answer.
        Raises:
            ArmctlError: whatever the daemon answered.
            NoDaemon: it is gone, or does not answer in time.
        """
        self._last_id += 1
        request = {"jsonrpc": "2.0", "id": self._last_id, "method": method, "params": params}
        try:
            line = json.dumps(request, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        except ValueError as error:
            raise RequestRefused("LIMIT", f"{method}: a parameter is not a finite number ({error})") from None
        try:
            self._socket.sendall(line)
        except OSError as error:
            raise self._no_daemon(error.strerror or str(error)) from None
        while True:
            message = self._receive()
            if "method" in message:
                if message["method"] == "progress" and on_progress is not None:
                    on_progress(message["params"])
                else:
                    self._notifications.append((message["method"], message["params"]))
            elif message["id"] in (self._last_id, None):  # not the late answer to a call that was interrupted
                if "error" in message:
                    raise error_of(message["error"])
                result: dict[str, Any] = message["result"]
                return result

    def subscribe(self) -> Iterator[dict[str, Any]]:
        """Snapshots as they come, one a tick; `gap` counts those lost just before each one."""
        self.call("subscribe")
        return (params for method, params in self.notifications() if method == "snapshot")

    def notifications(self) -> Iterator[Notification]:
        """Everything the daemon says by itself: (method, params)."""
        while True:
            while self._notifications:
                yield self._notifications.popleft()
            message = self._receive()
            if "method" in message:
                yield message["method"], message["params"]

    def _receive(self) -> dict[str, Any]:
        while (end := self._received.find(b"\n")) < 0:
            try:
                data = self._socket.recv(1 << 16)
            except TimeoutError:
                raise self._no_daemon(f"no answer in {self._timeout_s:g} s") from None
            except OSError as error:
                raise self._no_daemon(error.strerror or str(error)) from None
            if not data:
                raise self._no_daemon("it closed the connection")
            self._received += data
        line = bytes(self._received[:end])
        del self._received[: end + 1]
        message: dict[str, Any] = json.loads(line)
        return message

    def _no_daemon(self, why: str) -> NoDaemon:
        return NoDaemon(f"no daemon answers on {self.path}: {why}; start it with `armctl daemon --port PORT`")


def error_of(answer: dict[str, Any]) -> ArmctlError:
    """The error the daemon met, as it was raised there."""
    data = answer["data"]
    kind = getattr(errors, data["type"], None)
    if not (isinstance(kind, type) and issubclass(kind, ArmctlError)):
        return RequestRefused(data["code"], data["reasons"])
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in data["fields"].items()}
    return rebuilt(kind, answer["message"], fields)
