"""What a process says to the service manager that started it (sd_notify)."""

import contextlib
import os
import socket


def notify(state: str) -> None:
    """Send one state, such as `READY=1`; nothing where no service manager listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, contextlib.suppress(OSError):
        sender.sendto(state.encode(), socket.MSG_DONTWAIT, address)
