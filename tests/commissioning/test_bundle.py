import os
from pathlib import Path

import pytest

from armctl.commissioning import bundle
from armctl.config import Config
from armctl.errors import ArmctlError


@pytest.fixture
def config(tmp_path: Path) -> Config:
    (tmp_path / "logs").mkdir()
    return Config(data_dir=str(tmp_path))


def test_the_newest_logs_that_fit_are_taken(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "LOG_BYTES", 25)
    for age_s, name in enumerate(("new.mcap.part", "middle.mcap", "old.mcap")):
        log = tmp_path / "logs" / name
        log.write_bytes(b"0123456789")
        os.utime(log, (1e9 - age_s, 1e9 - age_s))
    assert [log.name for log in bundle.newest_logs(tmp_path / "logs")] == ["new.mcap.part", "middle.mcap"]


def test_secrets_and_the_home_folder_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("HOME", "/home/evelyn")
    monkeypatch.setenv("LOGNAME", "evelyn")
    told = 'web_token: abc\n  "password": "x",\nport: /home/evelyn/servos\nby evelyn\nmonkey business: 1\n'
    text = bundle.redacted(told)
    assert "abc" not in text
    assert '"x"' not in text
    assert "evelyn" not in text
    assert "port: ~/servos" in text


def test_a_folder_that_cannot_be_written_is_told(config: Config, tmp_path: Path) -> None:
    with pytest.raises(ArmctlError, match="cannot be written"):
        bundle.write(tmp_path / "no" / "such" / "folder.zip", config, "", None, lambda part: None)


def test_the_computer_s_name_and_people_s_folders_and_ports_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("socket.gethostname", lambda: "lab-7")
    told = "on lab-7: /dev/serial/by-id/usb-FTDI_FT4THUX8-if00-port0, /home/eve/arm.yaml, /run/user/1000/armctl.sock"
    text = bundle.redacted(told)
    assert text == "on (host): ~, ~/arm.yaml, ~/armctl.sock"
