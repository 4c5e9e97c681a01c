"""Processes killed and the adapter pulled out in the middle of a fast run, judged by where the arm really went.

Bounds. The goal is one tick ahead, so the last one is reached within a tick (100 ms) of being sent. Behind it every
shaft trails by what its controller needs against friction and gravity, and catches up with a time constant of about
30 ms, the last tenths of a degree in steps, as stiction lets go of them: hence 0.5 deg from the bound on. A host's
death takes up to one tick to be noticed and 200 ms to slow down on the path; 500 ms are what the fault matrix allows.
"""

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from armctl.clock import NS_PER_S
from armctl.errors import NoDaemon, RequestRefused
from armctl.recording import reader, replay
from armctl.recording.channels import CYCLE, JOINT_COMMANDS
from tests.host.doubles import refused
from tests.scenarios.bench import Bench, Simulator, alive, insist, line_plan

pytestmark = pytest.mark.pty

STOPPED_DEG = 0.5
# Less than one tick of the potentiometer (0.29 deg): shafts creep through their play, but no goal has changed.
STILL_DEG = 0.25
# Data reach the disk every second, at the first record after it is over; and that takes its time.
LOST_MS = 1200
MS = NS_PER_S // 1000


def ticks_ns(log: Path) -> list[int]:
    """When each tick of a log began [ns, monotonic]."""
    return [message.value["time_ns"] for message in reader.read(log, (CYCLE,))]


def assert_ends_well(bench: Bench) -> None:
    """The daemon goes when it is told to; what it recorded is finished, and every tick comes out the same again."""
    assert bench.daemons[-1].end() == 0
    for folder in (bench.logs, bench.recordings):
        logs = sorted(folder.glob("*.mcap*"))
        assert logs
        for log in logs:
            assert log.suffix == ".mcap"
            result = replay.check(log)
            assert (result.mismatches, result.first_mismatch) == (0, "")
            assert result.ticks > 0


@contextmanager
def hung(pid: int) -> Iterator[int]:
    """A process that hangs meanwhile; since when [ns]."""
    os.kill(pid, signal.SIGSTOP)
    try:
        yield time.monotonic_ns()
    finally:
        os.kill(pid, signal.SIGCONT)


@pytest.mark.parametrize(
    ("number", "back_ms"), [(signal.SIGKILL, 2000), (signal.SIGSTOP, 4000)], ids=["killed", "hung"]
)
def test_a_control_process_that_is_gone_stops_the_arm_and_another_adopts_it(
    holding: Bench, arm: Simulator, number: signal.Signals, back_ms: int
) -> None:
    run = holding.run_to_the_middle(arm)
    gone_ns = time.monotonic_ns()
    os.kill(holding.controls[0], number)

    with refused("RESTARTED"):
        run.result()
    goals = arm.goals_rad()  # by now the last one has arrived, and the next process has not
    adopted = holding.until(lambda snapshot: snapshot["pids"]["control"] not in (None, holding.controls[0]))
    holding.controls.append(adopted["pids"]["control"])
    assert adopted["fault"] is None
    holding.until(lambda snapshot: snapshot["state"] == "holding")

    assert arm.motion_deg(gone_ns + 250 * MS, gone_ns + 1250 * MS) < STOPPED_DEG
    assert_ends_well(holding)
    (log,) = holding.logs.glob("*.mcap")
    first_ns = next(begin_ns for begin_ns in ticks_ns(log) if begin_ns > gone_ns)
    assert first_ns - gone_ns < back_ms * MS
    still_ns = max(first_ns, gone_ns + 250 * MS)
    assert arm.motion_deg(still_ns, still_ns + 1000 * MS) < STILL_DEG
    assert arm.goals_rad() == goals
    assert arm.torque() == [True] * 6
    assert not alive(holding.controls[0])


def test_killed_host_stops_the_arm_and_the_next_recovers_log_and_arm(holding: Bench, arm: Simulator) -> None:
    run = holding.run_to_the_middle(arm)
    killed_ns = holding.daemons[0].kill()
    holding.start_daemon()

    with pytest.raises(NoDaemon):
        run.result()
    assert holding.until(lambda snapshot: snapshot["state"] == "holding")["fault"] is None
    ready_ns = time.monotonic_ns()
    assert not alive(holding.controls[0])
    assert holding.controls[1] != holding.controls[0]
    assert arm.motion_deg(killed_ns + 500 * MS, ready_ns + 1000 * MS) < STOPPED_DEG
    assert arm.motion_deg(ready_ns, ready_ns + 1000 * MS) < STILL_DEG
    assert arm.torque() == [True] * 6

    # What the killed one left is recovered meanwhile; the log of the living one is a part.
    holding.until(
        lambda _: [len(list(folder.glob("*.part"))) for folder in (holding.logs, holding.recordings)] == [1, 0]
    )
    assert_ends_well(holding)
    recovered, adopting = sorted(holding.logs.glob("*.mcap"))
    assert killed_ns - ticks_ns(recovered)[-1] < LOST_MS * MS
    assert JOINT_COMMANDS not in reader.info(adopting).topics


