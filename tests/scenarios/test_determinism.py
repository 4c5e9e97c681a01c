"""Two simulators in lockstep with two bus masters: the same seed and the same requests give the same readings.

The masters are real programs on a real machine: a request may have to be repeated, which changes nothing, or a
reading may be missed altogether. What both masters read is the same, tick by tick. Their servos are identified at one
go: a slow machine would spread that over two ticks, which are other requests.
"""

from contextlib import ExitStack

import pytest

from armctl.clock import NS_PER_S, MonotonicClock
from armctl.control import loop
from armctl.control.loop import ControlLoop
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import ServoBus
from armctl.dynamixel.serial_port import SerialPort
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.messages import Mode, Sample, Teach
from tests.scenarios.bench import LINE_M, Simulator, simulator

pytestmark = pytest.mark.pty

ARM = load_arm("ax12-line")
TICKS = 30
GUIDE_TICK = 6


class Master:
    """A control loop of its own on a simulator of its own."""

    def __init__(self, world: Simulator) -> None:
        clock, self.world = MonotonicClock(), world
        self.bus = ServoBus(SerialPort(str(world.port), 1_000_000, clock), ARM.servo_ids)
        self.loop = ControlLoop(self.bus, clock, ARM, robots.get(ARM.robot), 0.1)
        self.bus.open()
        self.samples: list[Sample] = []

    def tick(self, number: int) -> None:
        if number == GUIDE_TICK:
            assert self.loop.state.mode is Mode.TEACHING
            self.world.client.guide(*LINE_M, seed=5)
        self.samples.append(self.loop.tick((Teach(1),) if number == 3 else ()).inputs.sample)


def test_same_seed_and_same_requests_give_identical_readings(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(loop, "IDENTIFY_NS", 60 * NS_PER_S)
    with ExitStack() as cleanup:
        masters = [Master(cleanup.enter_context(simulator("--lockstep", "--seed", "7"))) for _ in range(2)]
        for number in range(TICKS):
            for master in masters:
                master.tick(number)
        for master in masters:
            master.bus.close()

    shoulder, compared = [], 0
    for samples in zip(*(master.samples for master in masters), strict=True):
        for first, second in zip(*(sample.servos for sample in samples), strict=True):
            if first.fresh and second.fresh:
                assert first.registers == second.registers
                compared += 1
        shoulder.append(ax12a.register_value(ax12a.PRESENT_POSITION, samples[0].servos[1].registers))
    assert compared > TICKS * len(ARM.joints) * 0.9
    assert max(shoulder) - min(shoulder) > 30, "the hand did not move the arm while readings were compared"
