"""The client: errors come back as they were raised, lines are put together again, late answers are skipped."""

import grp
import json
import os
import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from armctl import errors
from armctl.cli.output import next_command
from armctl.client import Client
from armctl.client.protocol import Protocol
from armctl.host import jsonrpc
from tests.words import missing

PATIENCE_S = 20.0


@contextmanager
def daemon(folder: Path, *chunks: bytes) -> Iterator[tuple[Client, list[dict[str, Any]]]]:
    """A client of a daemon that answers its first request with `chunks` and then closes; and what it was asked."""
    asked: list[dict[str, Any]] = []
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(folder / "s"))
        listening.listen()
        listening.settimeout(PATIENCE_S)

        def serve() -> None:
            connection, _ = listening.accept()
            with connection, connection.makefile("rb") as lines:
                for line in lines:
                    asked.append(json.loads(line))
                    for chunk in chunks:
                        connection.sendall(chunk)
                    return

        thread = threading.Thread(target=serve)
        thread.start()
        with Client(folder / "s", timeout_s=PATIENCE_S) as client:
            yield client, asked
        thread.join(PATIENCE_S)


@pytest.mark.parametrize(
    ("error", "code", "exit_status"),
    [
        (errors.ConfigError("optimize", "via", "must be at most 20", "take fewer"), "CONFIG", 2),
        (errors.RequestRefused("PREFLIGHT", ["too fast", "too low"]), "PREFLIGHT", 1),
        (errors.IllegalTransition("the arm is limp"), "ILLEGAL_TRANSITION", 1),
        (errors.BusError("ODD", "servo 4: no reply", 4), "ODD", 1),
        (errors.PortBusy("/dev/robot is held by pid 3"), "PORT_BUSY", 1),
        (errors.UnreachableTarget("0.6 m away, reach is 0.38", 0.22), "UNREACHABLE", 1),
        (errors.LogError("no such recording"), "LOG", 1),
        (errors.ArmctlError("something else"), "FAILED", 1),
    ],
)
def test_an_error_says_code_reasons_and_exit_status_and_comes_back_as_it_was_raised(
    error: errors.ArmctlError, code: str, exit_status: int, tmp_path: Path
) -> None:
    line = jsonrpc.error_line(1, error)
    answer = json.loads(line)
    assert (answer["id"], answer["error"]["code"]) == (1, jsonrpc.ARMCTL_ERROR)
    data = answer["error"]["data"]
    assert (data["code"], data["exit_status"], data["type"]) == (code, exit_status, type(error).__name__)
    assert "; ".join(data["reasons"]) == str(error)
    with daemon(tmp_path, line) as (client, _), pytest.raises(errors.ArmctlError) as caught:
        client.call("run")
    assert type(caught.value) is type(error)
    assert str(caught.value) == str(error)
    assert vars(caught.value) == vars(error)
    assert caught.value.exit_status == error.exit_status


def test_an_error_of_an_unknown_kind_is_a_refusal(tmp_path: Path) -> None:
    answer = json.loads(jsonrpc.error_line(1, errors.LogError("new words")))
    answer["error"]["data"]["type"] = "ErrorOfTheFuture"
    with (
        daemon(tmp_path, json.dumps(answer).encode() + b"\n") as (client, _),
        pytest.raises(errors.RequestRefused) as caught,
    ):
        client.call("run")
    assert (caught.value.code, caught.value.reasons) == ("LOG", ("new words",))


def test_an_answer_to_no_request_in_particular_is_raised_too(tmp_path: Path) -> None:
    line = jsonrpc.error_line(None, errors.RequestRefused("BUSY", "64 clients are connected already"))
    with daemon(tmp_path, line) as (client, _), pytest.raises(errors.RequestRefused, match="64 clients"):
        client.call("status")


