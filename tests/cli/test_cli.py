"""Manners of the command line: help, one JSON object, exit statuses, errors without tracebacks."""

import json
import re
import shlex
from collections.abc import Iterator
from errno import ENOSPC
from io import StringIO
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import click
import pytest

from armctl.__main__ import main as started
from armctl.cli import PURPOSES, cli, main
from armctl.cli.keys import keys
from armctl.cli.output import HOLDS, Output, next_command
from armctl.cli.parameters import POINT
from armctl.errors import ArmctlError, BusError, ConfigError, LogError, NoDaemon, RequestRefused, UnreachableTarget
from armctl.files import find_arm_file, load_arm
from tests.cli.conftest import Answer, StandIn, Typed, refusals

COMMANDS = cli.list_commands(click.Context(cli))


pytestmark = pytest.mark.usefixtures("own_folders")


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
    for path, command in _every([], cli):
        said = " ".join(str(command.help).split()).partition("Example: ")[2]
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


def failure(error: ArmctlError, capsys: pytest.CaptureFixture[str]) -> tuple[str, dict[str, Any]]:
    """What a person is shown of an error, and what a program is told."""
    output = Output()
    output.failure(error)
    shown = capsys.readouterr().err
    output.json = True
    output.failure(error)
    return shown, json.loads(capsys.readouterr().out)["error"]


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
    shown, told = failure(error, capsys)
    assert re.search("next: .*armctl [a-z]", shown)
    assert told["next"].split("armctl ")[1].split()[0].rstrip(",") in COMMANDS


EXTRA = "pip install 'armctl[web]'"
UNINSTALLED = ArmctlError(f"the dashboard needs uvicorn; install it with: {EXTRA}")
BUSY = RequestRefused("BUSY", "wait, or `armctl stop`")


@pytest.mark.parametrize(("error", "following"), [(UNINSTALLED, EXTRA), (BUSY, "armctl status")])
def test_an_error_that_names_its_remedy_gets_no_second_one(
    error: ArmctlError, following: str, capsys: pytest.CaptureFixture[str]
) -> None:
    shown, told = failure(error, capsys)
    assert (shown, told["next"]) == (f"armctl: {error}\n", following)


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
    class Running(StandIn):
        def __init__(self, path: object = None, **_: object) -> None:
            if path != "the-socket":
                raise NoDaemon("nobody answers")

        def call(self, method: str, **_: Any) -> dict[str, Any]:
            return {"arm_id": daemons_arm, "calibration_hash": hashes.get(str(daemons_arm))}

    configured = tmp_path / "xdg_config_home" / "armctl"
    (configured / "calibration").mkdir(parents=True)
    (configured / "armctl.yaml").write_text("arm: transfer-6dof\n")
    text = find_arm_file("lanzhou-4dof").read_text()
    (mine := configured / "calibration" / "mine.yaml").write_text(re.sub("arm_id: .*", "arm_id: bench-7", text))
    hashes = {arm.arm_id: arm.calibration_hash for arm in map(load_arm, ("ax12-line", str(mine)))}
    monkeypatch.setattr("armctl.client.Client", Running)
    socket = None if daemons_arm is None else "the-socket"
    for error in (RequestRefused("UNREACHABLE", "0.6 m away"), UnreachableTarget("0.6 m away", 0.2)):
        assert next_command(error, socket) == following


def test_an_interrupt_is_130_and_says_what_it_leaves(
    monkeypatch: pytest.MonkeyPatch, typed: Typed, answer: Answer
) -> None:
    monkeypatch.setattr("armctl.client.Client", Mock(side_effect=KeyboardInterrupt))
    assert typed("park", status=130).err == f"\ninterrupted: {HOLDS}\n"
    assert answer("park", status=130)["error"]["code"] == "INTERRUPTED"


@pytest.mark.parametrize("words", ["move --joints 0", "reach --xyz 0.2,0,0.1"])
def test_what_goes_wrong_on_the_way_is_said_while_the_motion_lasts(
    words: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], typed: Typed
) -> None:
    class Slow(StandIn):
        def call(self, method: str, *, on_progress: Any = None, **_: Any) -> dict[str, Any]:
            on_progress({"warning": "SLOWED", "text": "replies were lost"})
            assert "SLOWED: replies were lost" in capsys.readouterr().err
            raise RequestRefused("STOPPED", "it was stopped")

    monkeypatch.setattr("armctl.client.Client", Slow)
    said = typed(*words.split(), status=1).err
    assert "stopped, as somebody asked: the arm holds where it came to" in said  # that is no failure of armctl's
    assert "armctl: " not in said


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completion_prints_a_script_for_the_shell(shell: str, typed: Typed, answer: Answer) -> None:
    script = answer("completion", shell)["script"]
    assert typed("completion", shell).out == script + "\n"
    assert "_ARMCTL_COMPLETE" in script


