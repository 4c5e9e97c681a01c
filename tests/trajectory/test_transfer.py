"""The transfer robot's cycle: through its stations, straight down, smooth, and as its parameters say."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, reject, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from armctl.config import ChainTable
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.inverse import pointing
from armctl.kinematics.transform import matrix_from_rpy, rpy_from_matrix
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.transfer import TransferRequest, motion, transfer_trajectory
from tests.host.doubles import refused

ARM = load_arm("transfer-6dof")
ROBOT = robots.get(ARM.robot, ARM.lengths_m)
REST = [joint.rest_rad for joint in ARM.joints]
CYCLE = TransferRequest(pick_m=(0.176, -0.132, -0.15), place_m=(0.176, 0.132, -0.15))


def test_cycles_longer_than_any_motion_are_refused_at_once() -> None:
    with pytest.raises(ValidationError, match=r"660.0 s .*at most 600 s; ask for fewer cycles"):
        TransferRequest(pick_m=CYCLE.pick_m, place_m=CYCLE.place_m, lift_s=5.0, carry_s=6.0, dwell_s=0.5, cycles=20)


def test_the_paw_is_at_both_stations_when_it_should_be_and_points_down_there() -> None:
    model = motion(CYCLE, ARM, ROBOT)
    assert model.duration_s == pytest.approx(4 * CYCLE.lift_s + 2 * CYCLE.carry_s + 2 * CYCLE.dwell_s)
    place_s = 3 * CYCLE.lift_s + CYCLE.dwell_s + CYCLE.carry_s
    at_s = np.array([0.0, CYCLE.lift_s, CYCLE.lift_s + CYCLE.dwell_s, place_s, model.duration_s])
    T = forward_kinematics(ROBOT.chain, model.sample(at_s)[0])
    over = np.add(CYCLE.pick_m, (0.0, 0.0, CYCLE.height_m))
    for pose, point in zip(T, (over, CYCLE.pick_m, CYCLE.pick_m, CYCLE.place_m, over), strict=True):
        assert pose[:3, 3] == pytest.approx(point, abs=1e-9)
        assert pose[:3, 2] == pytest.approx((0.0, 0.0, -1.0), abs=1e-9)


@settings(max_examples=10)
@given(st.floats(0.18, 0.22), st.floats(-0.18, -0.02), st.floats(0.02, 0.06), st.floats(1.0, 3.0))
def test_lifts_are_straight_and_the_motion_has_no_jump_in_acceleration(
    reach_m: float, z: float, height_m: float, lift_s: float
) -> None:
    x, y = 0.8 * reach_m, 0.6 * reach_m
    cycle = TransferRequest(pick_m=(x, -y, z), place_m=(x, y, z), height_m=height_m, lift_s=lift_s)
    try:
        model = motion(cycle, ARM, ROBOT)
    except RequestRefused:
        reject()
    down = tool_position(ROBOT.chain, model.sample(np.linspace(0.0, lift_s, 101))[0])
    assert np.abs(down[:, :2] - np.array(cycle.pick_m[:2])).max() < 1e-3
    for piece, following in zip(model.pieces[:-1], model.pieces[1:], strict=True):
        end, begin = piece.sample(np.array([piece.duration_s])), following.sample(np.zeros(1))
        for order in range(3):
            assert end[order] == pytest.approx(begin[order], abs=1e-7)


def test_velocity_and_acceleration_are_the_derivatives_of_position() -> None:
    model = motion(CYCLE, ARM, ROBOT)
    time_s = np.linspace(0.1, model.duration_s - 0.1, 400)
    h = 1e-5
    before, now, after = (model.sample(time_s + shift) for shift in (-h, 0.0, h))
    assert np.abs((after[0] - before[0]) / (2 * h) - now[1]).max() < 1e-6
    assert np.abs((after[1] - before[1]) / (2 * h) - now[2]).max() < 1e-4


def test_what_is_commanded_is_the_model_at_the_ticks() -> None:
    twice = CYCLE.model_copy(update={"cycles": 2})
    trajectory, model = transfer_trajectory(twice, REST, DrivenArm(ARM, ROBOT, 0.1)), motion(twice, ARM, ROBOT)
    rows = np.array(trajectory.positions_rad)
    assert rows[0] == pytest.approx(REST)
    begin = round(trajectory.begin_s / 0.1)
    time_s = np.linspace(0.0, 0.1 * (len(rows) - 1 - begin), len(rows) - begin)
    assert rows[begin:] == pytest.approx(model.sample(time_s)[0])
    assert trajectory.end_s - trajectory.begin_s == pytest.approx(model.duration_s)


def test_other_lengths_give_another_motion_to_the_same_places() -> None:
    both = ROBOT, replace(ROBOT, lengths_m={**ROBOT.lengths_m, "a2": 0.19})
    bottom = [motion(CYCLE, ARM, robot).sample(np.array([CYCLE.lift_s]))[0] for robot in both]
    for robot, q in zip(both, bottom, strict=True):
        assert tool_position(robot.chain, q)[0] == pytest.approx(CYCLE.pick_m, abs=1e-9)
    assert np.abs(bottom[0] - bottom[1]).max() > math.radians(2.0)


def test_a_station_out_of_reach_is_refused_with_the_distance() -> None:
    far = CYCLE.model_copy(update={"place_m": (0.5, 0.0, 0.0)})
    with refused("UNREACHABLE", r"cannot point down at .* mm off"):
        motion(far, ARM, ROBOT)


@pytest.mark.parametrize("reach_m", [0.14, 0.17, 0.2])
@pytest.mark.parametrize(
    ("name", "turn_deg"), [("ax12-line", 0.0), ("phantomx-reactor", 0.0), ("phantomx-reactor", 70.0)]
)
def test_any_tool_points_down_as_it_does_when_it_reaches(name: str, turn_deg: float, reach_m: float) -> None:
    """Wherever the axes of its frame lie: ax12-line's lies along x, and a frame may be turned about its own z."""
    arm = load_arm(name)
    if turn_deg:
        assert isinstance(arm.robot, ChainTable)
        R = matrix_from_rpy(*np.radians(arm.robot.tool_rpy_deg)) @ matrix_from_rpy(0.0, 0.0, math.radians(turn_deg))
        table = arm.robot.model_copy(update={"tool_rpy_deg": tuple(np.degrees(rpy_from_matrix(R)).tolist())})
        arm = arm.model_copy(update={"robot": table})
    robot, stations = robots.of(arm), [(reach_m, y, 0.06) for y in (-0.05, 0.05)]
    cycle = TransferRequest(pick_m=stations[0], place_m=stations[1], height_m=0.03)
    here = [joint.rest_rad for joint in arm.joints]
    made = transfer_trajectory(cycle, here, DrivenArm(arm, robot, 0.1))
    T = forward_kinematics(robot.chain, np.array(made.positions_rad)[round(made.begin_s / 0.1) :, : robot.chain.n])
    high = T[:, 2, 3]
    for station in stations:
        off_m = np.linalg.norm(T[:, :3, 3] - station, axis=1)
        assert off_m.min() < 1e-4
        lift = T[(np.hypot(*(T[:, :2, 3] - station[:2]).T) < 1e-3) & (high < 0.09)]
        np.testing.assert_allclose(lift[:, :3, :3] @ pointing(robot.chain), [(0.0, 0.0, -1.0)] * len(lift), atol=0.01)
        assert len(lift) > 40


def test_a_cycle_that_is_too_fast_is_refused_with_every_reason() -> None:
    with refused("PREFLIGHT", "deg/s") as caught:
        transfer_trajectory(CYCLE.model_copy(update={"carry_s": 0.5}), REST, DrivenArm(ARM, ROBOT, 0.1))
    assert any("the tool would reach" in reason for reason in caught.value.reasons)
