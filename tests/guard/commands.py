"""Every command with `--json` (`commands.yaml` lists them), and what of its answer must stay.

`python -m tests.guard.commands` writes `commands.json` anew. Do that only in a commit that says why the answers change.

Commands without an arm give the same answer each time: each key of it has a digest. Masked are run times, versions and
the words of errors; floats have five digits, because those after differ between processors where LAPACK is asked.
Commands on a simulated arm in real time do not: of their answers keys, types, codes and states are kept.
"""

import contextlib
import io
import json
import os
import re
import shlex
import shutil
import sys
import tempfile
from collections.abc import Callable, Iterator
from functools import reduce
from pathlib import Path
from subprocess import DEVNULL, PIPE, Popen
from typing import Any
from unittest.mock import patch

import click
import yaml

from armctl.cli import cli, main
from armctl.cli.help import DOCS
from armctl.lab.study import limits
from tests.guard.kept import FOLDER, digest, save
from tests.guard.logs import build
from tests.scenarios.bench import SHORT_DEMO, environment
from tests.terminal import free_port

FILE = "commands.json"
LINE = "--from 0.18,-0.1,0.10 --to 0.18,0.1,0.10"
SHORT = "--from 0.18,-0.03,0.10 --to 0.18,0.03,0.10"
# What is asked, by where; some of it is refused.
COMMANDS: dict[str, list[str]] = yaml.safe_load(
    (FOLDER / "commands.yaml").read_text(encoding="utf-8").replace("LINE", LINE).replace("SHORT", SHORT)
)
MASKED = (
    *("seconds", "realtime_ratio", "evaluations_per_s", "version", "commit", "sources", "host"),
    *("message", "reasons", "text", "script"),
)
DIGITS = 5
# A search that goes on from what LAPACK gave.
FEWER_DIGITS = {"reproduce 002 --quick": 2}
# Rounding errors that a text tells.
DUST = re.compile(r"\b(0\.0e\+00|\d\.\de-(1[2-9]|[2-9]\d))\b")
KEPT = ("code", "state", "name", "next")


def names(group: click.Command = cli, above: tuple[str, ...] = ()) -> Iterator[str]:
    """Every command that does something, as it is typed."""
    if not isinstance(group, click.Group):
        yield " ".join(above)
        return
    context = click.Context(group)
    for name in group.list_commands(context):
        command = group.get_command(context, name)
        assert command is not None
        yield from names(command, (*above, name))


@contextlib.contextmanager
def own_folder() -> Iterator[Path]:
    """A new folder that commands run in, and that they write to instead of the user's own."""
    with tempfile.TemporaryDirectory(prefix="armctl-") as name, contextlib.chdir(name):
        folder = Path(name)
        own = environment(folder) | {"ARMCTL_SOCKET": str(folder / "s")}
        with patch.dict(os.environ, own, clear=True):
            yield folder


def asked(line: str) -> tuple[int, Any]:
    """Exit status and answer of one command in this process; None: it printed nothing."""
    with contextlib.redirect_stdout(io.StringIO()) as said, contextlib.redirect_stderr(io.StringIO()):
        status = main([*shlex.split(line), "--json"])
    text = said.getvalue()
    return status, json.loads(text) if text else None


# ------------------------------------------------------------------------------------------- without an arm


