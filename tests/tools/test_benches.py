"""The benches run, and say what they say they say; their figures mean nothing on a machine that runs tests."""

from __future__ import annotations

import pytest

from armctl.proving import bus_bench, jitter_bench


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
        assert row["value"] > 0.0
        assert row["ratio"] > (1.0 if row["work"].startswith("cycle") else 0.0)
    assert {row["who"].split(",")[0] for row in result["rows"]} >= {"armctl", "dynamixel-sdk", "raw", "pypot"}
    assert len(result["checks"]) == 6


@pytest.mark.pty
def test_jitter_bench_hears_the_control_process_and_weighs_the_daemon() -> None:
    assert len(jitter_bench.lateness_ms(seed=1, period_s=0.02, seconds=0.5, hogs=1)) >= 15
    cpu, memory_MB = jitter_bench.daemon_cost(seed=1, seconds=0.5)
    assert cpu.keys() == memory_MB.keys() == {"daemon", "control"}
    assert all(10.0 < used < 500.0 for used in memory_MB.values())
