"""`armctl program`: steps that are recorded, checked as a whole, and run by the daemon."""

import json
import sys
from functools import partial
from pathlib import Path
from typing import Any

import click

from armctl.cli.keys import TerminalKeys, attended, keys
from armctl.cli.output import CONFIG, SOCKET, Output, command
from armctl.cli.teach import ENTER, Tool, record_take
from armctl.client import Client
from armctl.errors import ConfigError, LogError, NoDaemon
from armctl.files import data_dir, read_text

# Key -> the step that it adds as it is.
PLAIN: dict[str, dict[str, Any]] = {"g": {"grip": "close"}, "o": {"grip": "open"}, "w": {"wait_s": 1.0}}
HELP = "Enter: a move to here; g: grip; o: open; w: wait a second; t: a take; u: undo; q: done"
# Of angles in a file: a thousandth of a servo's tick.
DECIMALS = 5


@click.group("program")
def program_command() -> None:
    """A program: steps that the arm does one after another.

    Example: armctl program run wave.yaml
    """


def _read(file: Path) -> dict[str, Any]:
    """The program in a file, by whose name it is known, as the daemon is sent it.

    Raises:
        ConfigError: it is none, or too long to be sent.
    """
    from armctl.host.jsonrpc import MAX_LINE_BYTES
    from armctl.trajectory.program import program_from_text

    program = program_from_text(read_text(file, "program"), str(file), file.stem).model_dump(exclude_none=True)
    if (size := len(json.dumps(program, separators=(",", ":"))) + 256) > MAX_LINE_BYTES:
        raise ConfigError(str(file), "steps", f"{size} bytes, at most {MAX_LINE_BYTES}", "make two programs of it")
    return program


def _in_words(found: dict[str, Any]) -> str:
    """Every step in a line, and where a run would go on."""
    lines = [f"{'ok' if row['ok'] else 'NO':<3} {row['name']:<12} {row['text']}" for row in found["steps"]]
    return "\n".join(lines + [f"a run goes on at step {found['resumed_at']}"] * (found["resumed_at"] is not None))


@command("check", SOCKET, CONFIG, group=program_command)
def program_check(output: Output, file: Path) -> int:
    """Check the program in FILE as a whole: every motion from where the step before it ends, and both branches.

    It begins where the daemon's arm is; without a daemon, at the rest pose of the configured arm. Nothing moves. Exit
    status 1 if a step cannot be done.

    Example: armctl program check wave.yaml
    """
    program = _read(file)
    try:
        found = output.ask("program_check", **program)
    except NoDaemon:
        found = _check_here(output, program)
    output.answer(found, _in_words(found))
    return 0 if all(row["ok"] for row in found["steps"]) else 1


def _check_here(output: Output, program: dict[str, Any]) -> dict[str, Any]:
    from armctl.host.programs import Site, checked
    from armctl.kinematics import robots
    from armctl.trajectory.program import Program

    arm, config = output.arm, output.config
    site = Site(arm, robots.get(arm.robot, arm.lengths_m), config.period_s, data_dir(config) / "recordings")
    output.say(f"no daemon: from the rest pose of {arm.arm_id}")
    return checked(site, Program(**program), tuple(joint.rest_rad for joint in arm.joints))


@command("run", SOCKET, group=program_command)
def program_run(output: Output, file: Path, from_step: str | None) -> int:
    """Run the program in FILE, step by step, as one recording; Ctrl-C stops the arm.

    All of it is checked before anything moves. What was stopped goes on with the step that was under way, also after a
    fault or a power cut, or says why not; `--from 1` begins anew. STEP is a name or a number such as 4.2, and 4.2@3 in
    the third turn of a repeat. Exit status 1 if it did not come to its end.

    Example: armctl program run wave.yaml --from 1
    """
    again = f"`armctl program run {file}` goes on with that step"
    result = output.carry_out("running", "program_run", {"from_step": from_step, **_read(file)}, kept=f"; {again}")
    words, ended = f"{result['recording']}: {len(result['steps'])} steps done", result["ended"]
    if ended:
        words = f"ended at step {result['stands_at']}: {ended['code']}: {ended['text']}; {again}"
    output.answer(result, words)
    return 1 if ended else 0


