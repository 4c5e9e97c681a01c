"""`armctl stop` on its own way: what it takes over from the command line, and what it leaves to it."""

import contextlib
import json
import socket
import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from armctl.cli import main
from armctl.cli.output import Output
from armctl.client.stop import typed
from armctl.files import stop_path


@pytest.fixture
def lane(tmp_path: Path) -> Iterator[tuple[Path, list[bytes]]]:
    """The daemon's socket, and what its lane has heard; the first caller is let down, as by a process that dies."""
    path = tmp_path / "s"
    heard: list[bytes] = []

    def serve() -> None:
        for answer in (b"", b"ok holding\n"):
            caller, _ = listening.accept()
            with caller:
                heard.append(caller.recv(256))
                caller.sendall(answer)

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(stop_path(path)))
        listening.listen()
        serving = threading.Thread(target=serve)
        serving.start()
        yield path, heard
        serving.join()


@pytest.mark.parametrize("options", ["--json --socket {}", "--socket={} --json"])
def test_the_next_control_process_answers_for_one_that_died(
    options: str, lane: tuple[Path, list[bytes]], capsys: pytest.CaptureFixture[str]
) -> None:
    path, heard = lane
    assert typed(["stop", *options.format(path).split()]) == 0
    assert capsys.readouterr().out == '{"state": "holding"}\n'
    assert heard == [b"stop\n", b"stop\n"]


def test_the_state_is_said_in_a_word(
    lane: tuple[Path, list[bytes]], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("ARMCTL_SOCKET", str(lane[0]))
    assert typed(["stop"]) == 0
    assert capsys.readouterr().out == "holding\n"


def test_where_too_many_wait_to_be_let_in_it_comes_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    with contextlib.ExitStack() as crowd:
        listening = crowd.enter_context(socket.socket(socket.AF_UNIX))
        listening.bind(str(stop_path(tmp_path / "s")))
        listening.listen(0)
        waiting: list[socket.socket] = []
        with contextlib.suppress(BlockingIOError):
            while True:
                one = crowd.enter_context(socket.socket(socket.AF_UNIX))
                one.setblocking(False)
                one.connect(listening.getsockname())
                waiting.append(one)

        def serve() -> None:
            for one in waiting:
                listening.accept()[0].close()
                one.close()
            caller, _ = listening.accept()
            with caller:
                assert caller.recv(256) == b"stop\n"
                caller.sendall(b"ok holding\n")

        serving = threading.Thread(target=serve)

        def wait(_: float) -> None:
            if serving.ident is None:
                serving.start()

        monkeypatch.setattr("time.sleep", wait)
        assert typed(["stop", "--socket", str(tmp_path / "s")]) == 0
        serving.join()
    assert capsys.readouterr().out == "holding\n"


@contextlib.contextmanager
def answering(path: Path, answer: bytes) -> Iterator[list[bytes]]:
    """Somebody who answers one caller with a line; what was heard."""
    heard: list[bytes] = []

    def serve() -> None:
        caller, _ = listening.accept()
        with caller:
            heard.append(caller.recv(256))
            caller.sendall(answer + b"\n")

    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        listening.settimeout(5.0)  # nobody may come
        serving = threading.Thread(target=serve)
        serving.start()
        yield heard
        serving.join()


GONE = "the stop did not reach the arm: its serial port is gone; support the arm, then switch its power off"


@pytest.mark.parametrize("unreached", [False, True])
def test_of_a_stop_that_met_a_fault_the_host_says_whether_it_reached_the_arm(
    unreached: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "s"
    result = {"state": "faulted", **({"unreached": GONE} if unreached else {})}
    answer = json.dumps({"jsonrpc": "2.0", "id": 1, "result": result}).encode()
    with answering(stop_path(path), b"ok faulted") as lane, answering(path, answer) as host:
        assert typed(["stop", "--socket", str(path)]) == (None if unreached else 0)
    assert (lane, json.loads(host[0])["method"]) == ([b"stop\n"], "stop")
    assert capsys.readouterr().out == ("" if unreached else "faulted\n")


def test_of_a_daemon_that_hangs_the_lane_alone_answers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("armctl.client.stop.HOST_S", 0.01)
    with answering(stop_path(tmp_path / "s"), b"ok faulted"), socket.socket(socket.AF_UNIX) as hung:
        hung.bind(str(tmp_path / "s"))
        hung.listen()
        assert typed(["stop", "--socket", str(tmp_path / "s")]) == 0
    assert capsys.readouterr().out == "faulted\n"


@pytest.mark.parametrize("line", ["stop", "hold"])
def test_a_stop_that_did_not_reach_the_arm_has_failed(
    line: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(Output, "ask", lambda *_: {"state": "faulted", "unreached": GONE})
    assert main([line, "--json"]) == 1
    said = capsys.readouterr()
    error = {"code": "PORT_GONE", "message": GONE, "reasons": [GONE], "next": "armctl status"}
    assert json.loads(said.out) == {"state": "faulted", "error": error}
    assert said.err == f"armctl: {GONE}\n"


@pytest.mark.parametrize(
    "line", ["", "status", "stop --help", "stop --socket", "stop now", "hold", "stop --socket no/s"]
)
def test_all_else_is_left_to_the_command_line(line: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert typed(line.split()) is None
    assert capsys.readouterr().out == ""
