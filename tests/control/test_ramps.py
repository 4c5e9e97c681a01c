"""Servos whose speed ramp begins at the shaft with each goal: noticed by what they show, and led as well as others."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, Packet
from armctl.messages import Clear, Mode, Run, TorqueOn
from armctl.sim.servo import ServoVariants
from armctl.sim.spec import RANDOM_SPEC, RANGE_SPEC, ArmSpec, put_together
from tests.control.damaged_arm import ARM, Rig, is_goal

SPECS = {"new": RANDOM_SPEC, "published": RANGE_SPEC, "worn": put_together(RANDOM_SPEC, "perfect", "worn")}
RESTARTS = ServoVariants(ramp_from_reference=False)
# Somebody's first motion: out of rest, where the arm carries its own weight.
POSES_DEG = ((0, 75, -60, -45, -45, 0), (40, 90, -80, -30, 0, 20), (-30, 60, -60, -50, 20, -20))


def held(spec: ArmSpec, seed: int, arm: ArmConfig = ARM) -> Rig:
    rig = Rig(seed, spec, arm)
    rig.ticks(45, TorqueOn(900))
    assert rig.mode() is Mode.HOLDING
    return rig


def moved(rig: Rig, *, corrected: bool, fast: bool) -> Iterator[str]:
    """Motions from pose to pose; what each was answered."""
    for number, pose in enumerate(POSES_DEG):
        way_deg = np.abs(np.array(pose) - np.degrees(rig.goals_rad)).max()
        seconds = way_deg / (60.0 if fast else 15.0)
        rig.ticks(round(seconds / 0.1) + 60, Run(number, replace(rig.way(pose, seconds), corrected=corrected)))
        yield rig.replies()[number].code


@pytest.mark.parametrize("corrected", [True, False])
@pytest.mark.parametrize("kind", SPECS)
def test_ramps_that_begin_at_the_shaft_are_noticed_and_block_no_arm(kind: str, corrected: bool) -> None:
    for seed in range(4):
        rig = held(replace(SPECS[kind], variants=RESTARTS), seed)
        assert set(moved(rig, corrected=corrected, fast=False)) == {""}
        assert rig.codes().count("RAMP_RESTARTS") == 1
        assert not rig.code()


@pytest.mark.parametrize("kind", SPECS)
def test_ramps_that_go_on_are_not_taken_for_others(kind: str) -> None:
    """Not by two ticks of noise, a dead time of 50 ms or the fastest motions either."""
    slow_to_react = replace(SPECS[kind], noise_tick=2.0, noise_spread=0.0, dead_time_s=(0.05, 0.05))
    for seed in range(4):
        rig = held(slow_to_react, seed)
        for corrected in (False, True):
            assert set(moved(rig, corrected=corrected, fast=True)) == {""}
        assert "RAMP_RESTARTS" not in rig.codes()


def test_a_joint_that_is_blocked_is_told_as_that_whatever_its_ramps_do() -> None:
    for continues in (True, False):
        rig = held(replace(RANDOM_SPEC, variants=ServoVariants(ramp_from_reference=continues)), 3)
        list(moved(rig, corrected=True, fast=False))
        rig.fault("blocked_joint", 1)
        rig.ticks(60, Run(10, rig.turned(30.0)))
        assert rig.code() in ("BLOCKED", "CONTACT")


def test_an_arm_that_fell_off_its_goals_says_nothing_of_ramps_when_it_is_led_again() -> None:
    for seed in range(6):
        rig = held(RANDOM_SPEC, seed)
        rig.ticks(8, Run(1, rig.way(POSES_DEG[1], 6.0)))
        rig.fault("stuck_joint", duration_s=1.5)
        rig.ticks(14)
        rig.restart()
        rig.ticks(6, Clear(2))
        rig.ticks(40, Run(3, rig.way(POSES_DEG[0], 8.0)))
        assert "RAMP_RESTARTS" not in rig.codes()


def lost_some(lost: Iterator[bool], packet: bytes) -> bool:
    return is_goal(packet) and next(lost)


def test_goals_that_are_lost_say_nothing_of_ramps() -> None:
    for seed in range(6):
        rig = held(RANDOM_SPEC, seed)
        lost = iter(np.random.default_rng(seed).random(1000) < 0.3)
        rig.port.damages = partial(lost_some, lost)
        list(moved(rig, corrected=False, fast=True))
        assert "RAMP_RESTARTS" not in rig.codes()


def test_a_joint_that_is_read_elsewhere_says_nothing_of_ramps() -> None:
    for joint in range(5):
        rig = held(RANDOM_SPEC, joint)
        rig.ticks(8, Run(1, rig.way(POSES_DEG[1], 6.0)))
        rig.fault("same_id", ARM.joints[joint].servo_id, duration_s=2.5)
        rig.ticks(40)
        assert "RAMP_RESTARTS" not in rig.codes()


def written_unseen(rig: Rig, goal: int, packet: bytes) -> bool:
    """Another program writes a goal of the first servo after each reading of it, and before our goal."""
    if packet[4] == Instruction.READ and packet[2] == ARM.servo_ids[-1]:
        data = bytes((ax12a.GOAL.address, 2, ARM.servo_ids[0])) + goal.to_bytes(2, "little")
        rig.simulated.servos[0].handle(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, data))
    return False


@pytest.mark.parametrize("seed", [2, 4])
def test_a_writer_that_nobody_sees_is_not_taken_for_ramps(seed: int) -> None:
    """The joint that it leads falls behind; the others, which push for more than their way of a tick, do not."""
    rig = held(RANDOM_SPEC, seed)
    list(moved(rig, corrected=True, fast=False))
    rig.port.damages = partial(written_unseen, rig, round(rig.simulated.servos[0].position_tick) - 20)
    rig.ticks(25, Run(9, rig.way((70, 75, -60, -45, -45, 0), 2.5)))
    assert "RAMP_RESTARTS" not in rig.codes()


def test_what_the_arms_file_says_of_its_ramps_is_not_found_out_again() -> None:
    events, worst_rad, codes = [], [], []
    for known in (None, False, True):
        told = ARM.model_copy(update={"ramp_from_reference": known})
        rig = held(replace(RANDOM_SPEC, variants=RESTARTS), 2, told)
        rig.ticks(50, Run(1, rig.way(POSES_DEG[0], 5.0)))
        events.append(rig.codes().count("RAMP_RESTARTS"))
        codes.append(rig.code())
        off = [
            abs(joint.position_rad - wanted_rad)
            for record in rig.records
            for joint, wanted_rad in zip(record.outputs.joints, record.outputs.wanted_rad, strict=False)
        ]
        worst_rad.append(max(off))
    assert events == [1, 0, 0]
    assert codes == ["", "", "BLOCKED"]  # the file is believed
    assert worst_rad[1] < worst_rad[0] < worst_rad[2]