def test_a_client_that_was_sent_away_before_it_asked_anything_connects_again(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        with Client(tmp_path / "s", timeout_s=PATIENCE_S) as client:
            away, _ = listening.accept()
            away.sendall(jsonrpc.error_line(None, errors.RequestRefused("IDLE", "it sent no whole request")))
            away.close()
            listening.settimeout(PATIENCE_S)

            def serve() -> None:
                connection, _ = listening.accept()
                with connection, connection.makefile("rb") as lines:
                    lines.readline()
                    connection.sendall(jsonrpc.result_line(1, {"state": "off"}))

            thread = threading.Thread(target=serve)
            thread.start()
            assert client.call("status") == {"state": "off"}
            thread.join(PATIENCE_S)


def test_parameters_and_results_pass_as_they_are(tmp_path: Path) -> None:
    with daemon(tmp_path, jsonrpc.result_line(1, {"name": "z"})) as (client, asked):
        assert client.call("recordings_rename", name="a", to="z") == {"name": "z"}
    assert asked == [{"jsonrpc": "2.0", "id": 1, "method": "recordings_rename", "params": {"name": "a", "to": "z"}}]


def test_a_line_may_come_in_pieces(tmp_path: Path) -> None:
    line = jsonrpc.result_line(1, {"text": "x" * 200_000})
    pieces = [line[begin : begin + 7001] for begin in range(0, len(line), 7001)]
    with daemon(tmp_path, *pieces) as (client, _):
        assert len(client.call("status")["text"]) == 200_000


def test_progress_goes_to_its_callback_and_the_rest_waits(tmp_path: Path) -> None:
    lines = (
        jsonrpc.notification_line("progress", {"generation": 1}),
        jsonrpc.notification_line("snapshot", {"tick": 5}),
        jsonrpc.result_line(1, {}),
        jsonrpc.notification_line("snapshot", {"tick": 6}),
    )
    seen: list[dict[str, Any]] = []
    with daemon(tmp_path, b"".join(lines)) as (client, _):
        client.call("optimize", on_progress=seen.append)
        assert seen == [{"generation": 1}]
        notifications = client.notifications()
        assert [next(notifications), next(notifications)] == [("snapshot", {"tick": 5}), ("snapshot", {"tick": 6})]
        with pytest.raises(errors.NoDaemon, match="closed"):
            next(notifications)


def test_the_late_answer_to_an_interrupted_call_is_skipped(tmp_path: Path) -> None:
    late = jsonrpc.result_line(1, {"recording": "late"})
    with daemon(tmp_path, late, jsonrpc.result_line(2, {"state": "holding"})) as (client, _):
        client._last_id = 1
        assert client.call("stop") == {"state": "holding"}


def test_a_daemon_that_ends_is_no_daemon(tmp_path: Path) -> None:
    with daemon(tmp_path) as (client, _):
        with pytest.raises(errors.NoDaemon, match="closed"):
            client.call("status")
        with pytest.raises(errors.NoDaemon):
            client.call("status")


def test_a_daemon_that_does_not_answer_is_no_daemon(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        with Client(tmp_path / "s", timeout_s=0.01) as client, pytest.raises(errors.NoDaemon, match=r"0\.01 s"):
            client.call("status")


def test_numbers_that_json_has_not_are_refused_before_they_are_sent(tmp_path: Path) -> None:
    with daemon(tmp_path, jsonrpc.result_line(2, {})) as (client, asked):
        with pytest.raises(errors.RequestRefused, match="finite"):
            client.call("optimize", duration_s=float("nan"))
        assert client.call("status") == {}
    assert len(asked) == 1


def test_the_socket_is_found_as_the_configuration_says(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "elsewhere"))
    with pytest.raises(errors.NoDaemon, match="elsewhere") as caught:
        Client()
    assert caught.value.exit_status == 3
    assert "armctl daemon --port" in str(caught.value)


def test_of_a_socket_that_one_may_not_open_it_is_said_whose_it_is_and_who_lets_one_in(tmp_path: Path) -> None:
    folder, path = tmp_path / "run", tmp_path / "run" / "s"
    folder.mkdir()
    path.touch()
    if os.getuid() == 0:  # nobody is told to join root's group
        os.chown(path, -1, grp.getgrnam("daemon").gr_gid)
    user, group = path.owner(), path.group()
    joining = f"join the group (`sudo usermod -aG {group} $USER`, then log in anew), or ask {user}"
    for mode, way in ((0o660, joining), (0o600, f"; ask {user}")):
        path.chmod(mode)
        error = Protocol(path).no_daemon(PermissionError(13, "Permission denied"))
        told = f"{path} is of user {user} and group {group}"
        assert not missing(str(error), "a daemon may run, but you may not open its socket", told, way)
        assert "armctl daemon" not in str(error) + next_command(error)
        assert (error.exit_status, jsonrpc.error_data(error)["code"]) == (3, "NO_DAEMON")
    path.unlink()  # as for somebody who may not look into the folder
    error = Protocol(path).no_daemon(PermissionError(13, "Permission denied"))
    assert f"{folder} is of user {user}" in str(error)


def test_of_a_path_that_is_too_long_for_a_socket_that_is_said(tmp_path: Path) -> None:
    with pytest.raises(errors.NoDaemon, match="path too long; name a shorter one with --socket") as caught:
        Client(tmp_path / ("x" * 120))
    assert "armctl daemon" not in str(caught.value) + next_command(caught.value)
