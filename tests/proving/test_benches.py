"""The benches run, and say what they say they say; their figures mean nothing on a machine that runs tests."""

import os
import sys
import time

import pytest

from armctl.errors import ArmctlError
from proving import bus_bench, jitter_bench, sim_bench, start_bench, web_bench


def test_wire_time_is_the_bytes_and_the_return_delays() -> None:
    """The figures of the protocol's arithmetic: six 8-byte reads and a SYNC_WRITE of goal and speed."""
    assert bus_bench.wire_time_us(6, 8, 4, 0) == pytest.approx(1700.0)
    assert bus_bench.wire_time_us(6, 8, 4, 500) == pytest.approx(4700.0)
    assert bus_bench.wire_time_us(6, 26, 4, 0) - bus_bench.wire_time_us(6, 8, 4, 0) == pytest.approx(6 * 180.0)


@pytest.mark.pty
def test_bus_bench_measures_every_client_beside_armctl() -> None:
    result = bus_bench.bench(seed=1, cycles=5, rounds=1)
    for row in result["rows"]:
        assert row.keys() == {"work", "who", "value", "unit", "ratio"}
        assert min(row["value"], row["ratio"]) > 0.0
    assert {row["who"].split(",")[0] for row in result["rows"]} >= {"armctl", "dynamixel-sdk", "raw", "pypot"}
    assert [check["name"] for check in result["checks"]] == [
        f"{what} / raw at {delay_us} us" for delay_us in (0, 500) for what in ("cycle", "CPU")
    ]


@pytest.mark.pty
def test_jitter_bench_hears_the_control_process_and_weighs_the_daemon() -> None:
    assert len(jitter_bench.lateness_ms(seed=1, period_s=0.02, seconds=0.5, hogs=1)) >= 15
    cpu, memory_MB = jitter_bench.daemon_cost(seed=1, seconds=0.5)
    assert cpu.keys() == memory_MB.keys() == {"daemon", "control"}
    assert all(10.0 < used < 500.0 for used in memory_MB.values())
    assert all(0.0 < used < 2.0 for used in cpu.values())


def test_the_processor_time_of_a_process_is_told_finer_than_the_kernels_ticks() -> None:
    before_s = time.process_time()
    assert before_s <= jitter_bench.cpu_s(os.getpid()) <= time.process_time()


def test_sim_bench_measures_arm_and_loop_beside_mujoco() -> None:
    result = sim_bench.bench(seed=1, seconds=0.5, rounds=1)
    assert {row["work"] for row in result["rows"]} >= {"arm moving", "control loop holding", "control loop moving"}
    assert [row["ratio"] for row in result["rows"] if row["who"].startswith("MuJoCo")] == [1.0]
    assert all(row.keys() == {"work", "who", "value", "unit", "ratio"} for row in result["rows"])
    assert all(row["value"] > 0.0 for row in result["rows"])
    assert [check["bound"] for check in result["checks"]] == [sim_bench.SPEED_BOUND]


@pytest.mark.pty
def test_web_bench_watches_like_a_page_and_weighs_web_and_control() -> None:
    result = web_bench.bench(seed=1, seconds=1.0, rounds=1)
    assert all(row.keys() == {"work", "who", "value", "unit", "ratio"} for row in result["rows"])
    values = {(row["work"], row["who"]): row["value"] for row in result["rows"]}
    assert values["live view", "messages"] > 1.0
    assert values["live view", "armctl web"] > 0.0
    assert values["nobody looks", "control"] > 0.0
    assert 1.0 < values["first page", "scripts and styles too, packed"] < web_bench.PAGE_BOUND_KB
    assert len(result["checks"]) >= 4


@pytest.mark.pty
def test_start_bench_weighs_whole_processes_side_by_side() -> None:
    result = start_bench.bench(seed=1, rounds=1)
    assert [row["who"] for row in result["rows"]] == ["python3 -c pass", "armctl stop"] * 2
    assert min(row["value"] for row in result["rows"]) > 0.0
    assert [row["ratio"] for row in result["rows"]][::2] == [1.0, 1.0]
    [check] = result["checks"]
    assert check["value"] == pytest.approx(result["rows"][1]["value"] - result["rows"][0]["value"])
    assert (check["bound"], check["ok"]) == (80.0, check["value"] <= 80.0)
    assert result["violations"] == (not check["ok"])


def test_start_bench_says_what_a_command_that_fails_said() -> None:
    with pytest.raises(ArmctlError, match="exit status 3"):
        start_bench._run([sys.executable, "-c", "import sys; sys.exit(3)"])
