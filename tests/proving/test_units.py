"""The short form of `tools/prove units`: a newcomer's installation on a booted machine; and what the machine leaves."""

from pathlib import Path

import pytest

from proving import units
from proving.installed import Installed
from proving.machine import MEMORY, machine, why_not
from proving.unit_story import SHORT, STORIES, Told

CAP_SYS_MODULE, CAP_SYS_RAWIO, CAP_SYS_TIME = 16, 17, 25
booted = pytest.mark.skipif(bool(why_not()), reason=why_not() or "it can be booted")


def test_every_story_has_a_name_of_its_own_and_there_are_enough() -> None:
    names = [name for name, _ in STORIES]
    assert len(set(names)) == len(names) >= 40
    assert set(names) > SHORT


def test_a_story_that_breaks_off_is_a_violation() -> None:
    def breaks(_: Installed) -> Told:
        raise KeyError("answer")

    here = Installed.__new__(Installed)
    [check] = units.told(here, [("breaks", breaks)], lambda _: None)
    assert not check["ok"]
    assert "KeyError" in check["value"]


@booted
def test_a_machine_writes_nothing_here_and_leaves_nothing() -> None:
    before = {path.name for path in MEMORY.iterdir()}
    with machine("test") as made:
        made.write("/etc/only-there", "x")
        assert made.read("/etc/only-there") == "x"
        made.power_cut()
        made.boot()
        assert made.read("/etc/only-there") == "x"  # what was written stays
        # The clock and the kernel are everybody's: neither the machine nor a command in it may reach them.
        for status in (made.read("/proc/1/status"), made.read("/proc/self/status")):
            [bounds] = [int(line.split()[1], 16) for line in status.splitlines() if line.startswith("CapBnd")]
            assert not bounds & (1 << CAP_SYS_TIME | 1 << CAP_SYS_MODULE | 1 << CAP_SYS_RAWIO)
        assert made.read("/proc/1/comm").strip() == "systemd"
    assert not Path("/etc/only-there").exists()
    assert {path.name for path in MEMORY.iterdir() if path.name.startswith("armctl-test")} <= before


@booted
@pytest.mark.pty
def test_a_newcomer_gets_from_the_wheel_to_a_dashboard_and_back() -> None:
    checks = units.short(1)
    assert [check for check in checks if not check["ok"]] == []
    assert len(checks) == len(SHORT)
