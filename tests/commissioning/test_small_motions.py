"""One servo wiggles, on a simulated arm; and the words for what is seen are those of the true tool."""

import numpy as np
import pytest

from armctl.clock import NS_PER_S
from armctl.commissioning.small_motions import ROOM_TICK, TORQUES, WIGGLE_TICK, Wall, first_motion, sense, wiggle
from armctl.dynamixel import ax12a
from armctl.errors import PortGone
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import forward_kinematics
from armctl.sim.faults import Fault
from tests.commissioning.bench import EXACT, Bench, unwritten
from tests.host.doubles import refused

WALL = Wall(1, "base", "ax-12a", (20, 1000))


@pytest.fixture
def bench() -> Bench:
    bench = Bench(spec=EXACT)
    bench.arm.set_all(ax12a.CW_LIMIT, 0)  # as from the factory
    return bench


def limp(bench: Bench) -> bool:
    return not any(servo.torque_enabled for servo in bench.servos)


def test_a_servo_turns_up_and_back_weakly_within_its_walls_and_is_limp_again(bench: Bench) -> None:
    seen: list[tuple[int, int, int]] = []
    read, base = bench.bus.read_block, bench.servos[0]

    def look(*request: int, **tries: int) -> object:
        if base.torque_enabled:
            registers = (ax12a.TORQUE_LIMIT, ax12a.CW_LIMIT, ax12a.PRESENT_POSITION)
            seen.append((base.get(registers[0]), base.get(registers[1]), base.get(registers[2])))
        return read(*request, **tries)

    bench.bus.read_block = look  # type: ignore[method-assign, assignment]
    before = base.position_tick
    wiggle(bench.bus, WALL)
    assert {limit for limit, _, _ in seen} == {TORQUES[0]}
    assert {low for _, low, _ in seen} == {WALL.limits_tick[0]}
    assert max(tick for _, _, tick in seen) == pytest.approx(before + WIGGLE_TICK, abs=4)
    assert base.position_tick == pytest.approx(before, abs=6)
    assert limp(bench)
    assert base.get(ax12a.TORQUE_LIMIT) == ax12a.MAX_TORQUE.default


@pytest.mark.parametrize("limits_tick", [(0, 512 + WIGGLE_TICK + ROOM_TICK - 3), (512 - ROOM_TICK + 3, 1023)])
def test_near_an_end_it_stays_limp_and_unwritten(bench: Bench, limits_tick: tuple[int, int]) -> None:
    with unwritten(bench), refused("NO_ROOM", r"servo 1 \(base\) stands at tick 51"):
        wiggle(bench.bus, WALL._replace(limits_tick=limits_tick))


def test_one_that_is_held_gets_half_its_torque_at_most_and_is_limp_again(bench: Bench) -> None:
    bench.arm.faults.begin(Fault(kind="blocked_joint", servo_id=1), bench.arm.time_s)
    with refused("NOT_TURNED", "turned by"):
        wiggle(bench.bus, WALL)
    assert limp(bench)


def test_a_port_that_vanishes_in_a_wiggle_is_told(bench: Bench) -> None:
    read, left = bench.bus.read_block, iter(range(20))

    def pulled(*request: int, **tries: int) -> object:
        if next(left, None) is None:
            bench.port.unplug()
        return read(*request, **tries)

    bench.bus.read_block = pulled  # type: ignore[method-assign, assignment]
    with pytest.raises(PortGone):
        wiggle(bench.bus, WALL)


@pytest.mark.parametrize(
    "name", ["ax12-line", "phantomx-pincher", "phantomx-reactor", "crane-plus-v2", "lanzhou-4dof", "xiang-6dof"]
)
def test_the_words_for_a_joint_say_what_the_tool_does_where_it_turns(name: str) -> None:
    arm = load_arm(name)
    chain = robots.of(arm).chain
    q = np.array([sum(joint.limits_rad) / 2.0 for joint in arm.joints[: chain.n]])
    axes = {"forward": 0, "backward": 0, "left": 1, "right": 1, "up": 2, "down": 2, "front": 0, "above": 2}
    for index in range(chain.n):
        *_, word = (text := sense(robots.of(arm), q, index)).split()
        T, moved = forward_kinematics(chain, q), forward_kinematics(chain, q + 0.01 * np.eye(chain.n)[index])
        sign = -1.0 if word in ("backward", "right", "down") and text.startswith("go") else 1.0
        if text.startswith("go"):
            assert sign * (moved - T)[axes[word], 3] > 2e-4, f"{arm.joints[index].name}: {text}"
        else:
            turn = moved[:3, :3] @ T[:3, :3].T
            about = (turn[2, 1], turn[0, 2], turn[1, 0])[axes[word]]
            assert about * (1.0 if "counter" in text else -1.0) > 5e-3, f"{arm.joints[index].name}: {text}"
    assert "tip" in sense(robots.of(load_arm("ax12-line")), np.zeros(5), 5)


def test_the_first_motion_ends_limp_at_rest_and_a_fault_ends_it_at_once(bench: Bench) -> None:
    bench = Bench(spec=EXACT)
    rest = bench.arm.true_positions()
    first_motion(bench.bus, bench.config, 0.1)
    assert limp(bench)
    assert np.degrees(np.abs(bench.arm.true_positions() - rest)).max() < 3.0
    other = Bench(spec=EXACT)
    other.arm.faults.begin(Fault(kind="mute", servo_id=3, begin_s=3.0), other.arm.time_s)
    with refused("SERVO_SILENT", "no reply"):
        first_motion(other.bus, other.config, 0.1)
    other.arm.faults.end(1)
    other.clock.advance_ns(NS_PER_S)
    assert not limp(other), "it holds where it is"
    first_motion(other.bus, other.config, 0.1)  # goes on from there
    assert limp(other)
