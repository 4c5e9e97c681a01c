import shutil

import pytest

from proving import service_words


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd-analyze is not on this machine")
def test_systemd_finds_nothing_to_say_of_the_units_and_little_exposure() -> None:
    checks = list(service_words.units())
    assert len(checks) == 4
    assert [check for check in checks if not check["ok"]] == []


@pytest.mark.pty
def test_the_daemon_keeps_the_service_protocol() -> None:
    checks = list(service_words.protocol(1))
    assert [check for check in checks if not check["ok"]] == []
    assert len(checks) == 6
