"""Two servos on one joint, in the control step: one joint out of two, two goals out of one, and where they disagree."""

import math
import re
from dataclasses import replace
from itertools import pairwise
from pathlib import Path

import pytest

from armctl.clock import NS_PER_S, VirtualClock
from armctl.control.motion import LEAD_TICKS, ROUNDING_TICKS
from armctl.control.pairs import AGAINST_RATIO
from armctl.dynamixel import ax12a
from armctl.json_text import from_json, to_json
from armctl.messages import Clear, Mode, Park, Release, Run, TickRecord, TorqueOn
from armctl.pair import APART_TICKS
from armctl.recording.replay import check
from armctl.recording.writer import LogContext
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import DEFAULT_SPEC
from armctl.sim.virtual_arm import VirtualArm
from tests.control.damaged_arm import Rig
from tests.paired import paired_arm
from tests.recording.factory import CONTEXT, nod
from tests.recording.logs import write

ARM = paired_arm()
# Places of the shoulder's servos, and of the elbow's.
SHOULDER, ELBOW = ARM.pairs
ALIKE = replace(DEFAULT_SPEC, pair_offset_tick=0.0)


def against(rig: Rig) -> float:
    """With how much each servo of the shoulder pushes against the other, as the servos have it."""
    first, second = (rig.simulated.servos[i].output for i in SHOULDER)
    return abs(first + second) / 2.0  # the second one faces the first


@pytest.mark.parametrize("seed", range(4))
def test_both_servos_of_a_joint_get_one_goal_in_one_packet_and_share_the_load(seed: int) -> None:
    rig = Rig(seed=seed, arm=ARM).holding().at()
    joints = rig.records[-1].outputs.joints
    for record in rig.records:
        assert len(record.outputs.joints) == len(ARM.joints)
    moving = [r.outputs.goal.ticks for r in rig.records if r.outputs.goal is not None and r.outputs.mode is Mode.MOVING]
    for first, second in (SHOULDER, ELBOW):
        off = [abs(goal[first] + goal[second] - 1023) for goal in moving]
        assert all(0 <= a - b <= 1 for a, b in pairwise(off)), "from its own place to that beside the first one"
        assert off[-40:] == [0] * 40
    for first, second in (SHOULDER, ELBOW):
        has = ARM.servos[first].position_rad(rig.simulated.servos[first].position_tick)
        assert joints[first].position_rad == pytest.approx(has, abs=0.01)
        loads = [rig.records[-1].inputs.sample.servos[i].registers for i in (first, second)]
        told = [ax12a.decode(block).load_ratio for block in loads]  # type: ignore[union-attr]
        assert joints[first].load_ratio == pytest.approx((told[0] - told[1]) / 2.0)
    assert rig.replies()[901].ok
    assert against(rig) < AGAINST_RATIO
    true_deg = [math.degrees(q) for q in rig.simulated.true_positions()]
    assert true_deg[1] == pytest.approx(20.0, abs=2.0)


def test_torque_comes_on_where_each_servo_is_and_none_pulls_at_the_other() -> None:
    rig = Rig(arm=ARM).holding()
    for i, servo in enumerate(rig.simulated.servos):
        assert abs(rig.loop.state.goal[i] - servo.position_tick) <= 2
        assert servo.get(ax12a.TORQUE_LIMIT) == 1023
        assert servo.get(ax12a.CW_SLOPE) == 32
    assert against(rig) < 0.05
    rig.ticks(30, Release(5))
    assert rig.stiff() == []


@pytest.mark.parametrize("powered", [False, True])
def test_servos_that_read_apart_are_a_fault_that_lasts_until_they_do_not(powered: bool) -> None:
    rig = Rig(arm=ARM, spec=ALIKE)
    if powered:
        rig.holding().at()
    fault = rig.fault("pair_mismatch", 12, value=15.0)
    rig.ticks(24)
    assert rig.code() == "PAIR_MISMATCH"
    said = r"servo 2 \(shoulder\): reads 1[3-7] ticks off servo 12 of the same joint \(bound 12\) for 2 s"
    assert re.fullmatch(said, rig.loop.state.faults[0].text)
    rig.ticks(20, Clear(7))
    assert rig.replies()[7].code == "NOT_CLEARED"
    assert re.search(r"the servos of shoulder read 1[3-7] ticks apart \(bound 12\)", rig.replies()[7].message)
    assert rig.mode() is Mode.FAULTED
    if powered:
        assert against(rig) < AGAINST_RATIO / 2.0, "it is relieved"
        assert len(rig.stiff()) == len(ARM.servos)
    rig.simulated.faults.end(fault)
    rig.ticks(10)
    rig.ticks(10, Clear(8))
    assert rig.replies()[8].ok, rig.replies()[8].message


