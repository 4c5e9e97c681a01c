"""A terminal, or what stands in its place: how wide it is, what it can show, and what is drawn again and again."""

import os
import sys
import time
from collections.abc import Sequence
from contextlib import suppress
from textwrap import wrap
from typing import Any, TextIO

import click

# What bars, marks and rules are made of where there are few letters.
PLAIN = str.maketrans("━╌●─", "#-o-")
# Between two lines that stand in one place, seconds: a terminal takes longer to draw them than most work to go on.
REDRAWN_S = 0.05


class Screen:
    """Where a command's answer goes, or everything else.

    Args:
        error: It is stderr, whatever that is at the moment; else stdout.
        file: It is this one.
        columns: How wide it is; None: as the terminal says.
    """

    def __init__(self, *, error: bool = False, file: TextIO | None = None, columns: int | None = None) -> None:
        self._error, self._file, self._columns = error, file, columns
        # Whether a line stands at the end of the terminal, since when, and how many lines the picture there has.
        self._stands, self._stood_s, self._drawn = False, 0.0, 0

    @property
    def file(self) -> TextIO:
        return self._file or (sys.stderr if self._error else sys.stdout)

    @property
    def is_terminal(self) -> bool:
        """Whether lines can be drawn again in their place: it is a terminal, and no dumb one."""
        return self.file.isatty() and os.environ.get("TERM") != "dumb"

    @property
    def width(self) -> int:
        """Characters of a line; a person's `COLUMNS` goes before what the terminal says."""
        wanted = os.environ.get("COLUMNS", "")
        return self._columns or int(wanted if wanted.isdecimal() else 0) or self._size().columns or 80

    def _size(self) -> os.terminal_size:
        with suppress(OSError):  # io.UnsupportedOperation is one
            return os.get_terminal_size(self.file.fileno())
        return os.terminal_size((0, 0))

    def styled(self, text: str, **style: Any) -> str:
        """The text as `click.style` makes it, where there are colours and nobody wants none (`NO_COLOR`)."""
        return click.style(text, **style) if text and self.is_terminal and "NO_COLOR" not in os.environ else text

    def wrapped(self, text: str, **style: Any) -> list[str]:
        """Its lines, each within the width."""
        return [self.styled(part, **style) for line in text.splitlines() for part in wrap(line, self.width) or [""]]

    def print(self, *lines: str) -> None:
        """Show lines, in the place of what stands there; what the terminal has no letter for is a question mark.

        On stderr, a line that another program left standing there goes too.
        """
        begin, self._stands = "\r\x1b[K" * (self._stands or (self._error and self.is_terminal)), False
        self._write(begin + "".join(f"{line}\n" for line in lines))

    def stand(self, text: str) -> None:
        """Let a line stand at a terminal's end until anything else is shown; one that comes too soon is left out."""
        if self.is_terminal and (now_s := time.monotonic()) - self._stood_s >= REDRAWN_S:
            self._stands, self._stood_s = True, now_s
            self._write(f"\r\x1b[K{text[: self.width]}")

    def draw(self, picture: Sequence[str]) -> None:
        """Show a picture in the place of the one before; what is higher than the terminal is left out."""
        shown = picture[: (self._size().lines or sys.maxsize) - 1]  # a file has no end, some terminals say 0
        begin = f"\x1b[{self._drawn}F" if self._drawn else ""
        self._write(begin + "".join(f"{line}\x1b[K\n" for line in shown) + "\x1b[J")
        self._drawn = len(shown)

    def _write(self, text: str) -> None:
        coding = self.file.encoding or "utf-8"
        if not coding.lower().startswith("utf"):
            text = text.translate(PLAIN).encode(coding, "replace").decode(coding)
        self.file.write(text)
        self.file.flush()


def filled(share: float, columns: int) -> str:
    """A bar of so many characters, filled from the left."""
    done = round(min(max(share, 0.0), 1.0) * columns)
    return "━" * done + "╌" * (columns - done)
