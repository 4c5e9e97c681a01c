"""Manners of the command line: help, one JSON object, exit statuses, errors without tracebacks."""

from __future__ import annotations

import io
import json
import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import click
import pytest

from armctl.cli import PURPOSES, cli, main
from armctl.cli.output import HOLDS, POINT, Output, next_command
from armctl.client import Client
from armctl.errors import (
    ArmctlError,
    BusError,
    ConfigError,
    LogError,
    NoDaemon,
    RequestRefused,
    UnreachableTarget,
)
from armctl.files import find_arm_file

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


def _examples() -> Iterator[tuple[list[str], click.Command, str]]:
    for path, command in _every([], cli):
        said = " ".join(str(command.help).split())
        yield path, command, said.partition("Example: ")[2]


def _every(path: list[str], group: click.Group) -> Iterator[tuple[list[str], click.Command]]:
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield [*path, name], command
        if isinstance(command, click.Group):
            yield from _every([*path, name], command)


def test_every_command_has_an_example_and_the_example_is_right() -> None:
    seen = 0
    for path, command, said in _examples():
        start = " ".join(("armctl", *path))
        assert start in said, f"{start}: no example"
        example = re.split(r"[;&|>]", said[said.index(start) :])[0]
        if not isinstance(command, click.Group):
            command.make_context(start, shlex.split(example)[len(path) + 1 :])
            seen += 1
    assert seen > 40


def test_the_help_lists_every_command_under_one_heading(capsys: pytest.CaptureFixture[str]) -> None:
    listed = [name for names in PURPOSES.values() for name in names]
    assert sorted(listed) == COMMANDS
    with pytest.raises(SystemExit, match="0"):
        cli.main(["--help"], terminal_width=80)
    told = capsys.readouterr().out
    assert all(f"\n{purpose}:\n" in told for purpose in PURPOSES)
    assert all(re.search(rf"^  {name}  +[A-Z]", told, re.MULTILINE) for name in COMMANDS)
    assert max(map(len, told.splitlines())) <= 80


@pytest.mark.parametrize(
    "error",
    [
        RequestRefused("BUSY", "another client commands"),
        RequestRefused("PREFLIGHT", ["too fast", "too low"]),
        LogError("x.mcap cannot be read"),
        LogError("recording a: exists already"),
        ConfigError("armctl.yaml", "baud", "not a number"),
        ConfigError("armctl move", "--xyz", "one target is wanted"),
        BusError("NO_REPLY", "servo 4: no reply"),
        UnreachableTarget("too far", 0.1),
        NoDaemon("nobody answers"),
        ArmctlError("something"),
    ],
)
def test_every_refusal_tells_the_next_command(error: ArmctlError, capsys: pytest.CaptureFixture[str]) -> None:
    output = Output()
    output.failure(error)
    assert re.search("next: .*armctl [a-z]", capsys.readouterr().err)
    output.json = True
    output.failure(error)
    following = json.loads(capsys.readouterr().out)["error"]["next"].split("armctl ")[1]
    assert following.split()[0].rstrip(",") in COMMANDS


def test_a_missing_extra_is_the_next_command_and_is_said_once(capsys: pytest.CaptureFixture[str]) -> None:
    output = Output()
    error = ArmctlError("the dashboard needs uvicorn; install it with: pip install 'armctl[web]'")
    output.failure(error)
    assert capsys.readouterr().err == f"armctl: {error}\n"
    output.json = True
    output.failure(error)
    assert json.loads(capsys.readouterr().out)["error"]["next"] == "pip install 'armctl[web]'"


