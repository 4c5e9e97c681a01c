"""The demonstration, shortened: one take of a short line, and its runs, plain, corrected and refined."""

import os
import signal
import subprocess
import sys
from pathlib import Path
from unittest.mock import patch

import pytest

from armctl.commissioning import sag_file
from armctl.config import Config
from armctl.errors import ConfigError
from armctl.files import load_arm
from armctl.lab import demo
from armctl.lab.stage import silent
from armctl.trajectory.plan import plan_from_text
from tests.guard.commands import FILE, demonstrated, skeleton
from tests.guard.kept import load
from tests.scenarios.bench import SHORT_DEMO, alive

pytestmark = pytest.mark.pty


def test_demonstration_teaches_optimises_runs_replays_and_reports(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    status, result = demonstrated(out)

    assert {"exit status": status, "answer": skeleton(result)} == load(FILE)["demonstrated"]["demo"]
    assert [(row["via"], row["corrected"]) for row in result["rows"]] == [(1, False), (1, True), (1, True)]
    for row in result["rows"]:
        assert row["duration_s"] == pytest.approx(2.0, abs=0.2)
        assert row["predicted_mean_error_mm"] < 10.0
        assert row["mean_error_mm"] == pytest.approx(row["truth"]["mean_error_mm"], abs=5.0)
    plain, corrected, _ = (row["truth"]["mean_error_mm"] for row in result["rows"])
    # An AX-12A hangs below its goal under load; a truth without sag would not be one.
    assert 10.0 < plain < 40.0
    assert corrected < 0.25 * plain
    [refined] = result["refined"]
    assert refined == {**result["rows"][-1], **{key: refined[key] for key in ("rounds", "plan")}}
    assert [row["goals"] for row in result["rows"]] == ["plain", "corrected", "refined"]
    first, *_ = refined["rounds"]
    for key in ("mean_error_mm", "max_error_mm"):  # the corrected row is the refinement's own first run
        assert result["rows"][1][key] == first[key]
    assert first["recordings"] == [result["rows"][1]["recording"]]
    best = [one for one in refined["rounds"] if one["kept"]][-1]
    assert refined["recording"] == best["recordings"][-1]
    # Of a plan in doubt, which is run twice, the round has the mean.
    assert len(best["recordings"]) > 1 or refined["mean_error_mm"] == best["mean_error_mm"]
    assert refined["mean_error_mm"] == pytest.approx(refined["truth"]["mean_error_mm"], abs=5.0)
    for how in ("corrected", "refined"):
        assert f"1 via, {how}, true" in Path(result["report"]).read_text(encoding="utf-8")
    # What was learnt stays with the demonstration's own copy of the arm's file.
    model = sag_file.load(Config(arm=str(out / "ax12-line.yaml")), load_arm("ax12-line"))
    assert model is not None
    assert model.lines == 1
    assert result["replay"]["mismatches"] == 0
    assert result["replay"]["ticks"] > 100
    assert {Path(log).name for log in result["logs"]} >= {"candidate-1.mcap", f"{result['rows'][1]['recording']}.mcap"}
    for path in (*result["logs"], result["plan"], refined["plan"], result["report"]):
        assert Path(path).stat().st_size > 0
    assert not list(out.rglob("*.part"))


@pytest.mark.parametrize(
    ("arm", "high_m"), [("crane-plus-v2", 0.1), ("phantomx-pincher", 0.25), ("phantomx-reactor", 0.1)]
)
def test_another_arm_is_demonstrated_along_the_first_line_in_its_reach(arm: str, high_m: float, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    with patch.multiple(demo, **{**SHORT_DEMO, "LINES": ((0.18, 0.05, 0.1), (0.18, 0.05, 0.25))}):
        result = demo.run(out, 1, silent, arm)

    plan = plan_from_text(Path(result["plan"]).read_text(encoding="utf-8"), result["plan"])
    assert (plan.arm_id, plan.from_m, plan.to_m) == (arm, (0.18, -0.05, high_m), (0.18, 0.05, high_m))
    plain, corrected, _ = (row["truth"]["mean_error_mm"] for row in result["rows"])
    assert corrected < 0.4 * plain
    assert result["replay"]["mismatches"] == 0
    assert (out / f"{arm}.yaml").is_file()


def test_an_arm_without_a_line_in_its_reach_starts_nothing(tmp_path: Path) -> None:
    out = tmp_path / "demo"
    with (
        patch.object(demo, "LINES", ((0.6, 0.1, 0.1),)),
        pytest.raises(ConfigError, match="crane-plus-v2: none of the demonstration's lines is in this arm's reach"),
    ):
        demo.run(out, 1, silent, "crane-plus-v2")
    assert not out.exists()


def test_a_demonstration_whose_terminal_closes_ends_its_programs(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "armctl", "demo", "--out", str(tmp_path / "demo")]
    with subprocess.Popen(command, stderr=subprocess.PIPE, text=True, start_new_session=True) as running:
        assert running.stderr is not None
        assert [running.stderr.readline().split()[0] for _ in range(2)] == ["starting", "teaching"]
        started = [int(pid) for pid in Path(f"/proc/{running.pid}/task/{running.pid}/children").read_text().split()]
        assert len(started) == 2
        os.kill(running.pid, signal.SIGHUP)
        running.stderr.read()
        assert running.wait() == 128 + signal.SIGHUP
    assert not [pid for pid in started if alive(pid)]
