from __future__ import annotations

import json
from pathlib import Path

import pytest

from armctl.cli import main


@pytest.fixture
def prefix(tmp_path: Path) -> str:
    program = tmp_path / "opt" / "bin" / "armctl"
    program.parent.mkdir(parents=True)
    program.touch()
    return str(program.parent.parent)


def test_a_dry_run_says_everything_and_does_nothing(
    tmp_path: Path, prefix: str, capsys: pytest.CaptureFixture[str]
) -> None:
    root = tmp_path / "root"
    assert main(["install", "--prefix", prefix, "--dry-run", "--root", str(root)]) == 0
    assert "would write /etc/systemd/system/armctl.service" in capsys.readouterr().out
    assert not root.exists()


def test_install_and_uninstall_below_a_root(tmp_path: Path, prefix: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["install", "--prefix", prefix, "--root", str(tmp_path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    assert told["done"]
    assert {"act": "write /etc/udev/rules.d/60-armctl.rules", "due": True} in told["acts"]
    assert (tmp_path / "etc/systemd/system/armctl.service").is_file()
    assert main(["uninstall", "--root", str(tmp_path)]) == 0
    assert "left: /etc/armctl" in capsys.readouterr().out
    assert not (tmp_path / "etc/systemd/system/armctl.service").exists()


def test_an_unknown_port_is_wrong_usage(tmp_path: Path, prefix: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["install", "--prefix", prefix, "--root", str(tmp_path), "--port", "/dev/no-such-port"]) == 2
    assert "no such serial device" in capsys.readouterr().err
