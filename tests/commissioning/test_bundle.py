import json
import os
import zipfile
from pathlib import Path

import pytest

from armctl.cli import main
from armctl.commissioning import bundle
from armctl.config import Config
from armctl.errors import ArmctlError


@pytest.fixture
def config(tmp_path: Path) -> Config:
    (tmp_path / "logs").mkdir()
    return Config(data_dir=str(tmp_path))


def test_a_report_holds_every_part_even_where_nothing_runs(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "nobody.sock"))
    monkeypatch.setenv("XDG_DATA_HOME", str(tmp_path))
    logs = tmp_path / "armctl" / "logs"
    logs.mkdir(parents=True)
    (logs / "a.mcap").write_bytes(b"log")
    path = tmp_path / "report.zip"
    assert main(["report", "--out", str(path), "--json"]) == 0
    told = json.loads(capsys.readouterr().out)
    texts = ["versions.json", "configuration.json", "calibration.yaml", "status.json", "doctor.json", "journal.txt"]
    assert told == {"path": str(path), "files": [*texts, "logs/a.mcap"]}
    with zipfile.ZipFile(path) as archive:
        assert "numpy" in json.loads(archive.read("versions.json"))["packages"]
        assert "NoDaemon" in archive.read("status.json").decode()
        assert "checks" in archive.read("doctor.json").decode() or "port" in archive.read("doctor.json").decode()
        assert b"arm_id" in archive.read("calibration.yaml")
    assert main(["report", "--out", str(path)]) == 1
    assert "exists" in capsys.readouterr().err


def test_the_newest_logs_that_fit_are_taken(config: Config, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bundle, "LOG_BYTES", 25)
    for age_s, name in enumerate(("new.mcap.part", "middle.mcap", "old.mcap")):
        log = tmp_path / "logs" / name
        log.write_bytes(b"0123456789")
        os.utime(log, (1e9 - age_s, 1e9 - age_s))
    assert [log.name for log in bundle.newest_logs(tmp_path)] == ["new.mcap.part", "middle.mcap"]


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
        bundle.write(tmp_path / "no" / "such" / "folder.zip", config, "", lambda part: None)
