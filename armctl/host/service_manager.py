"""What a process says to the service manager that started it (sd_notify)."""

import contextlib
import os
import signal
import socket
import time

LOOK_S = 0.5


def notify(state: str) -> None:
    """Send one state, such as `READY=1`; nothing where no service manager listens."""
    address = os.environ.get("NOTIFY_SOCKET")
    if not address:
        return
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, contextlib.suppress(OSError):
        sender.sendto(state.encode(), socket.MSG_DONTWAIT, address)


def wait_for_port(path: str) -> None:
    """Return once a serial port is there and may be opened; the service manager is told that this process waits for it.

    Nothing is computed meanwhile. It is looked for by its name alone, so that every kind of port is found: one that
    udev names, one of the board, a simulator's.
    """
    waiting = False
    while not os.access(path, os.R_OK | os.W_OK):
        notify("WATCHDOG=1" if waiting else f"READY=1\nSTATUS=waits for {path}: plug the adapter in")
        waiting = True
        time.sleep(LOOK_S)
    if waiting:
        notify("STATUS=")


def endings() -> tuple[signal.Signals, ...]:
    """What ends a server in good order: a closed terminal too, unless it was started to outlive one (nohup)."""
    usual = signal.SIGTERM, signal.SIGINT
    return usual if signal.getsignal(signal.SIGHUP) is signal.SIG_IGN else (*usual, signal.SIGHUP)
