"""The hang proof's short form, and that its judge would notice."""

import os
import signal
import subprocess
import sys
import time
from contextlib import suppress
from pathlib import Path

import numpy as np
import pytest

from proving import busy_machine, hang
from proving.rig import Rig

TIME_S = np.arange(0.0, 1.5, 0.01)
# Longer than a silence that is told even where the machine was paused for most of it (0.3 s, and 1 s that is excused).
HUNG_S = 2.0


@pytest.mark.parametrize(("stops_s", "again_deg", "found_s"), [(0.4, 0.0, 0.4), (0.9, 0.0, 0.9), (0.3, 0.8, 1.2)])
def test_the_arm_stands_when_no_joint_moves_any_more(stops_s: float, again_deg: float, found_s: float) -> None:
    q = np.zeros((len(TIME_S), 6))
    q[:, 0] = np.radians(60.0 * np.minimum(TIME_S, stops_s))
    q[TIME_S >= 1.2, 3] = np.radians(again_deg)
    assert hang.stood_after_s(q, TIME_S) == pytest.approx(found_s, abs=0.021)


def test_every_state_meets_every_victim_in_the_full_form() -> None:
    assert hang.RUNS >= 200 == hang.RUNS // len(hang.STATES) * len(hang.STATES)
    assert set(hang.VICTIMS) == {"host", "control", "web", "simulator"}


@pytest.mark.pty
@pytest.mark.crowd
def test_a_hang_of_each_process_leaves_the_arm_safe() -> None:
    result = hang.prove(seed=1, runs=1, hours=0.0)
    assert [one["runs"] for one in result["by_victim"]] == [1] * 4
    # How long things took is judged where nothing else runs.
    unsafe = ("torque", "told from", "STOP was answered b", "faults", "silent servos", "said to be")
    assert not [told for told in result["examples"] if any(part in told for part in unsafe)]


@pytest.mark.pty
@pytest.mark.crowd
def test_a_busy_machine_is_no_hung_daemon_and_one_that_hangs_is_noticed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(busy_machine, "HOGS", 1)  # what else runs beside the tests is busy, too
    result = busy_machine.watch(seed=1, hours=6.0 / 3600.0)
    assert result["violations"] == []
    assert result["motions"]
    assert result["syncs"]

    ended = busy_machine._end

    def hung_before_its_end(running: Rig) -> None:
        os.kill(running.daemon_pid, signal.SIGSTOP)
        time.sleep(HUNG_S)
        os.kill(running.daemon_pid, signal.SIGCONT)
        assert running.client.call("status")["state"] == "holding"
        # A disk as slow as this one has not taken the word yet, and is waited for no longer than 2 s at the end.
        while not busy_machine._log(running.socket.parent)[1]:
            time.sleep(0.2)
        ended(running)

    monkeypatch.setattr(busy_machine, "_end", hung_before_its_end)
    [violation] = busy_machine.watch(seed=1, hours=1.0 / 3600.0)["violations"]
    assert "tell of HOST_SILENT" in violation


@pytest.mark.pty
def test_a_proof_that_is_ended_leaves_no_arm_behind(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "proving", "prove", "hang", "--runs", "1"]
    env = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path), "TMPDIR": str(tmp_path)}
    proof = subprocess.Popen(command, env=env)
    try:
        deadline_s = time.monotonic() + 60.0
        while not any(tmp_path.glob("armctl-*/daemon.sock")) and time.monotonic() < deadline_s:
            time.sleep(0.05)
        assert processes_of(tmp_path), "no arm was started"
        proof.terminate()
        assert proof.wait(60.0) == 128 + signal.SIGTERM
    finally:
        proof.kill()
    assert processes_of(tmp_path) == []


def processes_of(folder: Path) -> list[str]:
    """Command lines of processes that work in a folder."""
    found = []
    for one in Path("/proc").glob("[0-9]*/cmdline"):
        with suppress(OSError):
            found.append(one.read_bytes().decode(errors="replace"))
    return [line for line in found if str(folder) in line]
