"""A command typed in this process, and what it says."""

import json
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from armctl.cli import main
from armctl.client import Client
from tests.genetic import hand
from tests.host.doubles import write_take


@dataclass(frozen=True)
class Said:
    """What a command left behind."""

    out: str
    err: str


class StandIn(Client):
    """A client without a daemon: a test says what is answered."""

    def __init__(self, *_: object, **__: object) -> None: ...

    def close(self) -> None: ...


Typed = Callable[..., Said]
Answer = Callable[..., dict[str, Any]]


def refusals(where: str) -> list[tuple[int, str, str]]:
    """Exit status, line and words of everything in `refusals.yaml` that is refused there."""
    table = yaml.safe_load(Path(__file__).with_name("refusals.yaml").read_text(encoding="utf-8"))[where]
    return [(status, line, words) for status, rows in table.items() for line, words in rows.items()]


@pytest.fixture
def typed(capsys: pytest.CaptureFixture[str]) -> Typed:
    """Type a command that ends with this status; what it said."""

    def run(*words: object, status: int = 0) -> Said:
        found = main([*map(str, words)])
        said = Said(*capsys.readouterr())
        assert found == status, said.err
        return said

    return run


@pytest.fixture
def answer(typed: Typed) -> Answer:
    """Type a command with `--json`; the one object that it prints."""

    def run(*words: object, status: int = 0) -> dict[str, Any]:
        (line,) = typed(*words, "--json", status=status).out.splitlines()
        found: dict[str, Any] = json.loads(line)
        return found

    return run


@pytest.fixture
def own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing of the user is read or written, and no daemon runs."""
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "nobody.sock"))


@pytest.fixture(scope="module")
def takes(tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """Files of three takes that the simulated hand guided along one line."""
    folder = tmp_path_factory.mktemp("takes")
    for number, samples in enumerate(hand.recordings(3, seed=1)):
        write_take(folder / f"take-{number}.mcap", samples, hand.arm())
    return [str(path) for path in sorted(folder.glob("*.mcap"))]
