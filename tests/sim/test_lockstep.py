"""Lockstep: the world is a function of the bytes, not of the wall clock."""

from itertools import pairwise

import pytest

from armctl.dynamixel.packet import Instruction, encode_instruction
from armctl.files import load_arm
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.control import TruthRing
from armctl.sim.pty import Lockstep
from tests.sim.conftest import read

ARM = load_arm("ax12-line")


class World:
    """A lockstep world, and a master that reads position registers."""

    def __init__(self) -> None:
        self.arm = SimulatedArm(ARM, seed=4)
        self.bus = SimulatedBus(self.arm)
        self.ring = TruthRing()
        self.lockstep = Lockstep(self.arm, self.bus, self.ring)

    def read(self, servo_id: int) -> bytes:
        return self.lockstep.pass_on(read(servo_id, size=3))

    def cycle(self, *, patience: int = 1) -> list[bytes]:
        """One reading of every servo; a hasty master asks each one several times."""
        return [[self.read(servo_id) for _ in range(patience)][-1] for servo_id in ARM.servo_ids]


def fall(world: World) -> None:
    """Something for the arm to do: an elbow goal, which energises the servo."""
    world.lockstep.pass_on(encode_instruction(3, Instruction.WRITE, bytes((30, 0x90, 0x00, 40, 0))))


def test_asking_again_changes_nothing() -> None:
    once, thrice = World(), World()
    for world in (once, thrice):
        fall(world)
    assert [once.cycle() for _ in range(20)] == [thrice.cycle(patience=3) for _ in range(20)]


def test_each_turn_back_is_one_period_of_motion() -> None:
    world = World()
    fall(world)
    world.cycle()
    begin_s = world.arm.time_s
    readings = {world.cycle()[2] for _ in range(10)}
    assert world.arm.time_s - begin_s == pytest.approx(1.0)
    assert len(readings) == 10


def test_a_reading_is_the_same_however_the_bytes_are_cut() -> None:
    whole, cut = World(), World()
    for _ in range(5):
        request = read(2, size=3)
        pieces = b"".join(cut.lockstep.pass_on(request[i : i + 1]) for i in range(len(request)))
        assert whole.lockstep.pass_on(request) == pieces
        assert whole.read(1) == cut.read(1)


def test_the_truth_is_stamped_with_the_masters_clock() -> None:
    world = World()
    for _ in range(5):
        world.cycle()
    times_ns = [time_ns for time_ns, _ in world.ring.between(0, 2**62)]
    assert len(times_ns) >= 40
    assert all(later_ns - earlier_ns > -100_000_000 for earlier_ns, later_ns in pairwise(times_ns))