def test_unplugged_adapter_latches_and_a_replug_leads_back_to_running(holding: Bench, arm: Simulator) -> None:
    client, run = holding.client(), holding.run_to_the_middle(arm)
    unplugged_ns = time.monotonic_ns()
    arm.client.unplug()
    seen = holding.until(lambda snapshot: snapshot["fault"] is not None)
    assert seen["fault"]["code"] == "PORT_GONE"
    assert time.monotonic_ns() - unplugged_ns - seen["fault"]["since_s"] * NS_PER_S < 500 * MS
    assert "`armctl clear`" in seen["fault"]["next"]
    with refused("PORT_GONE"):
        run.result()
    assert arm.motion_deg(unplugged_ns + 250 * MS, unplugged_ns + 1250 * MS) < STOPPED_DEG
    assert client.call("status")["state"] == "faulted"
    with pytest.raises(RequestRefused, match="plug the adapter in"):
        client.call("clear")

    replugged_ns = time.monotonic_ns()
    arm.client.replug()
    back = holding.until(lambda snapshot: all(joint["age_s"] < 0.2 for joint in snapshot["joints"]))
    assert time.monotonic_ns() - replugged_ns < 3000 * MS
    assert back["state"] == "faulted"
    assert insist(client, "clear") == {"state": "holding"}
    assert arm.motion_deg(replugged_ns, time.monotonic_ns()) < STILL_DEG

    assert holding.daemons[0].process.poll() is None
    ran = insist(client, "run", plan=line_plan(back).model_dump(mode="json"))
    assert ran["max_error_mm"] < 60.0
    assert_ends_well(holding)


def test_sigterm_stops_the_arm_closes_the_log_and_leaves_torque_on(holding: Bench, arm: Simulator) -> None:
    run = holding.run_to_the_middle(arm)
    told_ns = time.monotonic_ns()
    assert_ends_well(holding)

    with pytest.raises((NoDaemon, RequestRefused)):
        run.result()
    assert arm.motion_deg(told_ns + 500 * MS, told_ns + 1500 * MS) < STOPPED_DEG
    assert arm.torque() == [True] * 6
    assert not alive(holding.controls[0])
    assert not holding.socket.exists()


def test_a_hung_host_stops_the_arm_and_finds_it_holding(holding: Bench, arm: Simulator) -> None:
    run = holding.run_to_the_middle(arm)
    with hung(holding.daemons[0].process.pid) as hung_ns:
        # 0.3 s of silence, a tick, 0.2 s to slow down, and the last goal.
        assert arm.motion_deg(hung_ns + 700 * MS, hung_ns + 1700 * MS) < STOPPED_DEG
    with refused("HOST_SILENT"):
        run.result()
    assert holding.until(lambda snapshot: snapshot["state"] == "holding")["fault"] is None
    assert arm.torque() == [True] * 6
    assert_ends_well(holding)


def test_a_signal_to_the_daemon_stops_the_arm(holding: Bench, arm: Simulator) -> None:
    run = holding.run_to_the_middle(arm)
    holding.daemons[0].process.send_signal(signal.SIGUSR1)
    with refused("STOPPED"):
        run.result()
    assert_ends_well(holding)


@pytest.mark.parametrize("way", ["armctl", "signal"])
def test_a_stop_is_served_while_the_host_hangs(holding: Bench, arm: Simulator, way: str) -> None:
    run = holding.run_to_the_middle(arm)
    command = [sys.executable, "-m", "armctl", "stop", "--json", "--socket", str(holding.socket)]
    with hung(holding.daemons[0].process.pid) as hung_ns:
        asked_ns = hung_ns
        if way == "signal":
            os.kill(holding.controls[0], signal.SIGUSR1)
        else:
            assert json.loads(subprocess.check_output(command, timeout=60)) == {"state": "holding"}
            asked_ns = time.monotonic_ns()  # it is answered when the arm is still
        assert arm.motion_deg(asked_ns + 500 * MS, asked_ns + 1000 * MS) < STOPPED_DEG
    # A command that a busy machine lets begin late finds an arm that stops for its host's silence.
    late = asked_ns - hung_ns > 300 * MS
    with pytest.raises(RequestRefused) as ended:
        run.result()
    assert ended.value.code in {"STOPPED", "HOST_SILENT" if late else "STOPPED"}
    assert_ends_well(holding)