@command("record", SOCKET, group=program_command)
def program_record(output: Output, file: Path, places: int | None) -> None:
    """Make a program, place by place, while you guide the limp arm, or while it holds and you jog it elsewhere.

    Enter takes the present pose as a move. g and o have the gripper close and open, w waits a second, t records a take
    (the arm has to be limp) and plays it, u takes the last step back, and q ends. FILE is written after every step.
    Where nobody can press a key (no terminal, or in the background), a place is taken wherever the tool rests for half
    a second. This command never makes the arm limp: `armctl release` does.

    Example: armctl program record tidy-up.yaml
    """
    if file.exists():
        raise LogError(f"{file} exists; choose another name, or delete it")
    with output.client() as client, keys(sys.stdin) as pressed:
        output.after_interrupt = f"the arm stays as it is, and every step so far is in {file}"
        recorder = Recorder(output, client, file, pressed)
        output.say(HELP if attended(sys.stdin) else "nobody can press a key: rest the tool at each place")
        key = ""
        while key != "q" and len(recorder.steps) != places:
            if key := pressed.wait(1.0) if attended(sys.stdin) else settled(output):
                recorder.press(key)
        found = client.call("program_check", **_read(file)) if recorder.steps else {"steps": [], "resumed_at": None}
    output.answer({"path": str(file), **found}, _in_words(found))


def settled(output: Output) -> str:
    """Wait until the tool has moved and rests, where nobody can press a key; the key for that."""
    with output.client() as watcher:
        tool = Tool(output, watcher, str)
        tool.states = None
        tool.settle(None)
    return "\n"


class Recorder:
    """A program that is made key by key, and is in its file after each."""

    def __init__(self, output: Output, client: Client, file: Path, pressed: TerminalKeys) -> None:
        self.steps: list[dict[str, Any]] = []
        self._output, self._client, self._file, self._pressed = output, client, file, pressed

    def press(self, key: str) -> None:
        """Do what a key is for."""
        step = self._place() if key in ENTER else self._take() if key == "t" else PLAIN.get(key)
        if step:
            self.steps.append(step)
        elif key == "u":
            del self.steps[-1:]
        else:
            if key not in {"q", "t", *ENTER}:
                self._output.say(HELP)
            return
        import yaml

        from armctl.recording.disk import put

        put(self._file, yaml.safe_dump({"steps": self.steps}, sort_keys=False, default_flow_style=None, width=1000))
        self._output.say(f"{len(self.steps)} steps" + (f"; the last: {next(iter(step))}" if step else ""))

    def _place(self) -> dict[str, Any] | None:
        angles = [joint["position_rad"] for joint in self._client.call("status")["joints"]]
        if None in angles:
            self._output.say("not every servo has answered yet; see `armctl status`")
            return None
        return {"move": {"joints_rad": [round(angle, DECIMALS) for angle in angles]}}

    def _take(self) -> dict[str, Any] | None:
        """Record a take of the limp arm; the step that plays it."""
        snapshot = self._client.call("status")
        if snapshot["state"] != "off":
            self._output.say(f"a take needs a limp arm, and it is {snapshot['state']}; `armctl release`, then t again")
            return None
        taken = {recording["name"] for recording in self._client.call("recordings_list")["recordings"]}
        name = next(name for number in range(1, 10_000) if (name := f"{self._file.stem}-{number}") not in taken)
        self._client.call("teach_begin", confirm=True)  # it is limp
        try:
            with self._output.client() as watcher:
                tool = Tool(self._output, watcher, partial(self._pressed.wait, 0.0))
                record_take(self._output, self._client, tool, name, tuple(snapshot["tool"]["position_m"]), {})
        finally:
            self._client.call("teach_end")
        return {"play": {"name": name}}
