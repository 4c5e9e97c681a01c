from pathlib import Path

import pytest

from tests.cli.conftest import Answer, Typed


@pytest.fixture
def prefix(tmp_path: Path) -> str:
    program = tmp_path / "opt" / "bin" / "armctl"
    program.parent.mkdir(parents=True)
    program.touch()
    return str(program.parent.parent)


def test_a_dry_run_says_everything_and_does_nothing(tmp_path: Path, prefix: str, typed: Typed) -> None:
    root = tmp_path / "root"
    said = typed("install", "--prefix", prefix, "--dry-run", "--root", root)
    assert "would write /etc/systemd/system/armctl.service" in said.out
    assert not root.exists()


def test_install_and_uninstall_below_a_root(tmp_path: Path, prefix: str, typed: Typed, answer: Answer) -> None:
    told = answer("install", "--prefix", prefix, "--root", tmp_path)
    assert told["done"]
    assert {"act": "write /etc/udev/rules.d/60-armctl.rules", "due": True} in told["acts"]
    assert (tmp_path / "etc/systemd/system/armctl.service").is_file()
    assert "left: /etc/armctl" in typed("uninstall", "--root", tmp_path).out
    assert not (tmp_path / "etc/systemd/system/armctl.service").exists()


def test_an_unknown_port_is_wrong_usage(tmp_path: Path, prefix: str, typed: Typed) -> None:
    said = typed("install", "--prefix", prefix, "--root", tmp_path, "--port", "/dev/no-such-port", status=2)
    assert "no such serial device" in said.err
