"""The stock SDK and ServoBus against the simulated bus, in virtual time."""

import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.messages import Goal, Sample
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault
from armctl.sim.loopback import LoopbackPort
from armctl.sim.virtual_arm import VirtualArm

TICK_NS = 100_000_000


class Bench:
    """One simulated arm, its bus, the port and the ServoBus over it."""

    def __init__(self, *, seed: int = 0, latency_ms: float = 0.0, baud: int = 1_000_000) -> None:
        self.config: ArmConfig = load_arm("ax12-line")
        self.arm = SimulatedArm(self.config, seed=seed)
        wire = SimulatedBus(self.arm, latency_ms=latency_ms, seed=seed)
        virtual = VirtualArm(self.arm, wire=wire, make_port=lambda wire, clock: LoopbackPort(wire, clock, baud))
        self.clock, self.port, self.bus = virtual.clock, virtual.port, virtual.bus
        self.bus.open()

    def tick(self) -> Sample:
        self.clock.advance_ns(TICK_NS)
        return self.bus.read_sample()


@pytest.fixture
def bench() -> Bench:
    return Bench()


def test_sample_takes_exactly_its_wire_time(bench: Bench) -> None:
    sample = bench.tick()
    assert all(reading.fresh for reading in sample.servos)
    assert sample.retries == 0
    assert sample.bus_us == 6 * (80 + 500 + 320)
    assert not bench.port.is_using


def test_position_read_is_where_the_arm_is(bench: Bench) -> None:
    for joint, reading, true_rad in zip(
        bench.config.joints, bench.tick().servos, bench.arm.true_positions(), strict=True
    ):
        tick = ax12a.register_value(ax12a.PRESENT_POSITION, reading.registers)
        assert joint.position_rad(tick) == pytest.approx(true_rad, abs=4 * ax12a.TICK_RAD)


def test_goal_moves_the_arm_and_reads_back(bench: Bench) -> None:
    at = [ax12a.register_value(ax12a.PRESENT_POSITION, reading.registers) for reading in bench.tick().servos]
    at[0] += 60
    for _ in range(15):
        assert bench.bus.write_goal(Goal(tuple(at), (100,) * 6))
        sample = bench.tick()
    base = sample.servos[0].registers
    assert ax12a.register_value(ax12a.GOAL, base) == at[0]
    assert ax12a.register_value(ax12a.PRESENT_POSITION, base) == pytest.approx(at[0], abs=8)
    assert bench.bus.read(1, ax12a.MOVING_SPEED) == 100


def test_same_seed_same_calls_same_samples() -> None:
    def run() -> list[Sample]:
        bench = Bench(seed=7, latency_ms=1.0)
        samples = [bench.tick()]
        bench.bus.write_goal(Goal((520, 640, 60, 700, 500, 512), (40,) * 6))
        bench.arm.servos[3].set(ax12a.ID, 99)
        return samples + [bench.tick() for _ in range(10)]

    assert run() == run()


def found(bench: Bench) -> list[tuple[str, int | None]]:
    return [(problem.code, problem.servo_id) for problem in bench.bus.identify(bench.config.joints)]


def test_two_servos_with_one_id_are_told(bench: Bench) -> None:
    bench.arm.servos[3].set(ax12a.ID, 3)
    assert found(bench) == [("DUPLICATE_ID", 3), ("SERVO_SILENT", 4)]


def test_wheel_mode_and_other_baud_are_told(bench: Bench) -> None:
    bench.arm.servos[1].set(ax12a.CW_LIMIT, 0)
    bench.arm.servos[1].set(ax12a.CCW_LIMIT, 0)
    bench.arm.servos[5].set(ax12a.BAUD, 34)
    assert found(bench) == [("EEPROM_MISMATCH", 2), ("SERVO_SILENT", 6)]


def test_host_at_another_baud_finds_a_dead_bus() -> None:
    assert found(Bench(baud=57_600)) == [("BUS_DEAD", None)]


@pytest.mark.parametrize(("latency_ms", "problems"), [(16.0, [("SLOW_ADAPTER", None)]), (1.0, []), (0.0, [])])
@pytest.mark.parametrize("seed", range(4))
def test_adapter_with_16_ms_timer_is_slow_but_not_silent_and_a_faster_one_is_fit(
    seed: int, latency_ms: float, problems: list[tuple[str, int | None]]
) -> None:
    bench = Bench(seed=seed, latency_ms=latency_ms)
    assert found(bench) == problems
    for sample in [bench.tick() for _ in range(5)]:
        assert all(reading.fresh for reading in sample.servos)
        assert problems or sample.retries == 0


def test_port_that_was_out_between_two_uses_is_gone_though_the_adapter_is_back(bench: Bench) -> None:
    bench.tick()
    bench.port.unplug()
    bench.port.replug()
    assert not bench.tick().port_open
    bench.bus.open()
    assert bench.tick().port_open


def test_fault_that_ended_before_the_next_use_has_taken_the_port_with_it(bench: Bench) -> None:
    bench.tick()
    for _ in range(2):
        bench.arm.faults.begin(Fault(kind="unplug", begin_s=0.02, duration_s=0.05), bench.arm.time_s)
        assert not bench.tick().port_open
        bench.bus.open()
        assert bench.tick().port_open


def test_reading_returns_early_bytes_at_the_deadline_and_clearing_drops_them(bench: Bench) -> None:
    bench.port.writePort([0xFF, 0xFF, 1, 2, 1, 0xFB])
    bench.port.setPacketTimeoutMillis(0.06 + 0.5 + 0.025)
    deadline_ns = bench.clock.now_ns() + 585_000
    assert bench.port.readPort(6) == b"\xff\xff"
    assert bench.clock.now_ns() == deadline_ns
    bench.clock.advance_ns(1_000_000)
    assert bench.port.getBytesAvailable() == 4
    bench.port.clearPort()
    assert bench.port.getBytesAvailable() == 0
    assert bench.port.readPort(1) == b""
