"""Where a daemon listens, and what it tells the service manager that started it."""

import os
import signal
import socket
import time
from pathlib import Path

import pytest

from armctl.errors import ConfigError, RequestRefused
from armctl.host import service_manager
from armctl.host.daemon import listening_at
from tests.host.peers import PATIENCE_S
from tests.host.test_daemon import running

# -------------------------------------------------------------------------------------------------- socket


def test_a_second_daemon_on_a_socket_is_refused(tmp_path: Path) -> None:
    with (
        listening_at(tmp_path / "s"),
        pytest.raises(RequestRefused, match="another daemon"),
        listening_at(tmp_path / "s"),
    ):
        pass
    assert not (tmp_path / "s").exists()


def test_a_socket_nobody_serves_is_replaced(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as old:
        old.bind(str(tmp_path / "s"))
    with listening_at(tmp_path / "s"), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.connect(str(tmp_path / "s"))
    assert not (tmp_path / "s").exists()


def test_a_file_in_the_socket_s_place_is_left_alone(tmp_path: Path) -> None:
    path = tmp_path / "s"
    path.write_text("precious")
    with pytest.raises(ConfigError, match="in use"), listening_at(path):
        pass
    assert path.read_text() == "precious"


def test_a_path_too_long_for_a_socket_is_a_configuration_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="too long"), listening_at(tmp_path / ("x" * 120)):
        pass


# ------------------------------------------------------------------------------------------ service manager


@pytest.mark.parametrize("abstract", [True, False])
def test_the_service_manager_is_told(abstract: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    address = f"@armctl-test-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + address[1:] if abstract else address)
        manager.settimeout(PATIENCE_S)
        monkeypatch.setenv("NOTIFY_SOCKET", address)
        service_manager.notify("READY=1")
        assert manager.recv(100) == b"READY=1"


def test_without_a_service_manager_nothing_is_told(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    service_manager.notify("READY=1")
    monkeypatch.setenv("NOTIFY_SOCKET", str(tmp_path / "nobody"))
    service_manager.notify("READY=1")


async def test_the_daemon_tells_ready_watchdog_and_stopping(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    told: list[str] = []
    monkeypatch.setattr(service_manager, "notify", told.append)
    async with running():
        pass
    assert set(told) == {"WATCHDOG=1", "READY=1", "STOPPING=1"}
    assert told.index("READY=1") < told.index("STOPPING=1")


def test_a_port_that_is_missing_is_waited_for_and_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    port = tmp_path / "port"
    told: list[str] = []
    monkeypatch.setattr(service_manager, "notify", told.append)
    naps = iter(range(3))

    def nap(_: float) -> None:
        if next(naps) == 2:
            port.touch()

    monkeypatch.setattr(time, "sleep", nap)
    service_manager.wait_for_port(str(port))
    waits = f"READY=1\nSTATUS=waits for {port}: plug the adapter in"
    assert told == [waits, "WATCHDOG=1", "WATCHDOG=1", "STATUS="]
    service_manager.wait_for_port(str(port))
    assert len(told) == 4  # it is there: nothing to tell


def test_a_closed_terminal_ends_a_server_unless_it_is_to_outlive_one() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_DFL)
    try:
        assert signal.SIGHUP in service_manager.endings()
        signal.signal(signal.SIGHUP, signal.SIG_IGN)
        assert service_manager.endings() == (signal.SIGTERM, signal.SIGINT)
    finally:
        signal.signal(signal.SIGHUP, before)
