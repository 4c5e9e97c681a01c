"""The table of two servos on one joint: measured of a limp arm that a hand leads, and true after it."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from armctl.commissioning.calibration import calibration_text, recalibrated
from armctl.commissioning.pairs import measured
from armctl.config import ArmConfig, parse_yaml, validate
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.errors import ConfigError, RequestRefused
from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import ArmSpec
from tests.commissioning.bench import Bench, PosingHand, unwritten
from tests.control.damaged_arm import Rig
from tests.control.test_pairs import ALIKE
from tests.paired import paired_arm

ARM = paired_arm()
FAR = ArmSpec(pair_offset_tick=15.0)


# Seeds that draw the shoulder's second servo far off.
FAR_OFF = (30, 32)


class LedBench(Bench):
    """An arm whose hand leads a joint from end to end when it is asked to."""

    def __init__(self, seed: int, *, leads: bool = True) -> None:
        super().__init__(seed=seed, spec=FAR, simulated=ARM)
        self.hand = self.arm.hand = PosingHand(self.arm)
        self.hand.CARRY_S = 6.0
        self.posture = np.array([joint.rest_rad for joint in ARM.joints])
        self.hand.carry(self.posture)
        self.asked: list[str] = []
        self._leads = leads

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        assert not choices
        self.asked.append(key)
        name = key.removesuffix(".pair")
        assert f"lead the limp {name} through its range" in text
        if self._leads:
            index = ARM.joint_names.index(name)
            low, high = ARM.joints[index].limits_rad
            self.posture = self.posture.copy()
            self.posture[index] = high if abs(self.posture[index] - low) < abs(self.posture[index] - high) else low
            self.hand.carry(self.posture)
        return ""

    @contextmanager
    def opened(self, servo_ids: Sequence[int]) -> Iterator[ServoBus]:
        bus = ServoBus(self.port, servo_ids)
        self.bus.close()
        bus.open()
        yield bus
        bus.close()

    def again(self, refusal: RequestRefused) -> bool:
        return False

    def measured(self) -> ArmConfig:
        return measured(ARM, self.opened, self)


@pytest.mark.parametrize("seed", range(3))
def test_a_table_says_what_the_second_servo_reads_wherever_the_joint_is(seed: int) -> None:
    bench = LedBench(seed)
    with unwritten(bench):
        after = bench.measured()
    assert bench.asked == ["shoulder.pair", "elbow.pair"]
    assert validate(ArmConfig, parse_yaml(calibration_text(after, []), "FILE"), "FILE") == after
    for first, second in after.pairs:
        link, joint = after.servos[second].linkage, after.joints[first]
        assert link is not None
        assert joint.pair is not None
        assert joint.pair.table is not None
        assert len(joint.pair.table) > 15
        truth = bench.servos[first].position_tick + bench.servos[second].position_tick - 1023.0
        assert abs(truth) <= 15.0
        for tick in np.linspace(*joint.limits_tick, 30):
            assert link.second(float(tick)) == pytest.approx(1023.0 - tick + truth, abs=1.2)


@pytest.mark.parametrize("seed", FAR_OFF)
def test_a_pair_far_off_that_was_measured_neither_fights_nor_is_a_fault(seed: int) -> None:
    first, second = (SimulatedArm(ARM, seed=seed, spec=FAR).servos[i] for i in ARM.pairs[0])
    assert abs(first.position_tick + second.position_tick - 1023.0) > 13.0
    before = Rig(seed=seed, arm=ARM, spec=FAR)
    before.ticks(30)
    assert before.code() == "PAIR_MISMATCH"
    after = Rig(seed=seed, arm=LedBench(seed).measured(), spec=ALIKE).holding().at()
    assert not after.loop.state.faults
    assert abs(after.simulated.servos[1].output + after.simulated.servos[6].output) / 2.0 < 0.1


@pytest.mark.parametrize("trouble", ["stands", "powered", "mute"])
def test_what_was_not_shown_is_not_written_down(trouble: str) -> None:
    bench = LedBench(0, leads=trouble != "stands")
    if trouble == "powered":
        bench.servos[6].set(ax12a.TORQUE_ENABLE, 1)
    if trouble == "mute":
        bench.servos[6].set(ax12a.ID, 99)
    code = {"stands": "NOT_SHOWN", "powered": "TORQUE_ON", "mute": "SERVO_SILENT"}[trouble]
    with pytest.raises(RequestRefused) as refused:
        bench.measured()
    assert refused.value.code == code


def test_an_arm_without_pairs_has_nothing_to_measure() -> None:
    bench = LedBench(0)
    with pytest.raises(ConfigError, match="no joint of this arm has two servos; see `armctl help new-arm`"):
        measured(load_arm("ax12-line"), bench.opened, bench)
    fingers = load_arm("crustcrawler")
    joints = tuple(joint.model_copy(update={"pair": None}) for joint in fingers.joints[:-1])
    alone = fingers.model_copy(update={"joints": (*joints, fingers.joints[-1])})
    with pytest.raises(ConfigError, match="no joint"):
        measured(alone, bench.opened, bench)


def test_another_zero_leaves_how_a_pair_reads_as_it_was() -> None:
    for pair in ({"zero_tick": 810.0}, {"table": [[170, 866], [760, 270]]}, None):
        before = paired_arm(pair)
        zeros = [joint.zero_tick + 7.5 for joint in before.joints]
        after = recalibrated(before, zeros, {})
        links = [arm.servos[arm.pairs[0][1]].linkage for arm in (before, after)]
        assert links[0] is not None
        assert links[1] is not None
        for tick in (200.0, 500.0):
            assert links[1].second(tick) == pytest.approx(links[0].second(tick))


def test_both_servos_of_a_joint_are_seen_to_by_the_doctor_and_mended() -> None:
    from armctl.commissioning.eeprom import mend

    bench = Bench(simulated=ARM, spec=replace(ALIKE))
    bus = ServoBus(bench.port, ARM.servo_ids)
    bench.bus.close()
    bus.open()
    bench.servos[6].set(ax12a.CW_LIMIT, 0)
    bench.servos[6].set(ax12a.CCW_LIMIT, 1023)
    changed = mend(bus, ARM.servos)
    low, high = ARM.servos[6].limits_tick
    assert [(it.servo_id, it.register, it.wanted) for it in changed] == [
        (12, "cw_angle_limit", low), (12, "ccw_angle_limit", high),
    ]  # fmt: skip