def test_the_shell_is_told_how_a_word_ends(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    for name, value in {"_ARMCTL_COMPLETE": "bash_complete", "COMP_WORDS": "armctl rec", "COMP_CWORD": "1"}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out == "plain,recordings\n"


@pytest.fixture
def kept(own_folders: None, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files of somebody who has worked with armctl."""
    monkeypatch.chdir(tmp_path)
    for name in ("recordings/line-1.mcap", "recordings/swing.mcap", "logs/armctl-1.mcap", "plans/line.json"):
        file = tmp_path / "xdg_data_home" / "armctl" / name
        file.parent.mkdir(parents=True, exist_ok=True)
        file.touch()
    (tmp_path / "here.json").touch()


class Daemon(StandIn):
    def call(self, *_: object, **__: object) -> dict[str, Any]:
        return {"joints": [{"name": "base"}, {"name": "elbow"}]}


DATA = "xdg_data_home/armctl"


@pytest.mark.usefixtures("kept")
@pytest.mark.parametrize(("line", "finished"), [
    ("play l", ["plain,line-1"]),
    ("recordings delete s", ["plain,swing"]),
    ("optimize line-1 s", ["plain,swing"]),
    ("play ./s", ["file,./s"]),
    ("daemon --arm c", ["plain,crane-plus-v2", "plain,crustcrawler"]),
    ("ik --robot pu", ["plain,puma560"]),
    ("run h", ["plain,here.json"]),
    ("run {}/plans/l", ["plain,{}/plans/line.json"]),
    ("replay {}/l", ["plain,{}/logs/armctl-1.mcap"]),
    ("jog --joint e", ["plain,elbow"]),
    ("fault begin unp", ["plain,unplug"]),
    ("log find TRI", ["plain,TRIPPED"]),
    ("help pro", ["plain,programs"]),
    ("status --arm x", [""]),
])  # fmt: skip
def test_the_tab_key_finishes_names(
    line: str, finished: list[str], monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.setattr("armctl.client.Client", Daemon)
    words = "armctl " + line.format(tmp_path / DATA)
    count = str(len(words.split()) - 1)
    for name, value in {"_ARMCTL_COMPLETE": "bash_complete", "COMP_WORDS": words, "COMP_CWORD": count}.items():
        monkeypatch.setenv(name, value)
    with pytest.raises(SystemExit):
        main([])
    assert capsys.readouterr().out.splitlines() == [one.format(tmp_path / DATA) for one in finished]


@pytest.mark.parametrize(("path", "command"), [pytest.param(*one, id=" ".join(one[0])) for one in _every([], cli)])
def test_every_command_explains_itself_within_80_columns_and_can_answer_in_json(
    path: list[str], command: click.Command, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(SystemExit, match="0"):
        cli.main([*path, "--help"], terminal_width=80)
    told = capsys.readouterr().out
    assert told.startswith("Usage: ")
    assert max(map(len, told.splitlines())) <= 80
    assert command.help
    assert isinstance(command, click.Group) or "--json" in told


def test_a_failure_in_json_is_one_object_too(typed: Typed, answer: Answer) -> None:
    assert answer("status", status=3)["error"]["code"] == "NoDaemon"
    assert typed("status", "--json", status=3).err.startswith("armctl: ")


@pytest.mark.parametrize(("line", "words", "following"), [
    ("nonsense", "No such command 'nonsense'", "armctl --help"),
    ("log", "No such option '--json'", "armctl log --help"),
    ("teach", "Missing argument 'NAME'", "armctl teach --help"),
    ("rate 1.5", "range", "armctl rate --help"),
    ("calibrate", "give one of --points", "armctl calibrate --help"),
])  # fmt: skip
def test_wrong_usage_in_json_is_one_object_too(line: str, words: str, following: str, answer: Answer) -> None:
    error = answer(*line.split(), status=2)["error"]
    assert words in error["message"]
    assert error == {"code": "USAGE", "message": error["message"], "reasons": [error["message"]], "next": following}


@pytest.mark.parametrize(("line", "status", "words"), [
    ("robots", 1, "No space left on device"),
    ("robots --json", 1, "No space left on device"),
    ("status --json", 3, "no daemon answers"),
    ("nonsense --json", 2, "No such command"),
])  # fmt: skip
def test_an_answer_for_which_there_is_no_room_is_a_sentence(
    line: str, status: int, words: str, monkeypatch: pytest.MonkeyPatch, typed: Typed
) -> None:
    full = StringIO()
    monkeypatch.setattr(full, "write", Mock(side_effect=OSError(ENOSPC, "No space left on device")))
    monkeypatch.setattr("sys.stdout", full)
    assert words in typed(*line.split(), status=status).err
    assert full.write.called  # type: ignore[attr-defined]  # the disk that is full


def test_who_is_interrupted_while_it_starts_ends_quietly(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.argv", ["armctl", "robots"])
    monkeypatch.setattr("armctl.cli.main", Mock(side_effect=KeyboardInterrupt))
    assert started() == 130


def test_who_closed_stdin_has_no_keys(monkeypatch: pytest.MonkeyPatch, typed: Typed) -> None:
    monkeypatch.setattr("sys.stdin", None)
    assert "nobody can be asked" in typed("teach", "x", status=1).err
    with keys(None) as pressed:
        assert pressed.wait(0.0) == ""


@pytest.mark.parametrize(("status", "line", "text"), refusals("anywhere"))
def test_what_is_refused_is_a_clear_sentence_and_an_exit_status(
    status: int, line: str, text: str, typed: Typed
) -> None:
    said = typed(*line.split(), status=status)
    assert said.out == ""
    assert text in said.err
    assert "Traceback" not in said.err


def test_a_file_that_is_no_log_is_refused(tmp_path: Path, typed: Typed) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(b"not an mcap file at all")
    assert str(path) in typed("replay", path, "--check", status=1).err


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
