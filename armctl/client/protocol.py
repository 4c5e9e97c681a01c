"""The client's end of the daemon's socket without I/O: lines to send, and what lines that come mean.

A line is one JSON object. One with `method` is a notification; every other one is the answer to the request whose `id`
it carries, and holds its `result` or its `error`.
"""

import json
import os
import socket as sockets
import time
from collections.abc import Iterable
from contextlib import suppress
from operator import methodcaller
from pathlib import Path
from typing import Any, cast
from weakref import WeakSet

from armctl import errors
from armctl.errors import ArmctlError, NoDaemon, NoWayIn, RequestRefused, rebuilt
from armctl.files import socket_path

MAX_WAITING_NOTIFICATIONS = 64
# The daemon closes a connection that asks for more in a line, and stops what moves by it.
MOST_BYTES = 65536
# Every connection of this process. A child that was forked gives up its copies: they would keep what its parent began
# going after the parent's end.
CONNECTIONS = WeakSet[sockets.socket]()
os.register_at_fork(after_in_child=lambda: list(map(sockets.socket.close, CONNECTIONS)))

Message = dict[str, Any]
# Method and parameters.
Notification = tuple[str, Message]
# The same of several requests, one after the other.
Requests = Iterable[tuple[str, Message]]


class Protocol:
    """What one connection has asked so far.

    Args:
        socket: The daemon's; None: `ARMCTL_SOCKET`, else the usual place.
    """

    def __init__(self, socket: str | Path | None = None) -> None:
        self.socket_file = socket_path(None if socket is None else str(socket))
        self._last_id = 0

    def request(self, method: str, params: Message, person: str = "") -> bytes:
        """The line of a new request, whose id is `_last_id` from then on; numbers may stand in arrays of numpy.

        Raises:
            RequestRefused: code LIMIT, a parameter is not a finite number; code TOO_LARGE, the line is too long.
        """
        self._last_id += 1
        request = {"jsonrpc": "2.0", "id": self._last_id, "method": method, "params": params}
        request |= {"person": person} if person else {}
        try:
            line = json.dumps(request, separators=(",", ":"), allow_nan=False, default=methodcaller("tolist"))
        except ValueError as error:
            raise RequestRefused("LIMIT", f"{method}: a parameter is not a finite number ({error})") from None
        if len(data := line.encode()) > MOST_BYTES:
            raise RequestRefused("TOO_LARGE", f"{method}: {len(data)} bytes, at most {MOST_BYTES}; make two of it")
        return data + b"\n"

    def no_daemon(self, why: str | OSError) -> NoDaemon:
        """The error for a daemon that is not there, or no longer, or whose socket cannot be opened."""
        told = str(getattr(why, "strerror", None) or why)
        if isinstance(why, PermissionError):
            return NoWayIn(f"a daemon may run, but you may not open its socket: {_entrance(self.socket_file)}")
        if told.endswith("path too long"):
            return NoWayIn(f"no socket can be at {self.socket_file}: {told}; name a shorter one with --socket")
        return NoDaemon(f"no daemon answers on {self.socket_file}: {told}; start it with `armctl daemon --port PORT`")

    @staticmethod
    def notification(message: Message) -> Notification | None:
        """What the daemon says by itself; None: the message is an answer."""
        return (message["method"], message["params"]) if "method" in message else None

    @staticmethod
    def result(answer: Message) -> Message:
        """The result in an answer.

        Raises:
            ArmctlError: the error in it, as it was raised in the daemon.
        """
        if "error" in answer:
            raise error_of(answer["error"])
        return cast(Message, answer["result"])


def _entrance(path: Path) -> str:
    """Whose a socket is, or the first folder above it that can be seen; and how one is let in."""
    place = next(filter(os.path.exists, (path, *path.parents)))
    about = place.stat()
    user, group = str(about.st_uid), str(about.st_gid)
    with suppress(KeyError):  # who has no name
        user, group = place.owner(), place.group()
    lets_group_in = about.st_gid and about.st_mode & (0o010 if place.is_dir() else 0o020)
    joining = f"join the group (`sudo usermod -aG {group} $USER`, then log in anew), or " if lets_group_in else ""
    return f"{place} is of user {user} and group {group}; {joining}ask {user}"


def heartbeats(seconds: float, **velocity: object) -> Requests:
    """What jogs the arm for so long, each asked when the one before is answered, and then stops it."""
    end_s = time.monotonic() + seconds
    yield "jog", {**velocity, "begin": True}
    while time.monotonic() < end_s:
        yield "jog", velocity  # answered by the next tick: the loop needs no clock of its own
    yield "stop", {}


def error_of(answer: Message) -> ArmctlError:
    """The error the daemon met, as it was raised there."""
    data = answer["data"]
    kind = getattr(errors, data["type"], None)
    if not (isinstance(kind, type) and issubclass(kind, ArmctlError)):
        return RequestRefused(data["code"], data["reasons"])
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in data["fields"].items()}
    return rebuilt(kind, answer["message"], fields)
