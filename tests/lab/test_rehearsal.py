"""A log on a simulated arm: it follows, slowly at first, within every limit, judged by the simulator's truth."""

import math
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

from armctl.dynamixel import ax12a
from armctl.errors import LogError
from armctl.kinematics.transform import FloatArray
from armctl.lab.rehearsal import logged_motion, rehearse
from armctl.messages import TickRecord
from armctl.recording import timeline
from armctl.recording.timeline import Timeline
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from tests.genetic.hand import changed
from tests.host.doubles import refused
from tests.recording.factory import ARM, PERIOD_S, make_records
from tests.recording.logs import write as write_log

RECORDS = make_records(60, seed=3)


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Timeline:
    return timeline.load(write_log(tmp_path_factory.mktemp("log") / "a.mcap", RECORDS))


@pytest.fixture
def witness(monkeypatch: pytest.MonkeyPatch) -> "Witness":
    """Sees what the servos do of every rehearsal."""
    seen = Witness()

    def watched(simulated: SimulatedArm, period_s: float) -> VirtualArm:
        virtual = VirtualArm(simulated, period_s)
        virtual.on_tick = partial(seen, simulated)
        return virtual

    monkeypatch.setattr("armctl.lab.rehearsal.VirtualArm", watched)
    return seen


@dataclass
class Witness:
    """What the servos really did."""

    q: list[FloatArray] = field(default_factory=list)
    records: list[TickRecord] = field(default_factory=list)

    def __call__(self, arm: SimulatedArm, record: TickRecord) -> None:
        self.q.append(arm.true_positions())
        self.records.append(record)


def moved(log: Timeline, offset_rad: float) -> Timeline:
    """The same motion somewhere else."""
    away = np.array([0.0, -offset_rad, 0.0, 0.0, 0.0, 0.0])
    return replace(log, position_rad=log.position_rad + away, goal_rad=log.goal_rad + away)


def test_the_same_arm_repeats_its_log(log: Timeline) -> None:
    result = rehearse(log, ARM, seed=3)
    assert result.joint_rms_rad < math.radians(0.5)
    assert result.joint_max_rad < math.radians(2.0)
    assert result.tool_max_m < 0.01
    assert result.stretched_s == result.clipped_rad == 0.0
    assert log.duration_s <= result.duration_s < log.duration_s + PERIOD_S  # whole ticks


def test_the_same_seed_gives_the_same_outcome(log: Timeline) -> None:
    assert rehearse(log, ARM, seed=5) == rehearse(log, ARM, seed=5)
    assert rehearse(log, ARM, seed=5) != rehearse(log, ARM, seed=6)


def test_the_arm_eases_to_a_first_pose_far_away_and_never_lunges(log: Timeline, witness: Witness) -> None:
    rehearse(moved(log, 1.0), ARM)
    speeds = np.abs(np.diff(np.array(witness.q), axis=0)).max(axis=1) / PERIOD_S
    run = [i for i, r in enumerate(witness.records) if any(c.kind == "run" for c in r.inputs.commands)]
    approach, motion = run
    assert np.abs(witness.q[motion] - witness.q[approach]).max() > 0.9
    assert speeds[:motion].max() < math.radians(30.0)  # 20 deg/s commanded
    assert speeds[motion - 5 : motion].max() < math.radians(1.0)  # at rest before the motion begins


def test_every_goal_keeps_the_limits_and_the_speeds_even_where_the_log_does_not(
    log: Timeline, witness: Witness
) -> None:
    jump = log.goal_rad.copy()
    jump[30:, 1] -= 1.0
    jump[40:, 4] += 9.0
    result = rehearse(replace(log, goal_rad=jump), ARM)
    assert result.stretched_s > 0.8
    assert result.clipped_rad > 1.0
    goals = [record.outputs.goal.ticks for record in witness.records if record.outputs.goal is not None]
    for joint, column in zip(ARM.joints, zip(*goals, strict=True), strict=True):
        low, high = joint.limits_tick
        assert low <= min(column) <= max(column) <= high
        most = joint.speed_limit_rad_s * PERIOD_S / ax12a.TICK_RAD + 1.0
        assert max(abs(b - a) for a, b in pairwise(column)) <= most


def test_a_limp_arm_is_followed_where_it_was_led(log: Timeline) -> None:
    limp = replace(log, torque_enabled=np.zeros_like(log.torque_enabled), goal_rad=np.full_like(log.goal_rad, math.nan))
    np.testing.assert_array_equal(logged_motion(limp), log.position_rad)
    assert rehearse(limp, ARM, seed=3).joint_rms_rad < math.radians(1.0)


def test_a_log_of_another_arm_is_refused_unless_asked(log: Timeline) -> None:
    other, recalibrated = changed(ARM, arm_id="other"), changed(ARM, floor_m=0.001)
    names = ("arm_id of the log is ax12-line, of this arm other", "calibration_hash")
    for arm, named in zip((other, recalibrated), names, strict=True):
        with refused("FOREIGN_LOG", named) as refusal:
            rehearse(log, arm)
        assert "--foreign" in refusal.value.reasons[-1]
    assert rehearse(log, other, foreign=True).ticks > 0


def test_an_arm_with_other_joints_cannot_repeat_it(log: Timeline) -> None:
    smaller = ARM.model_copy(update={"joints": ARM.joints[:5]})
    with pytest.raises(LogError, match="6 joints in the log, 5 on the arm"):
        rehearse(log, smaller, foreign=True)


def test_a_log_that_knows_no_joint_has_no_motion(log: Timeline) -> None:
    unknown = np.full_like(log.position_rad, math.nan)
    with pytest.raises(LogError, match="no motion"):
        rehearse(replace(log, position_rad=unknown, goal_rad=unknown), ARM)


def test_a_long_log_is_run_in_parts(log: Timeline, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    whole = rehearse(log, ARM, seed=3)
    monkeypatch.setattr("armctl.lab.rehearsal.most_points", lambda joints: 20)
    seen: list[float] = []
    parts = rehearse(log, ARM, seed=3, progress=seen.append)
    assert (len(seen), seen[-1]) == (4, 1.0)
    assert parts.joint_rms_rad == pytest.approx(whole.joint_rms_rad, rel=0.5)
