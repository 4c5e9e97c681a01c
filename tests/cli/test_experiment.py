import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from armctl.cli import main
from armctl.commissioning import sag_file
from armctl.config import Config
from armctl.files import load_arm
from armctl.lab import line_results
from armctl.lab.measured_tool import COLUMNS
from armctl.lab.rig import VirtualRig
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.trajectory.course import Line
from armctl.trajectory.refinement import Measured
from tests.cli.conftest import Answer
from tests.genetic import hand
from tests.lab.daemon import SimulatedDaemon, true_path
from tests.words import missing

A, B = (0.18, -0.1, 0.10), (0.18, 0.1, 0.10)
LINE = ("experiment", "line", "--from", "0.18,-0.1,0.10", "--to", "0.18,0.1,0.10")


def test_a_virtual_experiment_needs_no_daemon_and_tells_every_row_before_and_after(
    answer: Answer, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setenv("ARMCTL_SOCKET", "/nonexistent/socket")
    told = ["--via", "2,stream", "--duration", "3", "--repeats", "2", "--refine", "2", "--seed", "3"]
    page = tmp_path / "line.html"
    found = answer(*LINE, *told, "--profile", "paper", "--virtual", "--report", page)
    drawn = ("Mean distance by round of correction", "Best cost of the genetic algorithm by generation")
    assert not missing(page.read_text(encoding="utf-8"), *drawn)
    rows, before, refined = found["rows"], found["before"], found["refined"]
    assert [row["via"] for row in rows] == [2, "stream"]
    assert ([one["round"] for one in refined], before) == ([0, 1, 2], refined[0]["rows"])
    for row, worse in zip(rows, before, strict=True):
        assert (row["runs"], row["duration_s"]) == (2, pytest.approx(3.0, rel=0.05))
        assert row["truth"]["mean_error_mm"] < 2.0 < 5.0 < worse["truth"]["mean_error_mm"]
        assert row["truth"]["mean_error_mm"] < row["truth"]["max_error_mm"]
    assert all(0.01 < noise < 0.3 for noise in found["repeat_noise_mm"].values())
    ga = found["ga"]
    assert (ga["profile"], ga["generations"]) == ("paper", 300)
    assert ga["exact_mean_error_mm"] <= ga["mean_error_mm"] < max(one["mean_error_mm"] for one in ga["baseline"])


def test_named_recordings_are_the_candidates_and_auto_chooses_for_the_tolerance(
    answer: Answer, takes: list[str]
) -> None:
    ends = ["--from", "0.18,-0.125,0.10", "--to", "0.18,0.125,0.10"]
    told = [word for name in takes for word in ("--recordings", name)]
    chosen = []
    for tolerance_mm in (20.0, 0.9):
        more = ["--via", "auto", "--tolerance-mm", str(tolerance_mm), "--repeats", "1", "--virtual"]
        found = answer("experiment", "line", *ends, *told, *more)
        assert len(found["ga"]["baseline"]) == len(takes)
        (row,) = found["rows"]
        assert row["predicted_mean_error_mm"] < tolerance_mm
        chosen.append(row["via"])
    assert 0 <= chosen[0] < chosen[1] < 8


@pytest.fixture
def config(tmp_path: Path) -> Path:
    """A configuration whose arm's calibration, and so its sag model, lies in this test's own folder."""
    arm = shutil.copy("calibration/ax12-line.yaml", tmp_path / "mine.yaml")
    file = tmp_path / "armctl.yaml"
    file.write_text(f"arm: {arm}\n", encoding="utf-8")
    return file


def daemon(patch: pytest.MonkeyPatch, spec: ArmSpec = RANDOM_SPEC) -> SimulatedDaemon:
    served = SimulatedDaemon(VirtualRig(SimulatedArm(hand.arm(), seed=5, spec=spec)))
    served.install(patch)
    return served


def true_mm(run: Measured) -> float:
    return line_results.true_mm(run, Line(np.array(A), np.array(B), 5.0))[0]


def test_a_sag_model_from_calibration_lines_is_stored_and_makes_the_first_run_straight(
    answer: Answer, monkeypatch: pytest.MonkeyPatch, config: Path
) -> None:
    served = daemon(monkeypatch)
    found = answer("calibrate", "--sag", "--config", config)
    assert found["lines"] == len(served.runs) == 8
    arm = str(config.with_name("mine.yaml"))
    model = sag_file.load(Config(arm=arm), load_arm(arm))
    assert model is not None
    assert list(model.residual_tick) == list(found["residual_tick"].values())
    served.runs.clear()
    found = answer(*LINE, "--via", "stream", "--refine", "1", "--repeats", "1", "--config", config)
    assert found["sag_model"]["lines"] == 8
    assert true_mm(served.runs[1]) < 0.3 * true_mm(served.runs[0])
    assert found["rows"][0]["recordings"] == [f"run-{len(served.runs)}"]


def test_a_measurement_from_outside_corrects_what_no_encoder_sees(
    answer: Answer, monkeypatch: pytest.MonkeyPatch, config: Path, tmp_path: Path
) -> None:
    served = daemon(monkeypatch, replace(RANDOM_SPEC, zero_offset_within_tick=8.0))
    told = (*LINE, "--via", "stream", "--refine", "2", "--repeats", "1", "--config", config)
    answer(*told)
    blind = served.runs[-1]
    csv = tmp_path / "tool.csv"
    rows = np.column_stack(true_path(blind))
    np.savetxt(csv, rows, delimiter=",", header=",".join(COLUMNS), comments="")
    answer(*told, "--measured", csv, f"takes/run-{len(served.runs)}")
    assert true_mm(blind) > 2.0
    assert true_mm(served.runs[-1]) < 0.5 * true_mm(blind)


def test_a_geometry_moves_the_true_tool_off_the_line_and_hardly_bends_its_path(answer: Answer) -> None:
    told = (*LINE, "--via", "1", "--duration", "2", "--repeats", "1", "--refine", "1", "--seed", "3", "--virtual")
    found = {"perfect": answer(*told), "poor": answer(*told, "--geometry", "poor")}
    (perfect,), (poor,) = (found[level]["rows"] for level in ("perfect", "poor"))
    assert all(answered["geometry"] == level for level, answered in found.items())
    assert poor["truth"]["mean_error_mm"] > 2.0 * perfect["truth"]["mean_error_mm"]
    for row in (perfect, poor):
        assert row["own_chord"]["mean_error_mm"] < 3.0
        assert row["mean_error_mm"] < 3.0  # the encoders see nothing of it


def test_a_geometry_is_for_virtual_arms_only(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*LINE, "--geometry", "careful"]) == 2
    assert "--geometry" in capsys.readouterr().err
