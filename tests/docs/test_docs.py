"""Every command and every Python example of the pages is run, in order, as it stands.

A block's language says what it needs: `sh` a daemon on simulated servos, `sh port` the servos alone, `sh offline`
nothing, `web` the dashboard as well; `sh simulator`, `sh daemon` and `sh dashboard` are the programs themselves. Real
ports become the simulator's.
"""

import os
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
from tempfile import TemporaryDirectory

import click
import pytest

from armctl.cli import cli
from armctl.cli.help import DOCS, TOPICS, page
from armctl.cli.processes import DEFAULT_LINK
from armctl.client import Client
from armctl.control.faults import CODES, FAULTS
from armctl.files import load_arm
from armctl.lab.demo import started
from tests.terminal import CTRL_C, PATH, free_port, shell

BLOCK = re.compile(r"^```(\w+)?( \w+)?\n(.*?)^```", re.MULTILINE | re.DOTALL)
README = (DOCS.parent.parent / "README.md").read_text()
RUN_PAGES = ("start", "arm", "api", "new-arm")
TIMEOUT_S = 600
# Columns: `armctl help` sets a space before and behind.
WIDEST_CODE = 78


@dataclass
class Stand:
    """A simulator and a daemon, started when a block needs them."""

    folder: Path
    # As short as a runtime folder is: a socket's name has 107 bytes, and a test's folder may be as long alone.
    runtime: Path
    programs: ExitStack = field(default_factory=ExitStack)
    running: str = ""

    web_port: int = 0

    @property
    def port(self) -> Path:
        """Where `armctl sim` publishes its port when nothing else is said."""
        return self.runtime / DEFAULT_LINK

    def need(self, what: str) -> None:
        if what == self.running:
            return
        self.programs.close()
        log = self.folder / "programs.log"
        if what in ("port", "daemon", "web"):
            self.programs.enter_context(started(log, "sim", "--link", str(self.port), "--seed", "2"))
        if what in ("daemon", "web"):
            self.programs.enter_context(started(log, "daemon", "--port", str(self.port)))
        if what == "web":
            self._serve(log)
        self.running = what

    def _serve(self, log: Path) -> None:
        """The dashboard on a free port; what it printed stands in the file `address`."""
        self.web_port = free_port()
        with log.open("a") as words:
            command = [sys.executable, "-m", "armctl", "web", "--port", str(self.web_port)]
            served = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=words, text=True)
            web = self.programs.enter_context(served)
        self.programs.callback(web.terminate)
        assert web.stdout is not None
        (self.folder / "address").write_text(web.stdout.readline())

    def shell(self, text: str) -> subprocess.CompletedProcess[str]:
        text = re.sub(r"/tmp/armctl-servos|/dev/ttyUSB0", str(self.port), text)
        text = text.replace("--port PORT", f"--port {self.port}").replace(":8080/", f":{self.web_port}/")
        command, environment = ["bash", "-e", "-o", "pipefail", "-c", text], {**os.environ, "PATH": PATH}
        return subprocess.run(
            command, cwd=self.folder, env=environment, capture_output=True, text=True, timeout=TIMEOUT_S
        )


@pytest.fixture
def stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    for name in list(os.environ):
        if name.startswith(("ARMCTL_", "NOTIFY_", "XDG_")):
            monkeypatch.delenv(name)
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME"):
        (tmp_path / name.lower()).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    with TemporaryDirectory(prefix="armctl-") as runtime:
        monkeypatch.setenv("XDG_RUNTIME_DIR", runtime)
        monkeypatch.setenv("ARMCTL_SOCKET", f"{runtime}/daemon.sock")
        stand = Stand(tmp_path, Path(runtime))
        yield stand
        stand.programs.close()


@pytest.mark.pty
@pytest.mark.parametrize("topic", RUN_PAGES)
def test_what_a_page_says_to_type_works(topic: str, stand: Stand) -> None:
    ran = 0
    for language, needs, text in BLOCK.findall(page(topic)):
        if language == "yaml":
            (stand.folder / "arm.yaml").write_text(text)
            load_arm(str(stand.folder / "arm.yaml"))
        elif language == "python":
            stand.need(needs.strip() or "daemon")
            (stand.folder / "example.py").write_text(text)
            done = stand.shell(f"{sys.executable} example.py")
            assert done.returncode == 0, f"{done.stderr}{(stand.folder / 'programs.log').read_text()}"
        elif needs.strip() in ("simulator", "daemon"):
            stand.need("daemon")
            [command] = text.strip().splitlines()
            assert command.split()[1] in ("sim", "daemon")
        elif needs.strip() == "dashboard":
            assert text.strip() == "armctl web > address &"
        else:
            stand.need(needs.strip() or "daemon")
            # The doctor may find something: exit status 1.
            text = re.sub(r"^(armctl doctor.*)$", r"\1 || [ $? -eq 1 ]", text, flags=re.MULTILINE)
            done = stand.shell(text)
            assert done.returncode == 0, f"{text}\n{done.stdout}{done.stderr}"
        ran += 1
    assert ran


