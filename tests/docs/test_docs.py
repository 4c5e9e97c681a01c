"""Every command and every Python example of the pages is run, in order, as it stands.

A block's language says what it needs: `sh` a daemon on simulated servos, `sh port` the servos alone, `sh offline`
nothing, `sh simulator` and `sh daemon` are the programs themselves. Real ports become the simulator's.
"""

from __future__ import annotations

import os
import re
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import pytest

from armctl.cli.help import DOCS, TOPICS, page
from armctl.config import load_arm
from armctl.control.faults import CODES, NEXT, WHAT
from armctl.demo import program

BLOCK = re.compile(r"^```(\w+)?( \w+)?\n(.*?)^```", re.MULTILINE | re.DOTALL)
RUN_PAGES = ("start", "arm", "api", "new-arm")
TIMEOUT_S = 110


@dataclass
class Stand:
    """A simulator and a daemon, started when a block needs them."""

    folder: Path
    programs: ExitStack = field(default_factory=ExitStack)
    running: str = ""

    @property
    def port(self) -> Path:
        return self.folder / "servos"

    def need(self, what: str) -> None:
        if what == self.running:
            return
        self.programs.close()
        log = self.folder / "programs.log"
        if what in ("port", "daemon"):
            self.programs.enter_context(program(log, "sim", "--link", str(self.port), "--seed", "2"))
        if what == "daemon":
            self.programs.enter_context(program(log, "daemon", "--port", str(self.port)))
        self.running = what

    def shell(self, text: str) -> subprocess.CompletedProcess[str]:
        text = re.sub(r"/tmp/armctl-servos|/dev/ttyUSB0", str(self.port), text)
        text = text.replace("--port PORT", f"--port {self.port}")
        path = f"{Path(sys.executable).parent}:{os.environ['PATH']}"
        return subprocess.run(
            ["bash", "-e", "-o", "pipefail", "-c", text],
            cwd=self.folder,
            env={**os.environ, "PATH": path},
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
        )


@pytest.fixture
def stand(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Stand]:
    for name in list(os.environ):
        if name.startswith(("ARMCTL_", "NOTIFY_", "XDG_")):
            monkeypatch.delenv(name)
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        (tmp_path / name.lower()).mkdir()
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "daemon.sock"))
    stand = Stand(tmp_path)
    yield stand
    stand.programs.close()


@pytest.mark.pty
@pytest.mark.timeout(240)
@pytest.mark.parametrize("topic", RUN_PAGES)
def test_what_a_page_says_to_type_works(topic: str, stand: Stand) -> None:
    ran = 0
    for language, needs, text in BLOCK.findall(page(topic)):
        if language == "yaml":
            (stand.folder / "arm.yaml").write_text(text)
            load_arm(str(stand.folder / "arm.yaml"))
        elif language == "python":
            stand.need("daemon")
            (stand.folder / "example.py").write_text(text)
            done = stand.shell(f"{sys.executable} example.py")
            assert done.returncode == 0, done.stderr
        elif needs.strip() in ("simulator", "daemon"):
            stand.need("daemon")
            [command] = text.strip().splitlines()
            assert command.startswith(("armctl sim ", "armctl daemon "))
        else:
            stand.need(needs.strip() or "daemon")
            # The doctor may find something: exit status 1.
            text = re.sub(r"^(armctl doctor.*)$", r"\1 || [ $? -eq 1 ]", text, flags=re.MULTILINE)
            done = stand.shell(text)
            assert done.returncode == 0, f"{text}\n{done.stdout}{done.stderr}"
        ran += 1
    assert ran


def test_every_block_of_every_page_is_run_or_is_none_of_ours() -> None:
    for path in DOCS.glob("*.md"):
        if path.stem in RUN_PAGES or path.stem == "logs":  # whose commands have a test of their own
            continue
        assert not [text for language, _, text in BLOCK.findall(path.read_text()) if language in ("sh", "python")], path


def test_every_page_is_a_topic_and_every_topic_a_page() -> None:
    assert {path.stem for path in DOCS.glob("*.md")} <= set(TOPICS)
    assert all(page(topic).startswith("# ") for topic in TOPICS)


def test_the_page_of_faults_is_complete() -> None:
    assert set(NEXT) == set(WHAT) == set(CODES)
    text = page("faults")
    assert all(f"## {code}\n" in text for code in CODES)


def test_the_page_of_the_configuration_names_every_key() -> None:
    from armctl.config import ArmConfig, Config, JointConfig, LogConfig

    text = page("configuration")
    for model in (Config, LogConfig, ArmConfig, JointConfig):
        assert all(f"| `{key}` |" in text for key in model.model_fields)
    assert "> 0" in text
