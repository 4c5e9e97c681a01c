"""Commands as a person meets them: in a terminal, with Ctrl-C, on simulated servos."""

from __future__ import annotations

import contextlib
import json
import os
import pty
import re
import select
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from armctl.client import Client
from armctl.lab.demo import program
from proving.rig import hold

pytestmark = pytest.mark.pty
PATIENCE_S = 30.0
COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-7]")
CTRL_C = b"\x03"


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """The socket of a daemon on simulated servos."""
    folder = tmp_path_factory.mktemp("terminal")
    # A shell that starts the tests in the background has them ignore Ctrl-C, and so would every command they start.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    with contextlib.ExitStack() as cleanup:
        cleanup.callback(signal.signal, signal.SIGINT, before)
        patch = cleanup.enter_context(pytest.MonkeyPatch.context())
        for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME"):
            patch.setenv(name, str(folder / name))
        patch.setenv("ARMCTL_SOCKET", str(folder / "daemon.sock"))
        for name in ("NO_COLOR", "FORCE_COLOR", "COLUMNS"):
            patch.delenv(name, raising=False)
        patch.setenv("TERM", "xterm-256color")
        cleanup.enter_context(program(folder / "sim.log", "sim", "--link", str(folder / "servos"), "--seed", "2"))
        cleanup.enter_context(program(folder / "daemon.log", "daemon", "--port", str(folder / "servos")))
        yield folder / "daemon.sock"


@dataclass
class Terminal:
    """A command in a terminal of 80 columns, and everything it said."""

    process: subprocess.Popen[bytes]
    fd: int
    said: str = field(default="")

    def until(self, words: str, since: int = 0) -> None:
        """Read until the words have come."""
        deadline_s = time.monotonic() + PATIENCE_S
        while words not in self.said[since:]:
            assert time.monotonic() < deadline_s, self.said
            if not self._read():
                assert words in self.said[since:], self.said

    def press(self, keys: bytes) -> None:
        os.write(self.fd, keys)

    def status(self) -> int:
        """Exit status, once it has ended."""
        while self._read():
            pass
        return self.process.wait(PATIENCE_S)

    def _read(self) -> bool:
        if select.select([self.fd], [], [], PATIENCE_S)[0]:
            with contextlib.suppress(OSError):  # the terminal's other end is closed
                if data := os.read(self.fd, 1 << 16):
                    self.said += data.decode(errors="replace")
                    return True
        return False


@contextlib.contextmanager
def terminal(*arguments: str) -> Iterator[Terminal]:
    master, slave = pty.openpty()
    os.set_blocking(slave, True)
    process = subprocess.Popen(
        [sys.executable, "-m", "armctl", *arguments], stdin=slave, stdout=slave, stderr=slave, start_new_session=True,
        preexec_fn=_own_terminal,
    )  # fmt: skip
    os.close(slave)
    try:
        yield Terminal(process, master)
    finally:
        process.kill()
        process.wait()
        os.close(master)


def _own_terminal() -> None:
    """Make standard input the controlling terminal, whose Ctrl-C is a signal."""
    import fcntl
    import termios

    fcntl.ioctl(0, termios.TIOCSCTTY, 0)
    fcntl.ioctl(0, termios.TIOCSWINSZ, b"\x1e\x00\x50\x00\x00\x00\x00\x00")


def test_watch_is_a_live_picture_that_ctrl_c_ends_well(daemon: Path) -> None:
    with terminal("watch") as watching:
        watching.until("wrist")
        first = len(watching.said)
        watching.until("ax12-line:", since=first)
        watching.press(CTRL_C)
        assert watching.status() == 0
        assert "Traceback" not in watching.said
        for word in ("limits", "load %", "degC", "●", "tool at"):
            assert word in watching.said


def test_watch_in_a_pipe_is_plain_lines(daemon: Path) -> None:
    command = [sys.executable, "-m", "armctl", "watch"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as watching:
        assert watching.stdout is not None
        ticks = []
        for line in (watching.stdout.readline() for _ in range(2)):
            found = re.fullmatch(r"tick (\d+); \w+; tool [-0-9., ]+ mm.*; hottest .*\n", line)
            assert found, line
            ticks.append(int(found[1]))
        watching.terminate()
    assert ticks[1] - ticks[0] >= 10


def test_colour_is_for_terminals_that_want_it(daemon: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    fault = ("demo", "--out", "/proc/nowhere")
    with terminal("status") as coloured:
        assert coloured.status() == 0
        assert "\x1b[1m" in coloured.said
    monkeypatch.setenv("NO_COLOR", "1")
    for arguments in (("status",), fault):
        with terminal(*arguments) as plain:
            plain.status()
            assert not COLOUR.search(plain.said)
    piped = subprocess.run([sys.executable, "-m", "armctl", "status"], capture_output=True, text=True, check=True)
    assert "\x1b" not in piped.stdout + piped.stderr
    assert max(map(len, piped.stdout.splitlines())) <= 80


def test_ctrl_c_during_a_move_stops_the_arm_and_says_so(daemon: Path) -> None:
    with Client(daemon) as client:
        hold(client, PATIENCE_S)
        start = [joint["position_rad"] for joint in client.call("status")["joints"]]
        target = ",".join(f"{position + 0.6 * (index == 0):.4f}" for index, position in enumerate(start))
        with terminal("move", "--joints", target, "--duration", "20") as moving:
            snapshots = client.subscribe()
            next(one for one in snapshots if one["state"] == "moving" and (one["progress"] or 0.0) > 0.05)
            moving.press(CTRL_C)
            assert moving.status() == 130
            assert "interrupted: the arm slows down on its path and holds there" in moving.said
            assert "Traceback" not in moving.said
        held = next(one for one in snapshots if one["state"] == "holding")
        assert held["fault"] is None
        assert abs(held["joints"][0]["position_rad"] - start[0]) < 0.5


def test_ctrl_c_while_teaching_leaves_a_limp_arm_and_the_keys_as_they_were(daemon: Path) -> None:
    with terminal("teach", "interrupted", "--countdown", "0") as teaching:
        teaching.until("rest it there")
        teaching.press(CTRL_C)
        assert teaching.status() == 130
        assert "the arm stays limp" in teaching.said
    with Client(daemon) as client:
        status = client.call("status")
        assert status["state"] == "off"
        assert status["commander"] is None


def test_ctrl_c_in_json_is_one_object(daemon: Path) -> None:
    with Client(daemon) as client:
        hold(client, PATIENCE_S)
    with terminal("release", "--countdown", "60", "--json") as releasing:
        releasing.until("support the arm")
        releasing.press(CTRL_C)
        assert releasing.status() == 130
        [line] = [line for line in releasing.said.splitlines() if line.startswith("{")]
        assert json.loads(line)["error"]["message"] == "interrupted: torque stays on"
    with Client(daemon) as client:
        assert client.call("status")["state"] == "holding"
