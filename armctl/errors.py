"""Every error armctl raises on purpose.

A message says what is wrong, where, the value found, the bound it broke and what to do about it. The exit
status of the command line is a property of the error, so that no caller has to guess it.
"""

from collections.abc import Sequence
from typing import Any, ClassVar


class ArmctlError(Exception):
    """Base of every expected failure; its text is fit for the user's eyes."""

    exit_status: ClassVar[int] = 1

    def __reduce__(self) -> tuple[object, ...]:
        # The default would call the constructor with the finished message.
        return rebuilt, (type(self), str(self), vars(self))


def rebuilt(kind: type[ArmctlError], message: str, fields: dict[str, Any]) -> ArmctlError:
    """The error as it was raised elsewhere: in another process, or behind the daemon's socket."""
    error = kind.__new__(kind, message)
    vars(error).update(fields)
    return error


class ConfigError(ArmctlError):
    """A configuration or calibration file, or an argument, is not acceptable."""

    exit_status = 2

    def __init__(self, file: str, key: str, problem: str, remedy: str = "") -> None:
        self.file, self.key, self.problem, self.remedy = file, key, problem, remedy
        where = f"{file}: {key}" if key else file
        super().__init__(f"{where}: {problem}" + (f"; {remedy}" if remedy else ""))


class NoDaemon(ArmctlError):
    """Nobody answers on the daemon's socket."""

    exit_status = 3


class NoWayIn(NoDaemon):
    """The daemon's socket cannot be opened: it is somebody else's, or there can be none."""


class BusError(ArmctlError):
    """The serial port or the bus behind it failed; `code` is the fault code of the matrix."""

    def __init__(self, code: str, message: str, servo_id: int | None = None) -> None:
        self.code, self.servo_id = code, servo_id
        super().__init__(message)


class PortError(BusError):
    """The port itself failed; each way to fail is a class with its own fault code."""

    port_code: ClassVar[str]

    def __init__(self, message: str) -> None:
        super().__init__(self.port_code, message)


class PortMissing(PortError):
    """The port does not exist or is no serial port."""

    port_code = "PORT_MISSING"


class PortBusy(PortError):
    """Another process holds the port."""

    port_code = "PORT_BUSY"


class PortGone(PortError):
    """The port vanished while in use (unplugged)."""

    port_code = "PORT_GONE"


class RequestRefused(ArmctlError):
    """The daemon (or a pre-flight) refused a request; `reasons` is the whole list."""

    def __init__(self, code: str, reasons: str | Sequence[str]) -> None:
        self.code = code
        self.reasons = (reasons,) if isinstance(reasons, str) else tuple(reasons)
        super().__init__("; ".join(self.reasons))


class IllegalTransition(RequestRefused):
    """The request is not possible in the present state."""

    def __init__(self, reason: str) -> None:
        super().__init__("ILLEGAL_TRANSITION", reason)


class UnreachableTarget(RequestRefused):
    """No joint configuration within the limits puts the tool there."""

    def __init__(self, message: str, least_error_m: float) -> None:
        self.least_error_m = least_error_m
        super().__init__("UNREACHABLE", message)


class LogError(ArmctlError):
    """A log, recording or plan file cannot be read or written."""