@pytest.mark.parametrize(
    ("daemons_arm", "following"),
    [
        (None, "armctl workspace --robot transfer-6dof"),
        ("bench-7", "armctl workspace --robot lanzhou-4dof"),
        ("ax12-line", "armctl workspace --robot ax12-line"),
        ("given by a path", "armctl robots"),
    ],
)
def test_out_of_reach_leads_to_the_workspace_of_the_arm_in_question(
    daemons_arm: str | None, following: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Running(Client):
        def __init__(self, path: object = None, **_: object) -> None:
            if path != "the-socket":
                raise NoDaemon("nobody answers")

        def close(self) -> None:
            pass

        def call(self, method: str, **_: Any) -> dict[str, Any]:
            return {"arm_id": daemons_arm}

    configured = tmp_path / "xdg_config_home" / "armctl"
    (configured / "calibration").mkdir(parents=True)
    (configured / "armctl.yaml").write_text("arm: transfer-6dof\n")
    text = find_arm_file("lanzhou-4dof").read_text()
    (configured / "calibration" / "mine.yaml").write_text(re.sub("arm_id: .*", "arm_id: bench-7", text))
    monkeypatch.setattr("armctl.client.Client", Running)
    socket = None if daemons_arm is None else "the-socket"
    assert next_command(RequestRefused("UNREACHABLE", "0.6 m away"), socket) == following
    assert next_command(UnreachableTarget("0.6 m away", 0.2), socket) == following


def test_a_refusal_that_names_its_remedy_gets_no_second_one(capsys: pytest.CaptureFixture[str]) -> None:
    Output().failure(RequestRefused("BUSY", "wait, or `armctl stop`"))
    assert capsys.readouterr().err == "armctl: wait, or `armctl stop`\n"


def test_an_interrupt_is_130_and_says_what_it_leaves_behind(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(Client):
        def __init__(self, *_: object) -> None:
            raise KeyboardInterrupt

    monkeypatch.setattr("armctl.client.Client", Interrupted)
    assert main(["park"]) == 130
    assert capsys.readouterr().err == f"\ninterrupted: {HOLDS}\n"
    assert main(["park", "--json"]) == 130
    captured = capsys.readouterr()
    assert json.loads(captured.out)["error"]["code"] == "INTERRUPTED"


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_for_the_shell(shell: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["completion", shell, "--json"]) == 0
    answer = json.loads(capsys.readouterr().out)
    assert main(["completion", shell]) == 0
    assert capsys.readouterr().out == answer["script"] + "\n"
    assert "_ARMCTL_COMPLETE" in answer["script"]


def test_the_shell_is_told_how_a_word_may_end(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("_ARMCTL_COMPLETE", "bash_complete")
    monkeypatch.setenv("COMP_WORDS", "armctl rec")
    monkeypatch.setenv("COMP_CWORD", "1")
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out == "plain,recordings\n"


def test_every_command_explains_itself_and_can_answer_in_json(capsys: pytest.CaptureFixture[str]) -> None:
    for path, command in _commands():
        assert main([*path, "--help"]) == 0
        text = capsys.readouterr().out
        assert command.help, path
        if not isinstance(command, click.Group):
            assert "--json" in text, path


@pytest.mark.parametrize(
    "command",
    ["status", "stop", "hold", "clear", "torque on", "recordings list", "watch", "pause", "resume", "rate 0.5"],
)
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
        (["move", "--joints", "1,x"], "is not numbers"),
        (["move", "--joints", "1,nan"], "must be finite"),
        (["move", "--pose", "1,2,3"], "has 3 numbers, not 6"),
        (["move", "--xyz", "0.1,0,0.2", "--duration", "0"], "range"),
        (["jog", "--axis", "w", "--speed", "1"], "'w' is not one of"),
        (["jog", "--axis", "x"], "Missing option '--speed'"),
        (["rate", "1.5"], "range"),
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
        (["move"], 2, "give just one of them"),
        (["move", "--xyz", "0.1,0,0.2", "--joints", "0,0"], 2, "give just one of them"),
        (["jog", "--speed", "1"], 2, "one thing to jog is wanted"),
        (["jog", "--axis", "x", "--speed", "inf"], 2, "is no speed"),
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
        "limits_rad": (-1.5, 1.5),
        "position_rad": 0.5,
        "velocity_rad_s": 0.0,
        "load_ratio": -0.2,
        "voltage_V": 12.0,
        "temperature_degC": 31.0,
        "torque_enabled": True,
        "age_s": 0.04,
    }
    silent = dict.fromkeys(joint) | {"name": "shoulder", "servo_id": 2, "limits_rad": (-1.5, 1.5)}
    return {
        "arm_id": "arm",
        "tick": 7,
        "period_s": 0.1,
        "state": "holding",
        "fault": None,
        "joints": [joint, silent],
        "tool": {"position_m": [0.18, 0.0, 0.1], "rpy_rad": [0.0, 0.0, 0.0], "speed_m_s": 0.3},
        "tool_speed_limit_m_s": 0.25,
        "progress": None,
        "rate": None,
        "recording": None,
        "log": {"path": "x", "problem": "", "dropped": 0},
        **changes,
    }


def _text(snapshot: dict[str, Any]) -> str:
    from rich.console import Console

    from armctl.cli.arm import picture

    console = Console(width=80, record=True, file=io.StringIO())
    console.print(picture(snapshot))
    return console.export_text()


def test_the_picture_shows_the_tool_s_speed_and_warns_a_teaching_hand_only() -> None:
    assert "180.0, 0.0, 100.0 mm, 300 mm/s" in _text(_snapshot())
    assert "below 250" not in _text(_snapshot())
    assert "below 250" in _text(_snapshot(state="teaching"))


def test_the_picture_shows_how_far_a_run_is_and_whether_it_is_paused() -> None:
    assert "40% of the way, rate 0.5" in _text(_snapshot(progress=0.4, rate=0.5))
    assert "40% of the way, paused" in _text(_snapshot(progress=0.4, rate=0.0))


def test_the_picture_of_a_snapshot_fits_80_columns_and_shows_the_fault_card() -> None:
    fault = {"code": "BLOCKED", "servo_id": 1, "since_s": 3.2, "arm": "still", "next": "free it", "text": "stuck"}
    text = _text(_snapshot(fault=fault, recording="line-1", tool=None))
    assert max(map(len, text.splitlines())) <= 80
    for expected in ("28.6", "never", "BLOCKED", "next: free it", "recording line-1", "unknown"):
        assert expected in text


def test_a_joint_is_shown_between_its_limits_and_red_near_them() -> None:
    from armctl.cli.arm import BAR, _place

    def place(position_rad: float) -> tuple[int, bool]:
        shown = _place({"position_rad": position_rad, "limits_rad": (-1.0, 1.0)})
        assert len(shown.plain) == BAR
        return shown.plain.index("●"), bool(shown.spans)

    assert place(-1.2) == place(-1.0) == (0, True)
    assert place(0.0) == (BAR // 2, False)
    assert place(1.0) == place(1.2) == (BAR - 1, True)


def test_the_longest_picture_fits_80_columns() -> None:
    [joint, _] = _snapshot()["joints"]
    wide = {**joint, "name": "x" * 64, "servo_id": 253, "position_rad": -2.6, "velocity_rad_s": -6.1, "age_s": 12.34}
    text = _text(_snapshot(joints=[wide] * 6, progress=1.0, rate=0.5))
    assert max(map(len, text.splitlines())) <= 80
    assert text.count("-149.0") == 6
    assert "●╌" in text


def test_a_snapshot_in_one_line_tells_state_place_heat_and_fault() -> None:
    from armctl.cli.arm import _line

    fault = {"code": "BLOCKED", "servo_id": 1, "since_s": 3.2, "arm": "still", "next": "free it", "text": "stuck"}
    line = _line(_snapshot(fault=fault, progress=0.4, rate=0.0))
    for expected in ("tick 7; holding", "180.0, 0.0, 100.0 mm", "31 degC (base)", "12.0 V", "40%", "next: free it"):
        assert expected in line
    nothing = dict.fromkeys(_snapshot()["joints"][0])
    assert _line(_snapshot(joints=[nothing], tool=None)) == "tick 7; holding; tool unknown"
