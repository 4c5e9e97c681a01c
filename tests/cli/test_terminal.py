"""Commands as a person meets them: in a terminal, with Ctrl-C, on simulated servos."""

import contextlib
import json
import re
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
import yaml

from armctl.client import Client
from armctl.files import load_arm
from armctl.lab.demo import started
from proving.hang import CENTRE_DEG
from proving.rig import hold
from tests.terminal import CTRL_C, CTRL_Z, PATIENCE_S, Shell, Terminal, shell, terminal

pytestmark = pytest.mark.pty
COLOUR = re.compile(r"\x1b\[[0-9;]*3[0-7]")


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
        cleanup.enter_context(started(folder / "sim.log", "sim", "--link", str(folder / "servos"), "--seed", "2"))
        cleanup.enter_context(started(folder / "daemon.log", "daemon", "--port", str(folder / "servos")))
        yield folder / "daemon.sock"


@contextlib.contextmanager
def armctl(*arguments: str) -> Iterator[Terminal]:
    with terminal(sys.executable, "-m", "armctl", *arguments) as running:
        yield running


def test_watch_is_a_live_picture_that_ctrl_c_ends_well(daemon: Path) -> None:
    with armctl("watch") as watching:
        watching.until("wrist")
        watching.until("ax12-line:", since=len(watching.said))
        watching.press(CTRL_C)
        assert watching.status() == 0
        assert "Traceback" not in watching.said
        for word in ("limits", "load %", "degC", "●", "tool at"):
            assert word in watching.said


def test_watch_in_a_pipe_is_plain_lines(daemon: Path) -> None:
    with subprocess.Popen([sys.executable, "-m", "armctl", "watch"], stdout=subprocess.PIPE, text=True) as watching:
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
    with armctl("status") as coloured:
        assert coloured.status() == 0
        assert "\x1b[1m" in coloured.said
    monkeypatch.setenv("NO_COLOR", "1")
    for arguments in (("status",), fault):
        with armctl(*arguments) as plain:
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
        with armctl("move", "--joints", target, "--duration", "20") as moving:
            snapshots = client.subscribe()
            next(one for one in snapshots if one["state"] == "moving" and (one["progress"] or 0.0) > 0.05)
            moving.press(CTRL_C)
            assert moving.status() == 130
            assert "interrupted: the arm slows down on its path and holds there" in moving.said
            assert "Traceback" not in moving.said
        held = next(one for one in snapshots if one["state"] == "holding" and not one["commander"])
        assert held["fault"] is None
        assert abs(held["joints"][0]["position_rad"] - start[0]) < 0.5


def test_keys_lead_the_tool_while_they_are_held_down(daemon: Path) -> None:
    limit_rad = load_arm("ax12-line").joints[0].limits_rad[1]
    with Client(daemon) as client:
        hold(client, PATIENCE_S)
        client.call("move", joints_rad=np.radians(CENTRE_DEG).tolist())
        before = client.call("status")["tool"]["position_m"]
        with armctl("jog", "--speed", "0.05") as jogging:
            jogging.until("q: leave")
            snapshots = client.subscribe()
            jogging.press(b"-\x1b[D")
            jogging.until("40 mm/s along y+")
            next(one for one in snapshots if one["state"] == "jogging")
            after = next(one for one in snapshots if one["state"] == "holding")  # nobody holds the key down
            client.call("move", joints_rad=[limit_rad, *np.radians(CENTRE_DEG[1:])])
            jogging.press(b"\x1b[C")  # what is refused is said, and other keys go on
            jogging.until("base stands at its limit")
            jogging.press(b"\x1b[D")
            next(one for one in snapshots if one["state"] == "jogging")
            jogging.press(b"q")
            assert jogging.status() == 0
            assert "holding, tool at" in jogging.said
            assert after["tool"]["position_m"][1] - before[1] > 0.005
            assert jogging.line_by_line
        client.call("park")  # a limp arm would fall from here