def test_servos_that_push_against_each_other_at_rest_are_relieved_and_a_fault() -> None:
    """Twice as stiff, they push with over a fifth of their output by ten ticks, which is nothing to be seen of."""
    arm = paired_arm(compliance={"margin": 1, "slope": 16, "punch": 32})
    rig = Rig(arm=arm, spec=ALIKE).holding().at()
    rig.fault("pair_mismatch", 12, value=10.0)
    rig.ticks(5)
    assert against(rig) > AGAINST_RATIO
    rig.ticks(25)
    assert rig.code() == "PAIR_MISMATCH"
    assert "push against each other with" in rig.loop.state.faults[0].text
    assert against(rig) < AGAINST_RATIO / 2.0
    rig.ticks(3, Clear(7))
    assert rig.replies()[7].ok


def test_a_motion_slows_down_where_a_horn_slips() -> None:
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    rig.fault("pair_mismatch", 13, value=20.0)
    rig.ticks(60, Run(5, rig.turned(40.0)))
    assert rig.replies()[5].code == "PAIR_MISMATCH"
    assert rig.loop.state.faults[0].servo_id == 3


@pytest.mark.parametrize("apart_ticks", [25.0, -25.0])
def test_no_goal_is_farther_ahead_of_either_servo_of_a_pair_than_one_may_be(apart_ticks: float) -> None:
    """The second one is behind by what its horn has slipped, and by what every servo is that turns fast."""
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    rig.fault("pair_mismatch", 12, value=apart_ticks)
    rig.ticks(40, Run(5, rig.turned(60.0, joint=1, seconds=1.2)), Run(6, rig.turned(-60.0, joint=1, seconds=1.2)))
    before = [r for r in rig.records if r.outputs.goal is not None and r.outputs.mode is Mode.MOVING]
    for record in before:
        assert record.outputs.goal is not None
        said = [servo.registers for servo in record.inputs.sample.servos]
        seen = [ax12a.register_value(ax12a.PRESENT_POSITION, block) for block in said if block]
        ahead = [abs(a - b) for a, b in zip(record.outputs.goal.ticks, seen, strict=True)]
        assert max(ahead) <= LEAD_TICKS + ROUNDING_TICKS, f"at {record.inputs.now_ns / NS_PER_S:.1f} s"


def test_some_ticks_are_no_mismatch() -> None:
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    rig.fault("pair_mismatch", 12, value=APART_TICKS - 3.0)
    rig.ticks(100, Run(5, rig.turned(20.0)))
    assert rig.replies()[5].ok
    assert not rig.loop.state.faults
    assert against(rig) < AGAINST_RATIO


@pytest.mark.parametrize(
    ("kind", "code"), [("brown_out", "LOST_TORQUE"), ("trip", "TRIPPED"), ("mute", "SERVO_SILENT"), ("hot", "HOT")]
)
@pytest.mark.parametrize("servo_id", [2, 12])
def test_one_servo_of_a_pair_that_fails_is_named_and_the_others_hold(kind: str, code: str, servo_id: int) -> None:
    rig = Rig(arm=ARM).holding().at()
    rig.fault(kind, servo_id, **({"value": 68.0} if kind == "hot" else {}))
    rig.ticks(26)
    assert [(fault.code, fault.servo_id) for fault in rig.loop.state.faults if fault.code == code] == [(code, servo_id)]
    limp = {servo_id} if code in ("LOST_TORQUE", "TRIPPED") else set()
    assert set(rig.stiff()) == set(ARM.servo_ids) - limp
    assert not any(record.outputs.goal for record in rig.records[-5:])


def test_a_blocked_pair_is_relieved_as_one_joint() -> None:
    rig = Rig(arm=ARM).holding().at()
    rig.fault("blocked_joint", 12)
    rig.ticks(60, Run(5, rig.way((0.0, 70.0, -10.0, -10.0, 0.0, 0.0), 2.0)))
    assert rig.replies()[5].code == "BLOCKED"
    rig.ticks(20)
    assert all(abs(rig.simulated.servos[i].output) < 0.5 for i in SHOULDER)


