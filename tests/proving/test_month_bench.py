"""The month's bench runs, plants what it says it plants, and would notice what is not found."""

from pathlib import Path
from typing import Any

import pytest
from mcap.reader import make_reader

from proving import folder_bench, month_bench


def test_month_bench_finds_what_it_planted() -> None:
    result = month_bench.bench(seed=1, files=3, ticks=150)
    assert (result["violations"], result["examples"]) == (0, [])
    found = {row["work"]: row["value"] for row in result["rows"]}
    assert found["find shut itself down level:error"] == 60
    assert 0 < found["find code:TRIPPED"] < 60
    assert len(result["checks"]) == 6


def test_folder_bench_lists_every_log_and_starts_a_daemon_behind_a_crash() -> None:
    result = folder_bench.bench(seed=1, files=30, ticks=150)
    assert (result["violations"], result["examples"]) == (0, [])
    assert [row["unit"] for row in result["rows"]] == ["ms a second", "s", "s", "s"]
    assert all(row["value"] > 0.0 for row in result["rows"])
    assert len(result["checks"]) == 4


def test_a_month_is_sound_logs_one_after_another(tmp_path: Path) -> None:
    kept = month_bench.month(tmp_path, 2, 12, 60)
    begins, codes = [], b""
    for path in sorted(tmp_path.iterdir()):
        with path.open("rb") as stream:
            told = [message for *_, message in make_reader(stream, validate_crcs=True).iter_messages()]
        begins.append(min(message.log_time for message in told))
        codes += b"".join(message.data for message in told)
    hours = [(begin - begins[0]) / month_bench.HOUR_NS for begin in begins]
    assert hours == [*range(10), 24, 25]
    assert (codes.count(month_bench.CODE), codes.count(month_bench.OTHER)) == (kept, 12 * month_bench.PLANTED - kept)


def test_an_event_that_is_not_found_is_a_violation(monkeypatch: pytest.MonkeyPatch) -> None:
    asked = month_bench._asked

    def forgetful(*words: str) -> tuple[dict[str, Any], float]:
        found, took_s = asked(*words)
        return {key: value[1:] if key == "events" else value for key, value in found.items()}, took_s

    monkeypatch.setattr(month_bench, "_asked", forgetful)
    assert month_bench.bench(seed=1, files=2, ticks=60)["violations"] == 3
