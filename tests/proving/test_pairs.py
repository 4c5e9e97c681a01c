"""The judge on arms with pairs: it reads them as the package does, and misses neither a mismatch nor a fight."""

from collections import Counter
from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from armctl.control import pairs as told_by
from armctl.dynamixel import ax12a
from armctl.messages import Mode
from armctl.sim.faults import Fault
from proving import reading
from proving.arms import arm_of, arm_text, drawn, varied
from proving.episode import Episode, stage_of
from proving.evidence import Sent, Servo, Strain
from proving.invariants import Judge
from proving.pairs import PairWatch
from proving.soak import drawn_by
from proving.story import Story, Strike, Wish

NAMES = ("phantomx-reactor", "crustcrawler")


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("episode", range(12))
def test_the_judge_reads_a_pair_as_the_package_does(name: str, episode: int) -> None:
    text = drawn(7, episode, name)
    ours, theirs = reading.read(text), arm_of(text)
    assert ours.servo_ids == theirs.servo_ids
    assert [joint.name for joint in ours.joints] == list(theirs.joint_names)
    for mine, servo in zip(ours.servos, theirs.servos, strict=True):
        assert (mine.name, mine.low, mine.high) == (servo.name, *servo.limits_tick)
        for tick in np.linspace(mine.low, mine.high, 20):
            position_rad = servo.position_rad(float(tick))
            assert np.radians(mine.position_deg(float(tick))) == pytest.approx(position_rad, abs=1e-9)
            if servo.linkage is not None:
                assert mine.beside_tick(float(tick)) == pytest.approx(servo.linkage.second(float(tick)))
    grips = ours.gripper
    assert ours.pairs == tuple(pair for pair in theirs.pairs if pair[0] != grips)


def test_varied_arms_have_measured_pairs_and_such_as_are_not() -> None:
    texts = [varied(arm_text("phantomx-reactor"), np.random.default_rng(k)) for k in range(12)]
    tables = [joint.pair.table for text in texts for joint in arm_of(text).joints if joint.pair is not None]
    assert 0 < sum(table is None for table in tables) < len(tables)


def test_every_episode_has_horns_that_slip_and_a_servo_of_a_pair_that_dies() -> None:
    kinds: Counter[str] = Counter()
    for episode in range(6):
        on, story = drawn_by(1, episode, "phantomx-reactor")
        struck = [line.fault for line in story.lines if isinstance(line, Strike)]
        slips = [fault for fault in struck if fault.kind == "pair_mismatch"]
        assert len(slips) == 3
        assert {fault.servo_id for fault in slips} <= {on.arm.servo_ids[second] for _, second in on.arm.pairs}
        kinds.update(fault.kind for fault in struck)
        kinds.update("fifteen" if abs(fault.value or 0.0) == 15.0 else "other" for fault in slips)
    assert kinds["fifteen"] >= 3
    assert min(kinds[kind] for kind in ("trip", "brown_out", "mute")) >= 1
    assert not [line for line in drawn_by(1, 0)[1].lines if isinstance(line, Strike) and "pair" in line.fault.kind]


def slipped(value: float, slope: int = 32, begin_s: float = 12.0) -> list[str]:
    """What the judge finds where a horn of the Reactor's elbow slips while it holds, or before."""
    text = arm_text("phantomx-reactor").replace("pair: {servo_id: 4}}", f"pair: {{servo_id: 4}}, {stiff(slope)}}}")
    slip = Strike(Fault(kind="pair_mismatch", servo_id=4, value=value, begin_s=begin_s, duration_s=12.0))
    story = Story(3, 24.0, (Wish(1.0, "run", 5), slip))
    return [violation.invariant for violation in Episode(story, stage_of(text)).play().violations]


def stiff(slope: int) -> str:
    return f"compliance: {{margin: 1, slope: {slope}, punch: 32}}"


@pytest.mark.parametrize("value", [-25.0, 6.0, 15.0, 20.0])
def test_a_horn_that_slips_breaks_no_rule(value: float) -> None:
    assert slipped(value) == []


def test_a_program_that_tells_no_mismatch_is_found() -> None:
    with patch.object(told_by, "PAIR_S", 1e6):
        assert slipped(20.0) == ["pair"]


@pytest.mark.parametrize("begin_s", [8.0, 9.5, 10.5])
def test_a_pair_that_fights_while_the_tool_is_brought_to_its_place_is_told_in_time(begin_s: float) -> None:
    """Before, the time counted only from when the motion was over, up to 3 s later."""
    assert slipped(13.0, slope=16, begin_s=begin_s) == []


@pytest.mark.parametrize(("told", "left", "broken"), [(False, True, 1), (True, False, 1), (True, True, 0)])
def test_a_pair_that_fights_is_excused_only_where_it_is_told_and_the_arm_left_to_another_program(
    told: bool, left: bool, broken: int
) -> None:
    arm = reading.read(arm_text("phantomx-reactor"))
    watch, n = PairWatch(arm), len(arm.servos)
    servos, strains = [Servo(True, 512, 100, 1023, 512.0, 512)] * n, [Strain(0.0, 0.0, 12.0, 30.0)] * n
    first, second = arm.pairs[0]
    strains[first] = strains[second] = Strain(0.4, 0.0, 12.0, 30.0)
    looks = [watch.look(k / 10, servos, servos, strains, [True] * n, told=told, left=left) for k in range(40)]
    assert len({text for look in looks for i, text in look if i == first and "push against" in text}) == broken


def test_a_program_that_lets_a_pair_fight_is_found() -> None:
    """Twice as stiff, so that they fight before they read too far apart."""
    assert slipped(13.0, slope=16) == []
    with patch.object(told_by, "AGAINST_RATIO", 2.0):
        assert slipped(13.0, slope=16) == ["pair"]


@pytest.mark.parametrize(
    ("shaft", "torque", "off", "code", "broken"),
    [
        (-20.0, True, 5.0, "BLOCKED", 0),
        (-20.0, False, 5.0, "BLOCKED", 1),
        (-20.0, True, 50.0, "BLOCKED", 1),
        (-20.0, True, 5.0, "", 1),
        (5.0, True, 5.0, "BLOCKED", 1),
    ],
)
def test_of_a_pair_only_the_servo_that_sees_nothing_is_let_go_alone(
    shaft: float, torque: bool, off: float, code: str, broken: int
) -> None:
    """Past the end of its sensor, while the other one holds and sees, and a fault is told."""
    judged = reading.read(arm_text("phantomx-reactor"))
    first, second = judged.pairs[0]
    judge, n = Judge(judged, 0.1, [(one.low, one.high) for one in judged.servos]), len(judged.servos)
    judge.back()
    judge.reported(0.0, Mode.FAULTED, code, codes=frozenset(filter(None, (code,))))
    before = [Servo(k != first or torque, 512, 100, 1023, 512.0 + off * (k == first), 512) for k in range(n)]
    before[second] = replace(before[second], shaft_tick=shaft, sensed_tick=700)
    after = [replace(servo, torque=servo.torque and k != second) for k, servo in enumerate(before)]
    judge.wrote(1.0, [Sent(second, ax12a.TORQUE_ENABLE.address, b"\0")], before, after)
    assert len([found for found in judge.violations if found.invariant == "5"]) == broken
