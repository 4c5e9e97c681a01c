"""Single keys of a terminal, without waiting for Enter, and whether there is a person who can be asked.

A shell with job control stops a process in the background that reads the terminal or sets its mode. So both happen in
the foreground only, and this is asked anew each time: the process may be suspended, or change places, at any time.
"""

import os
import select
import termios
import time
import tty
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from typing import Any, TextIO

_ARROWS = {b"D": "left", b"C": "right", b"A": "up", b"B": "down"}
_ESCAPES = {begin + letter: name for letter, name in _ARROWS.items() for begin in (b"\x1b[", b"\x1bO")}


def attended(stream: TextIO | None) -> bool:
    """Whether a person can be asked at `stream`: it is a terminal, and this process is in its foreground."""
    return stream is not None and stream.isatty() and _in_foreground(stream.fileno())


def _in_foreground(fd: int) -> bool:
    with suppress(OSError):
        return os.tcgetpgrp(fd) == os.getpgrp()
    return True  # not the terminal that controls this process: there is no job control, and keys may be read


class TerminalKeys:
    """Keys of a terminal that hands them over one by one.

    Args:
        fd: The terminal; None: there is none, and nobody presses anything.
    """

    def __init__(self, fd: int | None) -> None:
        self._fd, self._pressed = fd, b""
        # The terminal's mode before this process set it; None: it has not.
        self.before: list[Any] | None = None

    def wait(self, timeout_s: float) -> str:
        """The next key, arrows by their names; nothing once the time is over, and nothing in the background."""
        if self._fd is None or not _in_foreground(self._fd):
            time.sleep(timeout_s)
            return ""
        mode = termios.tcgetattr(self._fd)
        if mode[3] & termios.ICANON:  # at first, and once a shell that suspended this process has put its own mode back
            self.before = mode
            tty.setcbreak(self._fd, termios.TCSANOW)  # keys come without Enter; it keeps what was pressed meanwhile
        if not self._pressed and select.select([self._fd], [], [], timeout_s)[0]:
            if not _in_foreground(self._fd):  # it was sent to the background while it waited
                return ""
            self._pressed = os.read(self._fd, 64) or b"q"  # a terminal that is gone wants no more
        known = next((sequence for sequence in _ESCAPES if self._pressed.startswith(sequence)), b"")
        key, self._pressed = self._pressed[: len(known) or 1], self._pressed[len(known) or 1 :]
        return _ESCAPES.get(key) or key.decode("ascii", "replace")


@contextmanager
def keys(stream: TextIO | None) -> Iterator[TerminalKeys]:
    """The keys of `stream`, none if it is no terminal; its mode is put back afterwards."""
    pressed = TerminalKeys(stream.fileno() if stream is not None and stream.isatty() else None)
    if stream is not None and attended(stream):
        termios.tcflush(stream, termios.TCIFLUSH)  # what was typed before was not meant for this
    try:
        yield pressed
    finally:
        # In the background the mode is the shell's.
        if pressed.before is not None and stream is not None and attended(stream):
            termios.tcsetattr(stream, termios.TCSADRAIN, pressed.before)
