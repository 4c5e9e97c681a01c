"""Zero offsets and link lengths from touched points."""

import math
from collections.abc import Iterable, Sequence
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.commissioning import calibration
from armctl.commissioning.calibration import Fit, Touch, fit, read_ticks, recalibrated, zeroed
from armctl.config import ArmConfig, GripperConfig, parse_yaml, validate
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, PortGone, RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.faults import Fault
from tests.commissioning.bench import EXACT, Bench, PosingHand, planted, postures, touch_points, unwritten
from tests.host.doubles import refused

TOUCHES = 24
ARM = load_arm("ax12-line")


def errors(found: Fit, true: ArmConfig) -> tuple[float, float]:
    """Largest error of a zero [tick] that the tool shows, and of a length [mm]."""
    zeros = [a.zero_tick - b.zero_tick for a, b in zip(found.arm.joints[:5], true.joints[:5], strict=True)]
    lengths = [found.arm.lengths_m[name] - length for name, length in true.lengths_m.items()]
    return max(map(abs, zeros)), 1000.0 * max(map(abs, lengths))


def ideal_touches(true: ArmConfig, count: int, rng: np.random.Generator, *, flat: bool = False) -> list[Touch]:
    """Touches without noise; `flat`: the tool always comes down at one angle."""
    touches = []
    for q in postures(true, count, rng):
        if flat:
            q[4] = -math.pi / 2.0 - q[1] - q[2] - q[3]
        touches.append(touch(true, q, np.zeros(3)))
    return touches


def touch(true: ArmConfig, q: FloatArray, error_m: FloatArray) -> Touch:
    """What the servos of the true arm read in a posture, and the point that its tool is said to be on."""
    chain = robots.get(true.robot, true.lengths_m).chain
    point_m = tool_position(chain, q[: chain.n]) + error_m
    ticks = tuple(joint.tick(position) for joint, position in zip(true.joints, q, strict=True))
    return Touch(point_m=tuple(point_m.tolist()), ticks=ticks)


def moved(touches: Sequence[Touch], points_m: Iterable[Iterable[float]]) -> list[Touch]:
    """The same postures on other points."""
    pairs = zip(touches, points_m, strict=True)
    return [taken.model_copy(update={"point_m": tuple(point_m)}) for taken, point_m in pairs]


@pytest.mark.parametrize("seed", range(4))
def test_planted_zeros_and_3_mm_lengths_come_back(seed: int) -> None:
    """To one tick and 0.5 mm, through the wire, with noise, ticks, gravity and play, the tip 0.3 mm off its point."""
    rng = np.random.default_rng(seed)
    true = planted(ARM, rng, tick=20.0, length_m=0.003)
    bench = Bench(seed=seed, spec=EXACT, simulated=true)
    with unwritten(bench):
        found = fit(ARM, touch_points(bench, TOUCHES, rng, touch_error_m=0.0003))
    zero_tick, length_mm = errors(found, true)
    assert zero_tick <= 1.0
    assert length_mm <= 0.5
    assert found.rms_mm < 1.0 < found.rms_before_mm
    assert [parameter["name"] for parameter in found.parameters if parameter["held"]] == ["roll.zero_tick"]
    assert found.complete