def test_a_servo_that_was_silent_as_its_joint_was_relieved_stays_where_it_is_once_it_is_heard() -> None:
    """Where it was by then nobody knew; its partner's horn slips meanwhile, which takes it along."""
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    rig.ticks(12, Run(5, rig.way((0.0, 70.0, -10.0, -10.0, 0.0, 0.0), 4.0)))
    rig.fault("blocked_joint", 2)
    rig.ticks(5)
    silence = rig.fault("mute", 2)
    while not rig.code():
        rig.ticks(1)
    assert rig.code() == "BLOCKED"
    rig.fault("pair_mismatch", 12, value=20.0)
    rig.ticks(10)
    rig.simulated.faults.end(silence)
    rig.ticks(4)
    assert against(rig) < AGAINST_RATIO


@pytest.mark.parametrize("apart_ticks", [40, -40])
def test_a_pair_that_was_found_with_goals_of_another_program_apart_is_relieved_at_once(apart_ticks: int) -> None:
    """Each is blocked by the other. Before, where their joint bore nothing that way, they pushed until they tripped."""
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    for i in SHOULDER:
        rig.simulated.servos[i].set(ax12a.GOAL, rig.loop.state.goal[i] + apart_ticks)
    rig.restart()
    rig.ticks(4)
    assert against(rig) > AGAINST_RATIO
    rig.ticks(4)
    assert rig.code() == "BLOCKED"
    assert against(rig) < AGAINST_RATIO / 2.0
    assert len(rig.stiff()) == len(ARM.servos)


def test_a_measured_table_is_what_goals_and_position_go_by() -> None:
    arm = paired_arm({"table": [[170, 866], [400, 634], [760, 270]]})
    rig = Rig(arm=arm, spec=ALIKE).holding().at()
    goal = rig.loop.state.goal
    first, second = SHOULDER
    link = arm.servos[second].linkage
    assert link is not None
    assert goal[second] == round(link.second(goal[first]))
    assert goal[second] - (1023 - goal[first]) > 8
    has = [arm.servos[i].position_rad(rig.simulated.servos[i].position_tick) for i in SHOULDER]
    assert rig.records[-1].outputs.joints[first].position_rad == pytest.approx(sum(has) / 2.0, abs=0.01)
    assert against(rig) < 0.1


def test_a_pair_parks_and_goes_limp() -> None:
    rig = Rig(arm=ARM).holding().at()
    rig.ticks(150, Park(5))
    assert rig.replies()[5].ok
    assert rig.stiff() == []


def test_servos_that_read_apart_do_not_pull_at_each_other_on_a_way_to_rest() -> None:
    rig = Rig(arm=ARM, spec=ALIKE).holding().at()
    rig.fault("pair_mismatch", 12, value=20.0)
    rig.ticks(30)
    assert rig.code() == "PAIR_MISMATCH"
    for servo_id in ARM.servo_ids:
        rig.fault("hot", servo_id, value=67.0)
    began = len(rig.records)
    worst = 0.0
    for _ in range(250):
        rig.tick()
        worst = max(worst, against(rig))
    told = [event.code for record in rig.records[began:] for event in record.outputs.events]
    assert {"PLAN_BEGIN", "NOT_AT_REST"} <= set(told)
    assert worst < AGAINST_RATIO
    assert len(rig.stiff()) == len(ARM.servos)


def test_torque_is_not_cut_where_one_servo_of_a_pair_shows_that_the_arm_is_not_at_rest() -> None:
    """A horn slips as the arm arrives: one servo is before its place, the other beyond it, their mean at rest."""
    arm = paired_arm({"table": [[170, 853], [760, 263]]})
    rig = Rig(arm=arm, spec=ALIKE).holding().at()
    rig.ticks(150, Park(5))
    modes = [record.outputs.mode for record in rig.records]
    took = len(modes) - modes.index(Mode.PARKING) - modes[::-1].index(Mode.PARKING)
    rig = Rig(arm=arm, spec=ALIKE).holding().at()
    rig.ticks(took - 1, Park(5))
    rig.fault("pair_mismatch", 12, value=25.0)
    rig.ticks(30)
    assert rig.replies()[5].code in ("NOT_AT_REST", "PAIR_MISMATCH")
    assert len(rig.stiff()) == len(ARM.servos)


def test_an_arm_of_single_servos_is_not_told_of_pairs() -> None:
    rig = Rig().holding()
    assert "pair_since_ns" not in to_json(rig.loop.state)
    paired = Rig(arm=ARM).holding()
    paired.fault("pair_mismatch", 12, value=30.0)
    paired.ticks(3)
    text = to_json(paired.loop.state)
    assert '"pair_since_ns":[' in text
    assert from_json(type(paired.loop.state), text) == paired.loop.state


