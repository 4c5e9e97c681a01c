"""Single keys of a terminal, without waiting for Enter."""

from __future__ import annotations

import os
import select
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TextIO

_ESCAPES = {b"\x1b[D": "left", b"\x1b[C": "right", b"\x1bOD": "left", b"\x1bOC": "right"}


class TerminalKeys:
    """Keys of a terminal that hands them over one by one."""

    def __init__(self, fd: int) -> None:
        self._fd = fd
        self._pressed = b""

    def wait(self, timeout_s: float) -> str:
        """The next key, `left` and `right` by name; nothing once the time is over."""
        if not self._pressed and select.select([self._fd], [], [], timeout_s)[0]:
            self._pressed = os.read(self._fd, 64) or b"q"  # a terminal that is gone wants no more
        known = next((sequence for sequence in _ESCAPES if self._pressed.startswith(sequence)), b"")
        key, self._pressed = self._pressed[: len(known) or 1], self._pressed[len(known) or 1 :]
        return _ESCAPES.get(key) or key.decode("ascii", "replace")


class NoKeys:
    """Nobody presses anything."""

    def wait(self, timeout_s: float) -> str:
        """Nothing, once the time is over."""
        time.sleep(timeout_s)
        return ""


@contextmanager
def keys(stream: TextIO) -> Iterator[TerminalKeys | NoKeys]:
    """The keys of `stream` if it is a terminal; its settings are put back afterwards."""
    if not stream.isatty():
        yield NoKeys()
        return
    fd = stream.fileno()
    before = termios.tcgetattr(fd)
    try:
        tty.setcbreak(fd)
        yield TerminalKeys(fd)
    finally:
        termios.tcsetattr(fd, termios.TCSADRAIN, before)
