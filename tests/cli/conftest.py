"""A command typed in this process, and what it says."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from armctl.cli import main


@dataclass(frozen=True)
class Said:
    """What a command left behind."""

    status: int
    out: str
    err: str


Typed = Callable[..., Said]
Answer = Callable[..., dict[str, Any]]


@pytest.fixture
def typed(capsys: pytest.CaptureFixture[str]) -> Typed:
    """Type a command; what it said."""

    def run(*words: object) -> Said:
        return Said(main([*map(str, words)]), *capsys.readouterr())

    return run


@pytest.fixture
def answer(typed: Typed) -> Answer:
    """Type a command with `--json`; the one object that it prints."""

    def run(*words: object, status: int = 0) -> dict[str, Any]:
        said = typed(*words, "--json")
        assert said.status == status, said.err
        (line,) = said.out.splitlines()
        found: dict[str, Any] = json.loads(line)
        return found

    return run


@pytest.fixture
def own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the user is read or written, and no daemon runs."""
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "nobody.sock"))