@settings(max_examples=20)
@given(seed=st.integers(0, 2**32 - 1))
def test_without_noise_every_arm_is_found_exactly(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = planted(ARM, rng, tick=25.0, length_m=0.004)
    zero_tick, length_mm = errors(fit(ARM, ideal_touches(true, 30, rng)), true)
    assert zero_tick <= 0.0051  # the file's two decimals
    assert length_mm <= 0.0006


def test_standard_errors_are_what_repeated_calibrations_scatter() -> None:
    rng = np.random.default_rng(1)
    touches = ideal_touches(ARM, 20, rng)
    found = []
    for _ in range(60):
        noisy = moved(touches, [taken.point_m + 0.0005 * rng.standard_normal(3) for taken in touches])
        found.append([p for p in fit(ARM, noisy).parameters if p["standard_error"] is not None])
    after = np.array([[parameter["after"] for parameter in row] for row in found])
    said = np.array([[parameter["standard_error"] for parameter in row] for row in found], dtype=np.float64).mean(
        axis=0
    )
    assert after.std(axis=0) / said == pytest.approx(np.ones(10), abs=0.3)


def test_a_tool_that_always_points_down_does_not_tell_d1_from_its_own_length() -> None:
    rng = np.random.default_rng(3)
    true = planted(ARM, rng, tick=0.0, length_m=0.0)
    found = fit(ARM, ideal_touches(true, 30, rng, flat=True))
    held = {p["name"]: p for p in found.parameters if p["held"] and p["name"] != "roll.zero_tick"}
    assert held.keys() <= {"lengths_m.d1", "lengths_m.a56", "hand.zero_tick"}
    assert held
    for parameter in held.values():
        assert (parameter["standard_error"], parameter["after"]) == (None, parameter["before"])
        assert "points" in parameter["held"]


@pytest.mark.parametrize("seed", range(5))
def test_standard_errors_own_up_to_what_was_left_alone(seed: int) -> None:
    """One way of holding the arm for all points: some parameters are held, and the others absorb their errors."""
    rng = np.random.default_rng(seed)
    true = planted(ARM, rng, tick=5.0, length_m=0.002)
    touches = []
    for _ in range(30):
        q = np.array([0.0, 1.9, -1.2, -0.9, -0.9, 0.0]) + rng.normal(0.0, [0.5, 0.1, 0.1, 0.05, 0.05, 0.0])
        touches.append(touch(true, q, 0.0003 * rng.standard_normal(3)))
    found = fit(ARM, touches)
    assert not found.complete
    truth = {f"{joint.name}.zero_tick": joint.zero_tick for joint in true.joints}
    truth |= {f"lengths_m.{name}": length for name, length in true.lengths_m.items()}
    for parameter in found.parameters:
        if parameter["standard_error"] is not None:
            assert abs(parameter["after"] - truth[parameter["name"]]) <= 4.0 * parameter["standard_error"]


def test_few_points_hold_what_they_do_not_show() -> None:
    """Three postures, time and again: little is observable, and the calibration stays near what it was."""
    found = fit(ARM, ideal_touches(ARM, 3, np.random.default_rng(4)) * 4)
    assert sum(parameter["standard_error"] is not None for parameter in found.parameters) <= 9
    assert found.rms_mm < 1e-6


@pytest.mark.parametrize("places", [1, 2])
def test_one_or_two_points_are_refused_however_often_they_were_touched(places: int) -> None:
    with refused("TOO_FEW_POINTS", f"too few different points: {places}, at least 3"):
        fit(ARM, ideal_touches(ARM, places, np.random.default_rng(4)) * 12)


def test_too_few_touches_and_points_in_the_wrong_order_are_refused() -> None:
    touches = ideal_touches(ARM, 12, np.random.default_rng(5))
    for few in (4, 1):
        with refused("TOO_FEW_POINTS", f"too few touches: {few}, at least 5 are needed"):
            fit(ARM, touches[:few])
    shuffled = moved(touches, [taken.point_m for taken in touches[1:] + touches[:1]])
    with refused("POOR_FIT", "order and the unit"):
        fit(ARM, shuffled)


# --------------------------------------------------------------------------------------------------- the new file


def test_limits_and_rest_stay_at_their_ticks() -> None:
    shifts = (12.0, -9.5, 0.0, 3.3, -30.0, 0.0)
    zeros = [joint.zero_tick + shift for joint, shift in zip(ARM.joints, shifts, strict=True)]
    after = recalibrated(ARM, zeros, {"d1": 0.1031})
    for old, new in zip(ARM.joints, after.joints, strict=True):
        assert new.limits_tick == old.limits_tick
        assert new.tick(new.rest_rad) == pytest.approx(old.tick(old.rest_rad), abs=0.02)
    assert after.joints[2] == ARM.joints[2]
    assert after.lengths_m == {"d1": 0.1031}
    assert recalibrated(ARM, [joint.zero_tick for joint in ARM.joints], {}) == ARM


def test_limits_and_rest_stay_however_often_an_arm_is_calibrated() -> None:
    arm, rng = ARM, np.random.default_rng(0)
    for _ in range(12):
        arm = recalibrated(arm, [joint.zero_tick + rng.normal() for joint in arm.joints], arm.lengths_m)
    for old, new in zip(ARM.joints, arm.joints, strict=True):
        assert new.limits_tick == old.limits_tick
        assert round(new.tick(new.rest_rad)) == round(old.tick(old.rest_rad))


def test_the_file_reads_back_as_the_arm_it_was_written_from() -> None:
    after = recalibrated(ARM, [joint.zero_tick + 1.25 for joint in ARM.joints], {"a2": 0.1049})
    text = calibration.calibration_text(after, ["one", "two"])
    assert text.startswith("# one\n# two\n")
    assert validate(ArmConfig, parse_yaml(text, "x"), "x") == after


def test_zeroing_in_a_known_pose_takes_the_ticks_as_they_are() -> None:
    ticks = [500.0, 690.5, 30.25, 760.0, 515.0, 512.0]
    after = zeroed(ARM, ticks, [joint.rest_rad for joint in ARM.joints])
    for joint, old, tick in zip(after.joints, ARM.joints, ticks, strict=True):
        assert joint.position_rad(tick) == pytest.approx(old.rest_rad, abs=0.006 * ax12a.TICK_RAD)


def test_a_gripper_keeps_its_ticks_when_its_arm_is_zeroed() -> None:
    arm = ARM.model_copy(update={"gripper": GripperConfig(joint="roll", open_deg=30.0, closed_deg=-10.0)})
    after = zeroed(arm, [joint.zero_tick + 20.0 for joint in arm.joints], [0.0] * len(arm.joints))
    assert after.joints[-1] == arm.joints[-1]
    assert [joint.zero_tick for joint in after.joints[:-1]] == [joint.zero_tick + 20.0 for joint in arm.joints[:-1]]


# -------------------------------------------------------------------------------------------------------- readings


@pytest.mark.parametrize("latency_ms", [0.0, 16.0])
def test_a_still_arm_is_read_to_a_fraction_of_a_tick(latency_ms: float) -> None:
    bench = Bench(latency_ms=latency_ms)
    ticks = read_ticks(bench.bus, bench.config.joints, bench.clock)
    assert ticks == pytest.approx([servo.position_tick for servo in bench.servos], abs=0.4)


def test_a_few_lost_replies_in_a_row_are_asked_for_again() -> None:
    bench = Bench()
    bench.arm.faults.begin(Fault(kind="lost", servo_id=2, count=7), bench.arm.time_s)
    ticks = read_ticks(bench.bus, bench.config.joints, bench.clock)
    assert ticks == pytest.approx([servo.position_tick for servo in bench.servos], abs=0.4)


def test_readings_of_an_arm_that_is_powered_silent_moving_or_gone_are_refused() -> None:
    bench = Bench()

    def refused(match: str, error: type[Exception] = RequestRefused) -> None:
        with pytest.raises(error, match=match):
            read_ticks(bench.bus, bench.config.joints, bench.clock)

    bench.servos[1].set(ax12a.TORQUE_ENABLE, 1)
    refused(r"servo 2 \(shoulder\): torque is on")
    bench.servos[1].set(ax12a.TORQUE_ENABLE, 0)
    hand = bench.arm.hand = PosingHand(bench.arm)
    hand.carry(np.array([0.5, 2.0, -2.0, 1.0, 0.0, 0.0]))
    bench.clock.advance_ns(500_000_000)
    refused("hold the tool still")
    bench.servos[1].set(ax12a.ID, 9)
    refused("NO_REPLY")
    bench.port.unplug()
    refused("vanished", PortGone)


def test_readings_survive_their_file(tmp_path: Path) -> None:
    touches = tuple(ideal_touches(ARM, 3, np.random.default_rng(0)))
    path = tmp_path / "r.yaml"
    path.write_text(calibration.readings_text(ARM.arm_id, touches))
    assert calibration.load_readings(path, ARM) == touches
    mine, short = ({"arm_id": "mine"}, "readings of 'ax12-line'"), ({"joints": ARM.joints[:5]}, "6 values for 5 servos")
    for change, match in (mine, short):
        with pytest.raises(ConfigError, match=match):
            calibration.load_readings(path, ARM.model_copy(update=change))


def test_points_are_lines_with_remarks(tmp_path: Path) -> None:
    path = tmp_path / "p.csv"
    path.write_text("# sheet\n0.2,0,0.0 # ahead\n\n -0.1, 0.15 ,1e-2\n")
    assert calibration.read_points(path) == [(0.2, 0.0, 0.0), (-0.1, 0.15, 0.01)]


@pytest.mark.parametrize("header", ["x,y,z", "x_m, y_m, z_m # metres"])
def test_points_may_have_a_header(tmp_path: Path, header: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(f"# sheet\n{header}\n0.2,0,0.0\n")
    assert calibration.read_points(path) == [(0.2, 0.0, 0.0)]


NO_POINTS = {
    "x_mm,y_mm,z_mm\n200,0,0": "line 1: 'x_mm,y_mm,z_mm' is not x,y,z in metres",
    "0.1,0.2,0\nx,y,z": "line 2: 'x,y,z' is not",
    "x,y,z\nx,y,z": "line 2: 'x,y,z' is not",
    "x,y,z\n": "no point",
    "0.1,0.2": "line 1: '0.1,0.2' is not x,y,z",
    "\n180,0,0": "line 2.*metres",
    "nan,0,0": "finite",
    "#\n": "no point",
}


@pytest.mark.parametrize(("text", "problem"), NO_POINTS.items())
def test_wrong_points_are_refused_by_line(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "p.csv"
    path.write_text(text)
    with pytest.raises(ConfigError, match=problem):
        calibration.read_points(path)