# ---------------------------------------------------------------------------------------------------- in the log


def recorded(ticks: int = 90) -> list[TickRecord]:
    virtual = VirtualArm(SimulatedArm(ARM, seed=1), 0.1, clock=VirtualClock(5 * NS_PER_S))
    virtual.start()
    records = []
    for tick in range(ticks):
        commands = {3: (TorqueOn(1),), 20: (Run(2, nod(virtual.goals_rad)),)}.get(tick, ()) if tick in (3, 20) else ()
        if tick == 60:
            virtual.simulated.servos[SHOULDER[1]].protect(overloaded=True)
        record = virtual.tick(*commands)
        records.append(replace(record, keyframe=to_json(virtual.loop.state)))
    return records


RECORDS = recorded()
LOGGED = LogContext(ARM, CONTEXT.robot, CONTEXT.config, CONTEXT.port, CONTEXT.period_s)


def test_a_log_of_pairs_is_replayed_bit_for_bit(tmp_path: Path) -> None:
    result = check(write(tmp_path / "a.mcap", RECORDS, context=LOGGED))
    assert (result.ticks, result.mismatches, result.skipped) == (len(RECORDS), 0, 0), result.first_mismatch
    assert RECORDS[-1].outputs.faults[0].code == "TRIPPED"


@pytest.mark.parametrize("index", range(len(ARM.servos)))
def test_another_goal_or_reading_of_any_servo_differs_in_a_replay(index: int, tmp_path: Path) -> None:
    moving = next(record for record in RECORDS if record.inputs.tick > 25 and record.outputs.goal is not None)
    goal = moving.outputs.goal
    assert goal is not None
    keyframe = RECORDS[moving.inputs.tick - 1].keyframe
    for name in ("ticks", "speeds"):
        values = list(getattr(goal, name))
        values[index] += 1
        outputs = replace(moving.outputs, goal=replace(goal, **{name: tuple(values)}))
        changed = replace(moving, outputs=outputs)
        result = check(write(tmp_path / f"{name}.mcap", [changed], keyframe=keyframe, context=LOGGED))
        assert result.mismatches == 1
        assert result.first is not None
        assert result.first["field"].startswith("/joint_commands")
    sample = moving.inputs.sample
    block = bytearray(sample.servos[index].registers)
    block[ax12a.POSITION_AT] ^= 1
    servos = list(sample.servos)
    servos[index] = replace(servos[index], registers=bytes(block))
    read = replace(moving, inputs=replace(moving.inputs, sample=replace(sample, servos=tuple(servos))))
    assert check(write(tmp_path / "read.mcap", [read], keyframe=keyframe, context=LOGGED)).mismatches > 0


@pytest.mark.parametrize("beyond_ticks", [11.0, 30.0, 60.0])
def test_a_servo_that_a_slipped_horn_takes_past_the_end_of_its_sensor_is_let_go_alone(beyond_ticks: float) -> None:
    """It reads anything there, and works at full against the other one whatever goal it has."""
    arm = paired_arm({"zero_tick": 560.0})
    rig = Rig(arm=arm, spec=ALIKE).holding().at((0.0, 140.0, -110.0, -10.0, 0.0, 0.0))
    held_deg, second = rig.joint_deg(1), rig.simulated.servos[SHOULDER[1]]
    rig.fault("pair_mismatch", 12, value=-round(second.position_tick) - beyond_ticks)
    rig.ticks(20)
    assert {"BLOCKED", "PAIR_MISMATCH"} <= {fault.code for fault in rig.loop.state.faults}
    text = next(fault.text for fault in rig.loop.state.faults if fault.code == "PAIR_MISMATCH")
    assert re.match(r"servo 12 \(shoulder\): works at full wherever it .* servo 2 holds the joint alone", text)
    assert set(rig.stiff()) == set(arm.servo_ids) - {12}
    assert [fault.follows for fault in rig.loop.state.faults if fault.code == "LOST_TORQUE"] == ["PAIR_MISMATCH"]
    rig.ticks(40, Clear(5))
    assert rig.replies()[5].code == "NOT_CLEARED"
    assert set(rig.stiff()) == set(arm.servo_ids) - {12}
    assert rig.joint_deg(1) == pytest.approx(held_deg, abs=15.0)
    rig.ticks(10, Release(6))
    assert rig.stiff() == []
