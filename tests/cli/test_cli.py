"""Manners of the command line: help, one JSON object, exit statuses, errors without tracebacks."""

from __future__ import annotations

import io
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from armctl.cli import cli, main
from armctl.cli.output import POINT, Output

COMMANDS = cli.list_commands(click.Context(cli))


@pytest.fixture(autouse=True)
def _own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "nobody.sock"))


def _commands() -> Iterator[tuple[list[str], click.Command]]:
    for name in COMMANDS:
        command = cli.get_command(click.Context(cli), name)
        assert command is not None
        yield [name], command
        if isinstance(command, click.Group):
            for sub in command.commands.values():
                yield [name, str(sub.name)], sub


def test_every_command_explains_itself_and_can_answer_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    for path, command in _commands():
        assert main([*path, "--help"]) == 0
        text = capsys.readouterr().out
        assert command.help, path
        if not isinstance(command, click.Group):
            assert "--json" in text, path


@pytest.mark.parametrize("command", ["status", "stop", "hold", "clear", "torque on", "recordings list", "watch"])
def test_without_a_daemon_the_status_is_3_and_the_remedy_is_named(
    command: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(command.split()) == 3
    captured = capsys.readouterr()
    assert "armctl daemon --port" in captured.err
    assert captured.out == ""


def test_a_failure_in_json_is_one_object_too(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["status", "--json"]) == 3
    captured = capsys.readouterr()
    assert json.loads(captured.out)["error"]["code"] == "NoDaemon"
    assert captured.err.startswith("armctl: ")


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        (["nonsense"], "No such command"),
        (["teach"], "Missing argument"),
        (["optimize", "a", "--from", "1,2", "--to", "1,2,3"], "not three numbers"),
        (["optimize", "a", "--from", "nan,0,0", "--to", "1,2,3"], "finite"),
        (["optimize", "a", "--from", "180,0,0", "--to", "1,2,3"], "the unit is metres"),
        (["optimize", "a", "--from", "0.1,0,0", "--to", "0.2,0,0", "--via", "99"], "range"),
        (["sim", "--latency-ms", "-1"], "range"),
        (["demo", "--seed", "x"], "not a valid integer"),
    ],
)
def test_wrong_usage_is_2(arguments: list[str], text: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(arguments) == 2
    assert text in capsys.readouterr().err


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        (["daemon"], 2, "no serial port named"),
        (["daemon", "--port", "/dev/null", "--arm", "nobodys"], 2, "known: ax12-line"),
        (["daemon", "--port", "/dev/null", "--config", "/nonexistent.yaml"], 2, "cannot read the configuration"),
        (["sim", "--arm", "nobodys"], 2, "known: ax12-line"),
        (["hand", "--link", "/nonexistent/link"], 1, "start one with `armctl sim"),
        (["replay", "/nonexistent.mcap", "--check"], 1, "cannot be read"),
        (["log", "info", "/nonexistent.mcap"], 1, "cannot be read"),
        (["run", "/nonexistent.json"], 2, "cannot read the plan"),
        (["optimize", "none", "--from", "0.18,-0.1,0.1", "--to", "0.18,0.1,0.1"], 1, "none"),
        (["teach", "x", "--from", "0.18,-0.1,0.1"], 2, "one end of the line is missing"),
    ],
)
def test_bad_input_is_one_clear_sentence(
    arguments: list[str], status: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == status
    captured = capsys.readouterr()
    assert text in captured.err
    assert "Traceback" not in captured.err


def test_a_file_that_is_no_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"not an mcap file at all")
    assert main(["replay", str(path), "--check"]) == 1
    assert str(path) in capsys.readouterr().err


def test_robots_are_listed(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["robots", "--json"]) == 0
    assert "ax12-line" in [robot["name"] for robot in json.loads(capsys.readouterr().out)["robots"]]


def test_points_may_be_negative() -> None:
    assert POINT.convert("-0.18,-0.125,1e-1", None, None) == (-0.18, -0.125, 0.1)


def test_messages_stay_off_stdout_when_json_was_asked_for(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output()
    output.json = True
    output.say("for people")
    with output.progress("work", 2.0) as show:
        show(1.0, "half")
    assert output.result({"x": 1})
    captured = capsys.readouterr()
    assert json.loads(captured.out) == {"x": 1}
    assert "for people" in captured.err


def _snapshot(**changes: Any) -> dict[str, Any]:
    joint = {
        "name": "base",
        "servo_id": 1,
        "position_rad": 0.5,
        "velocity_rad_s": 0.0,
        "load_ratio": -0.2,
        "voltage_V": 12.0,
        "temperature_degC": 31.0,
        "torque_enabled": True,
        "age_s": 0.04,
    }
    silent = dict.fromkeys(joint) | {"name": "shoulder", "servo_id": 2}
    return {
        "arm_id": "arm",
        "state": "holding",
        "fault": None,
        "joints": [joint, silent],
        "tool": {"position_m": [0.18, 0.0, 0.1], "rpy_rad": [0.0, 0.0, 0.0]},
        "recording": None,
        "log": {"path": "x", "problem": "", "dropped": 0},
        **changes,
    }


def test_the_picture_of_a_snapshot_fits_80_columns_and_shows_the_fault_card() -> None:
    from rich.console import Console

    from armctl.cli.arm import _picture

    fault = {"code": "BLOCKED", "servo_id": 1, "since_s": 3.2, "arm": "still", "next": "free it", "text": "stuck"}
    console = Console(width=80, record=True, file=io.StringIO())
    console.print(_picture(_snapshot(fault=fault, recording="line-1", tool=None)))
    text = console.export_text()
    assert max(map(len, text.splitlines())) <= 80
    for expected in ("28.6", "never", "BLOCKED", "next: free it", "recording line-1", "unknown"):
        assert expected in text