def answers() -> dict[str, Any]:
    """The digests of all answers without an arm, by command."""
    # All effects, one after the other, take long and do the same.
    with own_folder() as folder, patch.object(limits, "EFFECTS", {"sag": limits.EFFECTS["sag"]}):
        logs = build(folder / "made")
        for name, kind in {
            "log": "running-0",
            "later": "running-1",
            "fault": "snapshot",
            "broken": "running-1",
        }.items():
            shutil.copy(logs[kind], f"{name}.mcap")
        with open("broken.mcap", "r+b") as stream:
            stream.truncate(stream.seek(0, io.SEEK_END) // 2)
        shutil.copy(FOLDER / "readings.yaml", folder)
        shutil.copy(DOCS / "examples" / "wave.yaml", folder / "program.yaml")
        return {
            line: of_answer(*asked(line), folder, FEWER_DIGITS.get(line, DIGITS)) for line in COMMANDS["without an arm"]
        }


def places(folder: Path) -> list[tuple[str, str]]:
    """Where things are on this machine, and what stands for that; the longer paths first."""
    found = {str(folder): "FOLDER", sys.prefix: "PREFIX", str(FOLDER.parents[1]): "ROOT"}
    return sorted(found.items(), key=lambda place: -len(place[0]))


def of_answer(status: int, answer: Any, folder: Path, digits: int) -> dict[str, Any]:
    """Digests of an answer, key by key."""
    found = {
        key: digest(DUST.sub("0", reduce(lambda said, name: said.replace(*name), places(folder), text)))
        for key, value in (answer or {}).items()
        if (text := json.dumps(plain(key, value, digits), sort_keys=True))
    }
    return found | {"exit status": status}


def plain(key: str, value: Any, digits: int) -> Any:
    """A value without what differs from run to run, or from processor to processor."""
    if key in MASKED:
        return type(value).__name__
    if isinstance(value, float):
        return 0.0 if abs(value) < 1e-9 else float(f"{value:.{digits}g}")
    if isinstance(value, dict):
        return {name: plain(name, item, digits) for name, item in value.items()}
    return [plain("", item, digits) for item in value] if isinstance(value, list) else value


# --------------------------------------------------------------------------------------- on a simulated arm


def skeleton(value: Any, key: str = "") -> Any:
    """Keys and types of an answer; of a list each kind of element once."""
    if isinstance(value, dict):
        return {name: skeleton(item, name) for name, item in value.items()}
    if isinstance(value, list):
        kinds = {json.dumps(skeleton(item), sort_keys=True) for item in value}
        return [json.loads(kind) for kind in sorted(kinds)]
    if isinstance(value, str) and key in KEPT:
        return value
    return "number" if isinstance(value, int | float) and not isinstance(value, bool) else type(value).__name__


@contextlib.contextmanager
def started(line: str) -> Iterator[Callable[[], Any]]:
    """A command beside this process; call what it yields for the next line that it prints."""
    command = [sys.executable, "-m", "armctl", *shlex.split(line), "--json"]
    with Popen(command, stdout=PIPE, stderr=DEVNULL, text=True, start_new_session=True) as process:
        printed = process.stdout
        assert printed is not None
        try:
            yield lambda: json.loads(printed.readline())
        finally:
            process.terminate()


class Session:
    """Commands on a simulated arm, and the skeletons of their answers."""

    def __init__(self) -> None:
        self.found: dict[str, Any] = {}

    def note(self, line: str, status: int, answer: Any) -> None:
        """Keep the skeleton of one answer."""
        self.found[line] = {"exit status": status, "answer": skeleton(answer)}

    def ask(self, *lines: str, more: str = "") -> None:
        """Commands one after another, all with the same options at their end."""
        for line in lines:
            self.note(line, *asked(f"{line} {more}"))

    def until(self, state: str) -> None:
        """Return when the arm is in this state."""
        with started("watch") as snapshot:
            while snapshot()["state"] != state:
                pass

    def first(self, name: str, options: str = "") -> None:
        """The first line of a command that runs until it is ended."""
        with started(f"{name} {options}") as line:
            self.note(name, 0, line())


def on_an_arm() -> dict[str, Any]:
    """One session on `armctl sim`, from the bus to a run and back."""
    session = Session()
    with own_folder(), started("sim --link port") as simulator:
        session.note("sim", 0, simulator())
        session.ask(*COMMANDS["on the port"], more="--port port")
        session.ask(*COMMANDS["on the simulator"], more="--link port")
        with started("daemon --port port") as daemon:
            session.note("daemon", 0, daemon())
            play(session)
    return session.found


def demonstrated(out: Path) -> tuple[int, Any]:
    """Exit status and answer of the demonstration, shortened."""
    with patch.multiple("armctl.lab.demo", **SHORT_DEMO):
        return asked(f"demo --out {out}")


def play(session: Session) -> None:
    """Everything that the daemon is asked."""
    with started(f"teach take --takes 1 {LINE} --yes") as taught:
        session.until("teaching")
        session.ask(f"hand {LINE} --link port")
        session.note("teach", 0, taught())
    session.ask(*COMMANDS["limp"])
    session.ask("torque on")
    session.ask("hand --let-go --link port")
    session.ask(*COMMANDS["holding"])
    with started("run plan.json") as ran:
        session.until("moving")
        for line in ("pause", "rate 0.9", "resume"):
            session.note(f"{line} (in a run)", *asked(line))
        session.note("run", 0, ran())
    session.first("watch")
    session.first("live", "--port 0")
    session.first("web", f"--port {free_port()}")
    session.ask(*COMMANDS["at last"])


if __name__ == "__main__":
    demo = Session()
    with own_folder() as folder:
        demo.note("demo", *demonstrated(folder / "demo"))
    save(FILE, {"answers": answers(), "on an arm": on_an_arm(), "demonstrated": demo.found})
