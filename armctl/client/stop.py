"""`armctl stop` without anything that takes time to import: straight to the control process, whatever the host does."""

import socket
import sys
import time
from collections.abc import Sequence
from pathlib import Path

from armctl.files import socket_path, stop_path

# Longest wait for an answer: a control process that hangs is replaced within a second.
PATIENCE_S = 5.0
AGAIN_S = 0.02
# For what the host says of a stop that is done and has met a fault.
HOST_S = 1.0


def stop(path: Path) -> str | None:
    """Stop the arm whose daemon listens at `path`; returns its state once it is still, None: nobody serves the lane.

    Raises:
        TimeoutError: somebody listens there, and nobody answers.
    """
    give_up_s = time.monotonic() + PATIENCE_S
    while (left_s := give_up_s - time.monotonic()) > 0.0:
        with socket.socket(socket.AF_UNIX) as lane:
            lane.settimeout(left_s)
            try:
                lane.connect(str(stop_path(path)))
                lane.sendall(b"stop\n")
                answer = lane.recv(256).decode()
            except (FileNotFoundError, ConnectionRefusedError, PermissionError):
                return None
            except (ConnectionError, BlockingIOError):  # it died just now, or too many wait to be let in
                answer = ""
        if answer.startswith("ok "):
            return answer[3:].strip()
        # Whoever comes next listens on the same socket.
        time.sleep(AGAIN_S)
    raise TimeoutError(f"no answer in {PATIENCE_S:g} s")


def typed(arguments: Sequence[str]) -> int | None:
    """Carry out `armctl stop [--json] [--socket PATH]`; None: it is another command, or not to be had this way."""
    if list(arguments[:1]) != ["stop"]:
        return None
    rest, json, chosen = list(arguments[1:]), False, None
    while rest:
        match rest.pop(0).partition("="):
            case "--json", "", "":
                json = True
            case "--socket", "", "" if rest:
                chosen = rest.pop(0)
            case "--socket", "=", path:
                chosen = path
            case _:
                return None
    try:
        state = stop(socket_path(chosen))
    except OSError:  # a TimeoutError is one
        return None
    if state is None:
        return None
    if state == "faulted":
        from contextlib import suppress

        from armctl.client import Client
        from armctl.errors import ArmctlError

        with suppress(ArmctlError), Client(socket_path(chosen), timeout_s=HOST_S) as host:
            if "unreached" in host.call("stop"):
                return None  # the command line says why
    sys.stdout.write(f'{{"state": "{state}"}}\n' if json else f"{state}\n")
    return 0
