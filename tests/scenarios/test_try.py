"""`armctl try` in a terminal: the page is served, a key has the hand guide the arm, Ctrl-C ends everything."""

import os
import socket
import sys
import urllib.request
from itertools import islice
from pathlib import Path

import pytest

from armctl.client import Client
from armctl.errors import ArmctlError
from armctl.files import load_arm, shipped_dirs
from armctl.lab.demo import line_in_reach
from armctl.lab.stage import silent
from armctl.lab.trial import trial
from tests.scenarios.bench import alive
from tests.terminal import CTRL_C, free_port, terminal

pytestmark = pytest.mark.pty


def test_an_arm_to_try_is_guided_by_a_key_and_ended_by_ctrl_c(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "daemon.sock"))
    command = [sys.executable, "-m", "armctl", "try", "--no-browser", "--port", str(free_port())]
    with terminal(*command) as running:
        running.until("\r\n", running.until("ready http://127.0.0.1:"))
        running.until("Its line: 0.180,-0.125,0.100 to 0.180,0.125,0.100")
        address = next(word for word in running.said.split() if word.startswith("http://"))
        with urllib.request.urlopen(address.partition("#")[0], timeout=20.0) as page:
            assert b"<title>" in page.read()
        started = Path(f"/proc/{running.process.pid}/task/{running.process.pid}/children").read_text().split()
        assert len(started) == 3

        running.press(b"h")
        running.until("the arm is off: begin to teach")
        with Client(tmp_path / "daemon.sock") as client, Client(tmp_path / "daemon.sock") as watcher:
            client.call("teach_begin", confirm=True)
            client.call("take_begin", name="line-1")
            running.press(b"h")
            told = running.until("leads it along the line: ")
            seconds = int(running.said[told : running.until(" s", told) - 2])
            for _ in islice(watcher.subscribe(), 10 * (seconds + 1)):
                pass
            client.call("take_end")
            client.call("teach_end")
            client.call("torque_on")
        running.until("the hand lets go")
        running.press(CTRL_C)
        running.until("ended; what was recorded is in armctl-try")
        assert running.status() == 0
    assert not [pid for pid in started if alive(int(pid))]
    assert (tmp_path / "armctl-try/recordings/line-1.mcap").stat().st_size > 0
    assert not os.path.lexists(tmp_path / "armctl-servos")


def test_what_does_not_start_says_why_and_leaves_nothing_behind(tmp_path: Path) -> None:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        port = taken.getsockname()[1]
        servos = tmp_path / "servos"
        with (
            pytest.raises(ArmctlError, match=f"armctl web did not start: .*{port}"),
            trial(tmp_path / "try", "ax12-line", tmp_path / "daemon.sock", servos, port, silent),
        ):
            pass
    assert not os.path.lexists(servos)


@pytest.mark.parametrize("arm", [path.stem for path in shipped_dirs()[1].glob("*.yaml")])
def test_every_shipped_arm_can_be_guided(arm: str) -> None:
    assert line_in_reach(load_arm(arm)) is not None
