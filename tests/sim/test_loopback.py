"""The stock SDK and ServoBus against the simulated bus, in virtual time."""

import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Register
from armctl.dynamixel.identify import Identification
from armctl.messages import Sample
from armctl.sim.faults import Fault
from tests.commissioning.bench import Bench

TICK_NS = 100_000_000


@pytest.fixture
def bench() -> Bench:
    return Bench()


def tick(bench: Bench) -> Sample:
    bench.clock.advance_ns(TICK_NS)
    return bench.bus.read_sample()


def test_sample_takes_exactly_its_wire_time(bench: Bench) -> None:
    sample = tick(bench)
    assert all(reading.fresh for reading in sample.servos)
    assert sample.retries == 0
    assert sample.bus_us == 6 * (80 + 500 + 320)
    assert not bench.port.is_using


def test_position_read_is_where_the_arm_is(bench: Bench) -> None:
    for joint, reading, true_rad in zip(
        bench.config.joints, tick(bench).servos, bench.arm.true_positions(), strict=True
    ):
        read = ax12a.register_value(ax12a.PRESENT_POSITION, reading.registers)
        assert joint.position_rad(read) == pytest.approx(true_rad, abs=4 * ax12a.TICK_RAD)


def found(bench: Bench) -> list[tuple[str, int | None]]:
    problems = Identification(bench.bus, bench.config.joints, "").advance() or ()
    return [(problem.code, problem.servo_id) for problem in problems]


@pytest.mark.parametrize(
    ("settings", "problems"),
    [
        ([(4, ax12a.ID, 3)], [("DUPLICATE_ID", 3), ("SERVO_SILENT", 4)]),
        ([(2, ax12a.CW_LIMIT, 0), (2, ax12a.CCW_LIMIT, 0)], [("EEPROM_MISMATCH", 2)]),
        ([(6, ax12a.BAUD, 34)], [("SERVO_SILENT", 6)]),
        ([(servo_id, ax12a.BAUD, 34) for servo_id in range(1, 7)], [("BUS_DEAD", None)]),
    ],
    ids=["two with one id", "wheel mode", "other baud", "all at another baud"],
)
def test_servos_that_are_set_wrong_are_told(
    bench: Bench, settings: list[tuple[int, Register, int]], problems: list[tuple[str, int | None]]
) -> None:
    for servo_id, register, value in settings:
        bench.servos[servo_id - 1].set(register, value)
    assert found(bench) == problems


@pytest.mark.parametrize(("latency_ms", "problems"), [(16.0, [("SLOW_ADAPTER", None)]), (1.0, []), (0.0, [])])
@pytest.mark.parametrize("seed", range(4))
def test_adapter_with_16_ms_timer_is_slow_but_not_silent_and_a_faster_one_is_fit(
    seed: int, latency_ms: float, problems: list[tuple[str, int | None]]
) -> None:
    bench = Bench(seed=seed, latency_ms=latency_ms)
    assert found(bench) == problems
    for sample in [tick(bench) for _ in range(5)]:
        assert all(reading.fresh for reading in sample.servos)
        assert problems or sample.retries == 0


def test_port_that_was_out_between_two_uses_is_gone_though_the_adapter_is_back(bench: Bench) -> None:
    tick(bench)
    bench.port.unplug()
    bench.port.replug()
    assert not tick(bench).port_open
    bench.bus.open()
    assert tick(bench).port_open


def test_fault_that_ended_before_the_next_use_has_taken_the_port_with_it(bench: Bench) -> None:
    tick(bench)
    for _ in range(2):
        bench.arm.faults.begin(Fault(kind="unplug", begin_s=0.02, duration_s=0.05), bench.arm.time_s)
        assert not tick(bench).port_open
        bench.bus.open()
        assert tick(bench).port_open


def test_reading_returns_early_bytes_exactly_at_the_deadline(bench: Bench) -> None:
    bench.port.writePort([0xFF, 0xFF, 1, 2, 1, 0xFB])
    bench.port.setPacketTimeoutMillis(0.06 + 0.5 + 0.025)
    deadline_ns = bench.clock.now_ns() + 585_000
    assert bench.port.readPort(6) == b"\xff\xff"
    assert bench.clock.now_ns() == deadline_ns
