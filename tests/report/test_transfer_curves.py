"""The transfer robot's curves out of a log: near the model, whole, and only from a log that holds a cycle."""

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from armctl.errors import LogError, RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.lab import virtual_transfer
from armctl.lab.virtual_transfer import record
from armctl.recording import replay, timeline
from armctl.report import transfer_curves as report
from armctl.report.transfer_curves import QUANTITIES, TITLES, Transfer
from armctl.trajectory.transfer import TransferRequest, motion
from tests.words import missing

CYCLE = TransferRequest(pick_m=(0.176, -0.132, -0.15), place_m=(0.176, 0.132, -0.15))
ARM = load_arm("transfer-6dof")


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return record(ARM, CYCLE, tmp_path_factory.mktemp("transfer") / "cycle.mcap")


@pytest.fixture(scope="module")
def done(log: Path) -> Transfer:
    return report.load(log)


def test_the_log_is_one_that_replays(log: Path) -> None:
    result = replay.check(log)
    assert (result.mismatches, result.first_mismatch) == (0, "")
    assert result.ticks > 300


def test_what_was_commanded_in_the_log_is_the_model_that_is_drawn(log: Path) -> None:
    [run] = timeline.load(log).motions
    robot = robots.get(ARM.robot, ARM.lengths_m)
    begin = motion(CYCLE, ARM, robot).sample(np.zeros(1))[0][0]
    assert run.begin_rad == pytest.approx(begin, abs=1e-9)
    duration_s = (run.end_ns - run.begin_ns) / 1e9
    assert duration_s == pytest.approx(motion(CYCLE, ARM, robot).duration_s, abs=0.11)


def test_all_five_curves_follow_the_model_as_far_as_sag_play_and_smoothing_allow(done: Transfer) -> None:
    """Sag moves the paw by up to 3 cm; its rate, and what play and friction add at every turn, is what is left."""
    share = {"displacement": 0.15, "velocity": 0.12, "acceleration": 0.35, "angular velocity": 0.12}
    for row in report.table(done):
        assert row["rms_difference"] < share.get(row["quantity"], 0.4) * row["model_peak"], row
        assert row["recorded_peak"] == pytest.approx(row["model_peak"], rel=0.6), row
    assert done.cycle == CYCLE


def test_time_zero_of_the_record_is_that_of_the_model(done: Transfer) -> None:
    """Shifted against the model by more than a tick, the recorded waist would fit better."""
    recorded, model = (curve.tool_velocity_m_s[:, 1] for curve in (done.recorded, done.model))
    step_s = done.model.time_s[1]

    def misfit(shift: int) -> float:
        return float(((np.roll(recorded, -shift) - model)[50:-50] ** 2).mean())

    best = min(range(-25, 26), key=misfit)
    assert abs(best * step_s) <= 0.15


def test_the_model_s_curves_are_derivatives_of_one_another(done: Transfer) -> None:
    curve, h = done.model, done.model.time_s[1]
    for value, rate in (("tool_position_m", "tool_velocity_m_s"), ("tool_velocity_m_s", "tool_acceleration_m_s2")):
        slope = np.gradient(getattr(curve, value), h, axis=0)[1:-1]
        assert np.abs(slope - getattr(curve, rate)[1:-1]).max() < 0.06 * np.abs(getattr(curve, rate)).max() + 1e-3
    assert math.dist(curve.tool_position_m[0], np.add(CYCLE.pick_m, (0.0, 0.0, CYCLE.height_m))) < 1e-9


def test_figures_3_to_7_each_show_three_axes_recorded_and_by_the_model(done: Transfer) -> None:
    drawn = {title: report.draw(done, title) for title in TITLES}
    assert [caption.split(":")[0] for caption in drawn] == [number for number, *_ in QUANTITIES]
    for chart in drawn.values():
        assert [trace["name"] for trace in chart.data] == [
            f"{a}, {who}" for a in "xyz" for who in ("model", "recorded")
        ]


def test_the_page_names_stations_lengths_and_how_the_curves_were_derived(done: Transfer, tmp_path: Path) -> None:
    page = tmp_path / "cycle.html"
    report.write(done, page)
    told = ("(176, -132, -150) mm", "a2 180", "cubics fitted within 0.55 s", "Fig. 7: angular acceleration")
    assert not missing(page.read_text(encoding="utf-8"), *told)


def test_changed_lengths_are_the_log_s_own(tmp_path: Path) -> None:
    longer = ARM.model_copy(update={"lengths_m": {**ARM.lengths_m, "a2": 0.19}})
    path = record(longer, CYCLE.model_copy(update={"carry_s": 5.0, "lift_s": 1.5}), tmp_path / "longer.mcap", seed=1)
    loaded = report.load(path)
    assert (loaded.robot.lengths_m["a2"], loaded.cycle.carry_s) == (0.19, 5.0)
    assert report.table(loaded)[0]["rms_difference"] < 0.05


@pytest.mark.parametrize("spoil", [lambda _: b"", lambda data: data[:2000]])
def test_what_is_no_log_of_a_cycle_is_told(log: Path, tmp_path: Path, spoil: Callable[[bytes], bytes]) -> None:
    spoiled = tmp_path / "spoiled.mcap"
    spoiled.write_bytes(spoil(log.read_bytes()))
    with pytest.raises(LogError):
        report.load(spoiled)


def test_a_log_that_tells_of_no_cycle_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(virtual_transfer, "NOTED", "SOMETHING_ELSE")
    path = record(ARM, CYCLE.model_copy(update={"carry_s": 3.0, "lift_s": 1.5}), tmp_path / "other.mcap")
    with pytest.raises(LogError, match="tells of no transfer"):
        report.load(path)


def test_a_station_nobody_can_reach_is_refused_before_any_log_is_written(tmp_path: Path) -> None:
    with pytest.raises(RequestRefused, match="cannot point down"):
        record(ARM, CYCLE.model_copy(update={"pick_m": (0.6, 0.0, 0.0)}), tmp_path / "never.mcap")
    assert not (tmp_path / "never.mcap").exists()