def test_teaching_asks_before_an_arm_goes_limp_and_ctrl_c_leaves_it_so(daemon: Path) -> None:
    with Client(daemon) as client:
        hold(client, PATIENCE_S)
        with armctl("teach", "interrupted", "--countdown", "0") as teaching:
            teaching.until("Go on? [y/N]")
            teaching.press(b"n\n")
            assert teaching.status() == 130
            assert "torque stays on" in teaching.said
        assert client.call("status")["state"] == "holding"
    with armctl("teach", "interrupted", "--countdown", "1") as teaching:
        teaching.until("Go on? [y/N]")
        teaching.press(b"y\n")
        teaching.until("rest it there", teaching.until("it goes limp in 1 s"))
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
    with armctl("release", "--countdown", "60", "--json") as releasing:
        releasing.until("support the arm")
        releasing.press(CTRL_C)
        assert releasing.status() == 130
        [line] = [line for line in releasing.said.splitlines() if line.startswith("{")]
        assert json.loads(line)["error"]["message"] == "interrupted: torque stays on"
    with Client(daemon) as client:
        assert client.call("status")["state"] == "holding"


def test_a_program_is_recorded_key_by_key_and_is_in_its_file(daemon: Path, tmp_path: Path) -> None:
    file = tmp_path / "tidy.yaml"
    with armctl("program", "record", str(file)) as recording:
        since = recording.until("q: done")
        for keys, said in ((b"\r", "1 steps; the last: move"), (b"w", "2 steps"), (b"gu", "3 steps; the last: grip")):
            recording.press(keys)
            since = recording.until(said, since)
        recording.until("2 steps", since)
        recording.press(b"q")
        assert recording.status() == 0
        assert "Traceback" not in recording.said
    assert [list(step) for step in yaml.safe_load(file.read_text())["steps"]] == [["move"], ["wait_s"]]


# ------------------------------------------------------------------------------------------------- job control


@pytest.fixture
def bash(daemon: Path, tmp_path: Path) -> Iterator[Shell]:
    """A shell beside the daemon, whose arm is limp; `armctl` is the one that is tested."""
    with Client(daemon) as client:
        client.call("release", confirm=True)
    with shell(tmp_path) as running:
        yield running


def test_teaching_goes_on_in_the_background_and_leaves_the_terminal_alone(bash: Shell) -> None:
    since = bash.start("armctl teach behind --yes &")
    bash.until("rest it there", since)
    assert bash.line_by_line
    assert "Running" in bash.type("jobs")
    bash.start("fg")
    bash.press(b"\n")  # a key of its own, once it is in front
    bash.until("behind: recording", since)
    bash.press(b"\n")
    bash.until("]$ ", bash.until("samples", since))
    assert bash.line_by_line
    assert "Stopped" not in bash.said


def test_teaching_can_be_suspended_and_change_between_background_and_foreground(bash: Shell) -> None:
    since = bash.start("armctl teach suspended --takes 2")
    bash.until("rest it there", since)
    bash.press(b"\n")  # is read at once: teaching has the terminal
    bash.until("suspended-1: recording", since)
    bash.press(CTRL_Z)
    bash.until("]$ ", bash.until("Stopped", since))
    assert bash.line_by_line
    assert "Running" in bash.type("bg; jobs")
    before = bash.start("fg")
    bash.until("armctl teach suspended", before)
    bash.press(b"\n")
    bash.until("suspended-2: carry", before)
    bash.press(CTRL_Z)
    bash.until("]$ ", bash.until("Stopped", before))
    ended = bash.type("bg; kill -INT %1; wait %1; echo status $?")
    assert "status 130" in ended
    assert "Stopped" not in ended  # it left the terminal's mode to the shell
    assert bash.line_by_line


def test_teaching_that_nobody_can_be_asked_about_is_refused(bash: Shell) -> None:
    """The last words of a shell's line are its exit statuses: refused behind, and refused without a terminal."""
    for line in ("armctl teach refused & wait $!; echo status $?", "armctl teach refused < /dev/null; echo status $?"):
        said = bash.type(line)
        assert "--yes" in said
        assert "status 1" in said
        assert "Stopped" not in said
