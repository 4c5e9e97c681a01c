"""The log bench runs, and says what it says it says; its figures mean nothing on a machine that runs tests."""

from proving import log_bench


def test_log_bench_measures_every_peer_beside_armctl() -> None:
    result = log_bench.bench(seed=1, ticks=150, written=30, rounds=1)
    for row in result["rows"]:
        assert row.keys() == {"work", "who", "value", "unit", "ratio"}
        assert row["value"] > 0.0
        assert row["ratio"] > 0.0
    who = {(row["work"], row["who"].split(",")[0]) for row in result["rows"]}
    assert {one for work, one in who if work == "encode and write"} == {"armctl", "foxglove-sdk", "mcap-ros2-support"}
    assert {one for work, one in who if work == "decode all"} == {"armctl", "rosbags", "mcap-ros2-support"}
    assert {one for work, one in who if work == "one topic to numpy"} == {"armctl", "mcap-ros2-support"}
    assert len(result["checks"]) >= 9
    assert {check.keys() == {"name", "value", "bound", "ok"} for check in result["checks"]} == {True}
