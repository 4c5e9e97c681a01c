"""A program in a real terminal of 80 columns: keys pressed, words waited for, an interactive shell with job control."""

import contextlib
import fcntl
import os
import pty
import select
import socket
import subprocess
import sys
import termios
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

PATIENCE_S = 60.0
# Where `armctl` is the one that is tested.
PATH = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
CTRL_C, CTRL_Z = b"\x03", b"\x1a"


def free_port() -> int:
    """A port of the loopback interface that nobody has."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Terminal:
    """What runs in a terminal, and everything it said."""

    process: subprocess.Popen[bytes]
    fd: int
    said: str = field(default="")

    def until(self, words: str, since: int = 0) -> int:
        """Read until the words have come; returns how much was said up to their end."""
        deadline_s = time.monotonic() + PATIENCE_S
        while words not in self.said[since:]:
            assert time.monotonic() < deadline_s, self.said
            if not self._read():
                assert words in self.said[since:], self.said
        return self.said.index(words, since) + len(words)

    def press(self, keys: bytes) -> None:
        os.write(self.fd, keys)

    def status(self) -> int:
        """Exit status, once it has ended."""
        while self._read():
            pass
        return self.process.wait(PATIENCE_S)

    @property
    def line_by_line(self) -> bool:
        """Whether the terminal hands over whole lines, as it does for a program that never set its mode."""
        return bool(termios.tcgetattr(self.fd)[3] & termios.ICANON)

    def _read(self) -> bool:
        if select.select([self.fd], [], [], PATIENCE_S)[0]:
            with contextlib.suppress(OSError):  # the terminal's other end is closed
                if data := os.read(self.fd, 1 << 16):
                    self.said += data.decode(errors="replace")
                    return True
        return False


class Shell(Terminal):
    """An interactive bash with job control, as a person has it."""

    typed = 0

    def type(self, line: str) -> str:
        """Type a line; what was said until the shell waits for the next one.

        Raises:
            AssertionError: the line's exit status is not 0.
        """
        since = self.start(line)
        self.until("]$ ", since)
        said = self.said[since:]
        assert said.endswith(f"[{self.typed + 1} 0]$ "), self.said
        return said

    def start(self, line: str) -> int:
        """Type a line, and do not wait for its end; returns how much had been said before."""
        since = len(self.said)
        self.press(line.encode() + b"\n")
        self.typed += 1
        return since


@contextlib.contextmanager
def terminal(*command: str) -> Iterator[Terminal]:
    """The command in a terminal of its own."""
    with _opened(command, {}) as (process, fd):
        yield Terminal(process, fd)


@contextlib.contextmanager
def shell(folder: Path) -> Iterator[Shell]:
    """An interactive bash in a folder. Its prompt tells the next command's number, and the last one's status."""
    plain = {"PS1": r"[\# $?]$ ", "TERM": "dumb", "HISTFILE": "", "COLUMNS": "80", "PATH": PATH}
    with _opened(("bash", "--norc", "--noediting", "-i"), plain, folder) as (process, fd):
        started = Shell(process, fd)
        started.until("[1 0]$ ")
        yield started


@contextlib.contextmanager
def _opened(
    command: tuple[str, ...], environment: dict[str, str], folder: Path | None = None
) -> Iterator[tuple[subprocess.Popen[bytes], int]]:
    master, slave = pty.openpty()
    os.set_blocking(slave, True)
    process = subprocess.Popen(
        command, stdin=slave, stdout=slave, stderr=slave, start_new_session=True, preexec_fn=_own_terminal,
        env={**os.environ, **environment}, cwd=folder,
    )  # fmt: skip
    os.close(slave)
    try:
        yield process, master
    finally:
        os.close(master)  # hangs up: the kernel ends what a shell left running
        process.kill()
        process.wait()


def _own_terminal() -> None:
    """Make standard input the controlling terminal, whose Ctrl-C is a signal."""
    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    fcntl.ioctl(0, termios.TIOCSWINSZ, b"\x1e\x00\x50\x00\x00\x00\x00\x00")
