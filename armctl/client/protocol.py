"""The client's end of the daemon's socket without I/O: lines to send, and what lines that come mean.

A line is one JSON object. One with `method` is a notification; every other one is the answer to the request whose `id`
it carries, and holds its `result` or its `error`.
"""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, Generic, TypeVar

from armctl import errors
from armctl.errors import ArmctlError, NoDaemon, RequestRefused, rebuilt
from armctl.files import socket_path

MAX_WAITING_NOTIFICATIONS = 64

Message = dict[str, Any]
# What a call gives: the answer, or what has to be awaited for it.
Answer = TypeVar("Answer")
# Method and parameters.
Notification = tuple[str, Message]


class Protocol(Generic[Answer]):
    """What one connection has asked so far, and the motions that can be asked for by name.

    Args:
        path: The daemon's socket; None: `ARMCTL_SOCKET`, else the usual place.
    """

    def __init__(self, path: str | Path | None = None) -> None:
        self.socket_file = socket_path(None if path is None else str(path))
        self._last_id = 0

    def request(self, method: str, params: Message, person: str = "") -> bytes:
        """The line of a new request, whose id is `_last_id` from then on.

        Raises:
            RequestRefused: code LIMIT, a parameter is not a finite number.
        """
        self._last_id += 1
        request = {"jsonrpc": "2.0", "id": self._last_id, "method": method, "params": params} | (
            {"person": person} if person else {}
        )
        try:
            return json.dumps(request, separators=(",", ":"), allow_nan=False).encode() + b"\n"
        except ValueError as error:
            raise RequestRefused("LIMIT", f"{method}: a parameter is not a finite number ({error})") from None

    def call(self, method: str, **params: Any) -> Answer:
        """The result of a method, or what has to be awaited for it."""
        raise NotImplementedError

    def play(self, name: str, *, rate: float = 1.0, repeat: int = 1) -> Answer:
        """Move as a take or a run was taught.

        Args:
            name: Of the recording.
            rate: Taught seconds a second, 0.1 to 2.
            repeat: How often.
        Raises:
            ArmctlError: there is none of that name, or the motion was refused (every reason), or stopped on the way.
        """
        return self.call("play", name=name, rate=rate, repeat=repeat)

    def path(
        self,
        points_m: Sequence[Sequence[float]],
        *,
        kinds: Sequence[str] = (),
        duration_s: float | None = None,
        tolerance_mm: float = 2.0,
    ) -> Answer:
        """Lead the tool along points [m], each reached by a `line`, or by an `arc` that goes `through` another.

        Args:
            kinds: How each point is reached; empty: by lines.
            duration_s: None: about 30 mm/s.
            tolerance_mm: How far a corner may be cut.
        Raises:
            ArmctlError: the path was refused (every reason), or stopped on the way.
        """
        return self.call("path", points_m=points_m, kinds=kinds, duration_s=duration_s, tolerance_mm=tolerance_mm)

    def no_daemon(self, why: str | OSError) -> NoDaemon:
        """The error for a daemon that is not there, or no longer."""
        if isinstance(why, OSError):
            why = why.strerror or str(why)
        return NoDaemon(f"no daemon answers on {self.socket_file}: {why}; start it with `armctl daemon --port PORT`")

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
        found: Message = answer["result"]
        return found


def error_of(answer: Message) -> ArmctlError:
    """The error the daemon met, as it was raised there."""
    data = answer["data"]
    kind = getattr(errors, data["type"], None)
    if not (isinstance(kind, type) and issubclass(kind, ArmctlError)):
        return RequestRefused(data["code"], data["reasons"])
    fields = {key: tuple(value) if isinstance(value, list) else value for key, value in data["fields"].items()}
    return rebuilt(kind, answer["message"], fields)
