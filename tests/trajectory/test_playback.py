"""Taught motions as an arm plays them: what is a motion, how it is smoothed and timed, what is refused."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.config import validate
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.errors import ConfigError
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import most_points
from armctl.trajectory.playback import Playback, PlayRequest, TaughtMotion, motion_from_text, playback
from armctl.trajectory.preflight import DrivenArm
from armctl.trajectory.thinning import thinned
from tests.genetic import hand
from tests.host.doubles import refused
from tests.trajectory.conftest import ARM, CHAIN, ROBOT

TIME_S: FloatArray = np.arange(61) * np.float64(0.1)
NAMES = ARM.joint_names


def swinging(time_s: FloatArray) -> FloatArray:
    """Joint positions [rad] of a slow motion near the line, shape (m, 6)."""
    swing = np.sin(np.outer(time_s, [0.6, 0.5, 0.7, 0.4, 0.3, 0.2]))
    return np.asarray(np.append(hand.joint_line()[32], 0.2) + 0.25 * swing)


def taught(q: FloatArray | None = None, joints: tuple[str, ...] = NAMES, **more: Any) -> TaughtMotion:
    rows = swinging(TIME_S) if q is None else q
    positions = tuple(map(tuple, rows.tolist()))
    return TaughtMotion(joints=joints, time_s=tuple(TIME_S.tolist()), positions_rad=positions, **more)


def played(rate: float = 1.0, motion: TaughtMotion | None = None, period_s: float = 0.1) -> Playback:
    return playback(motion or taught(), rate, DrivenArm(ARM, ROBOT, period_s))


@given(st.floats(0.1, 2.0), st.integers(2, 200))
@settings(max_examples=30)
def test_taught_time_passes_evenly_from_rest_to_rest_and_never_back(rate: float, tenths: int) -> None:
    taught_s = np.linspace(0.0, tenths / 10.0, 50)
    motion = Playback(DrivenArm(ARM, ROBOT, 0.1), rate, taught_s, np.zeros((50, 6)))
    time_s = np.linspace(0.0, motion.duration_s, 2001)
    gone = motion.taught_at(time_s)
    assert (np.diff(gone) >= -1e-12).all()
    assert (gone[0], gone[-1]) == (0.0, pytest.approx(taught_s[-1]))
    pace = np.diff(gone) / np.diff(time_s)
    assert pace.max() <= rate * (1.0 + 1e-6)
    soon_s = 1e-3 * motion.ease_s
    ends = motion.taught_at(np.array([soon_s, motion.duration_s - soon_s]))
    assert max(ends[0], taught_s[-1] - ends[1]) < 1e-8 * rate, "it rests at both ends"
    even = (time_s[:-1] > motion.ease_s) & (time_s[1:] < motion.duration_s - motion.ease_s)
    np.testing.assert_allclose(pace[even], rate, rtol=1e-6)


def test_whole_ticks_are_smoothed_and_the_motion_stays() -> None:
    rng = np.random.default_rng(1)
    ticks = np.round(swinging(TIME_S) / TICK_RAD + 0.3 * rng.standard_normal((61, 6))) * TICK_RAD
    motion = played(motion=taught(ticks))
    off = np.abs(motion.positions_rad - swinging(motion.taught_s))
    assert off.mean() < 0.25 * TICK_RAD
    bend = np.abs(np.diff(motion.positions_rad, 2, axis=0)).max() / 0.02**2
    assert bend < 1.5, "one tick up and down at 10 Hz would be 1 rad/s2 over each 0.1 s"


@given(st.floats(0.1, 0.9))
@settings(max_examples=5, deadline=None)
def test_the_played_path_is_the_taught_one_at_equal_progress(rate: float) -> None:
    motion = played(rate, period_s=0.02)
    way = motion.trajectory(swinging(np.zeros(1))[0].tolist())
    share = (np.arange(len(way.positions_rad)) * np.float64(0.02) - way.begin_s) / (way.end_s - way.begin_s)
    inside = (share >= 0.0) & (share <= 1.0)
    q = np.array(way.positions_rad)[inside]
    reference = motion.reference
    tool = tool_position(CHAIN, q[:, : CHAIN.n])
    assert reference.apart_m(tool, share[inside]).max() < 2e-4
    want = swinging(motion.taught_at(share[inside] * motion.duration_s))
    assert np.abs(q - want).max() < 2e-3
    assert way.end_s - way.begin_s == pytest.approx(6.0 / rate + motion.ease_s)


def test_what_is_too_fast_is_refused_with_the_rate_that_would_do() -> None:
    fast = taught(swinging(5.0 * TIME_S))
    here = list(fast.positions_rad[0])
    with refused("PREFLIGHT", r"deg/s, at most .*; rate 0\.\d+ would do") as caught:
        played(2.0, fast).trajectory(here)
    assert "duration" not in str(caught.value)
    would_do = float(str(caught.value).split("; rate ")[1].split(" would do")[0])
    assert 0.1 <= would_do < 2.0
    played(would_do, fast).trajectory(here)
    with refused("PREFLIGHT"):
        played(min(2.0, 1.15 * would_do), fast).trajectory(here)


def test_what_leads_below_the_floor_is_refused_as_a_whole() -> None:
    q = swinging(TIME_S)
    q[:, 1] -= np.linspace(0.0, 1.2, 61)
    with refused("PREFLIGHT", "floor"):
        played(motion=taught(q)).trajectory(q[0].tolist())


def test_joints_that_move_no_tool_point_move_as_taught_or_stay() -> None:
    here = swinging(np.zeros(1))[0]
    whole = np.array(played().trajectory(here.tolist()).positions_rad)
    assert np.ptp(whole[:, 5]) > 0.2
    chain = taught(swinging(TIME_S)[:, :5], NAMES[:5])
    stays = np.array(played(motion=chain).trajectory([*here[:5].tolist(), 0.7]).positions_rad)
    np.testing.assert_array_equal(stays[:, 5], 0.7)
    np.testing.assert_allclose(stays[:, 0], whole[:, 0])


@pytest.mark.parametrize(
    ("motion", "code", "match"),
    [
        (taught(arm_id="other", calibration_hash="x"), "FOREIGN_LOG", "recorded with arm other"),
        (taught(arm_id=ARM.arm_id, calibration_hash="older"), "FOREIGN_LOG", "calibration older"),
        (taught(swinging(TIME_S)[:, :4], NAMES[:4]), "JOINTS", "joint hand is missing"),
        (taught(joints=("knee", *NAMES[1:])), "JOINTS", "no joint 'knee'; joints: base, shoulder"),
    ],
)
def test_a_motion_that_is_not_this_arm_s_is_refused(motion: TaughtMotion, code: str, match: str) -> None:
    with refused(code, match):
        played(motion=motion)


def test_a_motion_of_this_arm_is_played() -> None:
    assert played(motion=taught(arm_id=ARM.arm_id, calibration_hash=ARM.calibration_hash)).duration_s > 6.0


ROWS = "0,0.1,20\n0.5,0.2,10\n1.0,0.3,0\n"


def test_a_table_names_joints_in_radians_or_degrees() -> None:
    motion = motion_from_text(f"time_s, base, hand_deg\n{ROWS}\n", "f.csv")
    assert (motion.joints, motion.time_s) == (("base", "hand"), (0.0, 0.5, 1.0))
    np.testing.assert_allclose(
        motion.positions_rad, [[0.1, np.radians(20)], [0.2, np.radians(10)], [0.3, 0.0]], atol=1e-5
    )


def test_of_an_exported_log_the_joints_positions_count() -> None:
    motion = motion_from_text("time_epoch_s,time_s,base.position_rad,base.load_ratio\n5,0,0.1,\n6,1,0.2,0.5\n", "f.csv")
    assert motion == TaughtMotion(joints=("base",), time_s=(0.0, 1.0), positions_rad=((0.1,), (0.2,)))


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("", "header: no column time_s"),
        (ROWS, "no column time_s"),
        ("time_s\n0\n1\n", "no column of a joint"),
        ("time_s,base,base\n0,0.1,0.1\n1,0.1,0.1\n", "each may stand there once"),
        ("time_s,base\n0,0.1\n1,much\n", "row 3"),
        ("time_s,base\n\n0,0.1\n1,much\n", "row 4"),
        ("time_s,base\n0,0.1\n1\n", "row 3: has 1 cells, the header 2"),
        ("time_s,base\n0,0.1\n1,nan\n", "row 3: 'nan'"),
        ("time_s,base\n0,0.1\n0,0.2\n", "it must rise"),
        ("time_s,base\n0,0.1\n0.2,0.2\n", "0.2 s long"),
        ("time_s,base\n0,0.1\n601,0.2\n", "601 s long"),
        ("time_s,base\n0,0.1\n", "time_s"),
    ],
)
def test_a_table_that_is_no_motion_is_refused_with_its_row(text: str, match: str) -> None:
    with pytest.raises(ConfigError, match=match) as caught:
        motion_from_text(text, "f.csv")
    assert str(caught.value).startswith("f.csv")


@pytest.mark.parametrize("fields", [{}, {"name": "a", "motion": taught()}, {"name": "a", "rate": 0.0}])
def test_a_request_names_one_motion_and_a_rate(fields: dict[str, Any]) -> None:
    with pytest.raises(ConfigError):
        validate(PlayRequest, fields, "play")


def test_a_row_with_too_few_joints_is_refused() -> None:
    with pytest.raises(ValueError, match="row 2 has not 2 numbers"):
        TaughtMotion(joints=("a", "b"), time_s=(0.0, 1.0), positions_rad=((0.0, 0.1), (0.2,)))


def test_a_motion_of_five_minutes_reaches_the_control_step_in_few_enough_points() -> None:
    time_s = np.arange(3000) * np.float64(0.1)
    rows = swinging(time_s)
    motion = TaughtMotion(joints=NAMES, time_s=tuple(time_s.tolist()), positions_rad=tuple(map(tuple, rows.tolist())))
    way = played(motion=motion).trajectory(rows[0].tolist())
    assert len(thinned(way).positions_rad) <= most_points(len(NAMES)) < len(way.positions_rad)


@pytest.mark.parametrize("side", [0, 1])
def test_what_was_taught_two_ticks_outside_a_limit_is_played_at_the_limit_and_no_more(side: int) -> None:
    limit_rad, outwards = ARM.joints[5].limits_rad[side], (-1.0, 1.0)[side]
    for beyond, plays in ((2, True), (4, False)):
        q = swinging(TIME_S)
        q[:, 5] = limit_rad + outwards * beyond * TICK_RAD
        motion = played(motion=taught(q))
        assert (motion.positions_rad[:, 5] == limit_rad).all() == plays
        if plays:
            start = [*swinging(np.zeros(1))[0, :5].tolist(), limit_rad]
            assert motion.trajectory(start).positions_rad[-1][5] == limit_rad