@pytest.mark.pty
def test_the_examples_in_python_run(stand: Stand) -> None:
    stand.need("daemon")
    done = stand.shell(f"{sys.executable} {DOCS}/examples/circle.py")
    assert "mm off the circle" in done.stdout, done.stderr
    with shell(stand.folder) as keys:
        since = keys.start(f"{sys.executable} {DOCS}/examples/teach.py")
        keys.until("press Enter again.", since)
        keys.press(b"\n")
        with Client() as client:
            next(snapshot for snapshot in client.subscribe() if snapshot["recording"])
        stand.shell("armctl hand --seed 1")
        for said in ("Hold it still", "Let go of it"):
            keys.press(b"\n")
            keys.until(said, since)
        stand.shell("armctl hand --let-go")
        keys.press(b"\n")
        keys.until("mm off what you did", since)


def test_a_command_to_copy_fits_a_terminal_of_80_columns() -> None:
    for path in DOCS.glob("*.md"):
        for _, _, text in BLOCK.findall(path.read_text()):
            assert max(map(len, text.splitlines())) <= WIDEST_CODE, f"{path}: {text}"


def test_every_block_of_every_page_is_run_or_is_none_of_ours() -> None:
    for path in DOCS.glob("*.md"):
        if path.stem in RUN_PAGES or path.stem == "logs":  # whose commands have a test of their own
            continue
        assert not [text for language, _, text in BLOCK.findall(path.read_text()) if language in ("sh", "python")], path


def test_what_readme_says_to_type_is_right() -> None:
    lines = re.findall(r"^    (\S.*)$", README.replace("\\\n", " "), re.MULTILINE)
    typed = [part.strip() for line in lines for part in re.split("[&;]", line.split("#")[0])]
    commands = [shlex.split(part)[1:] for part in typed if part.startswith("armctl ")]
    assert len(commands) > 20
    for words in commands:
        name, command = words[0], cli.get_command(click.Context(cli), words[0])
        assert command is not None, name
        words = [{"$A": "0.18,-0.125,0.10", "$B": "0.18,0.125,0.10"}.get(word, word) for word in words[1:]]
        command.make_context(name, words)  # raises for an option or an argument that there is not


@pytest.mark.pty
def test_the_five_minutes_of_readme_work_in_three_terminals_as_they_are_typed(stand: Stand) -> None:
    section = README.split("## Five minutes without an arm")[1].split("\n## ")[0]
    typed = re.findall(r"^    (\S.*)$", section, re.MULTILINE)
    [servos, daemon], rest = typed[2:4], typed[4:]  # the first two install the package that is tested
    assert [line.split("#")[0].split()[:2] for line in (servos, daemon)] == [["armctl", "sim"], ["armctl", "daemon"]]
    with ExitStack() as terminals:
        first, second, third = (terminals.enter_context(shell(stand.folder)) for _ in range(3))
        first.until("\nready ", first.start(servos))
        second.until("\nready ", second.start(daemon.replace("PORT", str(stand.port))))
        said = "".join(third.type(line) for line in rest)
        assert "Stopped" not in said
        assert said.count("Done") == 2, said  # both times teaching in the background
        assert "by the encoders" in said
        for running in (second, first):
            running.press(CTRL_C)
            running.until("]$ ", len(running.said))


def test_every_page_is_a_topic_and_every_topic_a_page() -> None:
    assert {path.stem for path in DOCS.glob("*.md")} <= set(TOPICS)  # whose pages tests/cli/test_help.py reads


def test_the_page_of_faults_is_complete() -> None:
    assert all(kind.what and kind.remedy for kind in FAULTS)
    text = page("faults")
    assert all(f"## {code}\n" in text for code in CODES)


def test_the_page_of_the_configuration_names_every_key() -> None:
    from armctl.config import ArmConfig, Config, JointConfig, LogConfig

    text = page("configuration")
    for model in (Config, LogConfig, ArmConfig, JointConfig):
        assert all(f"- `{key}` (" in text for key in model.model_fields)
    assert "- `quota_bytes` (whole number, default 4294967296, ≥ 1048576). What all finished logs together may" in text
    assert "- `arm_id` (text, required)" in text
