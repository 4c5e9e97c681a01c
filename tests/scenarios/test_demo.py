"""The demonstration, shortened: one take of a short line, and one run of it."""

from pathlib import Path

import pytest

from armctl.lab import demo
from armctl.lab.stage import silent

pytestmark = pytest.mark.pty


def test_demonstration_teaches_optimises_runs_replays_and_reports(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in (("TAKES", 1), ("VIA", (1,)), ("DURATION_S", 2.0)):
        monkeypatch.setattr(demo, name, value)
    monkeypatch.setattr(demo, "FROM_M", (0.18, -0.05, 0.10))
    monkeypatch.setattr(demo, "TO_M", (0.18, 0.05, 0.10))
    out = tmp_path / "demo"
    result = demo.run(out, 1, silent)

    (row,) = result["rows"]
    assert row["via"] == 1
    assert row["duration_s"] == pytest.approx(2.0, abs=0.2)
    assert row["predicted_mean_error_mm"] < 10.0
    # An AX-12A hangs below its goal under load; a truth without sag would not be one.
    assert 10.0 < row["truth"]["mean_error_mm"] < 40.0
    assert row["mean_error_mm"] == pytest.approx(row["truth"]["mean_error_mm"], abs=5.0)
    assert result["replay"]["mismatches"] == 0
    assert result["replay"]["ticks"] > 100
    assert {Path(log).name for log in result["logs"]} >= {"candidate-1.mcap", f"{row['recording']}.mcap"}
    for path in (*result["logs"], result["plan"], result["report"]):
        assert Path(path).stat().st_size > 0
    assert not list(out.rglob("*.part"))
