"""Which servos answer, in virtual time."""

from collections.abc import Callable

import pytest

from armctl.commissioning.scan import USUAL_BAUDS, scan
from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import Reply
from armctl.errors import PortGone, PortMissing
from tests.commissioning.bench import Bench

ONE_MBPS = (1_000_000,)


@pytest.fixture
def bench() -> Bench:
    return Bench()


@pytest.mark.parametrize("latency_ms", [0.0, 1.0, 4.0, 16.0])
@pytest.mark.parametrize("seed", range(3))
def test_every_servo_is_found_behind_any_adapter_wherever_its_id_lies(latency_ms: float, seed: int) -> None:
    bench = Bench(seed=seed, latency_ms=latency_ms)
    bench.servos[4].set(ax12a.ID, 100)
    bench.servos[5].set(ax12a.ID, 253)
    begin_ns = bench.clock.now_ns()
    found = scan(bench.bus, ONE_MBPS)
    assert [servo.servo_id for servo in found] == [1, 2, 3, 4, 100, 253]
    assert {(servo.model, servo.firmware, servo.clash) for servo in found} == {(12, 24, False)}
    assert bench.elapsed_s(begin_ns) <= (6.5 if latency_ms > 4.0 else 1.3)


def test_a_ping_takes_its_wire_time_and_the_return_delay(bench: Bench) -> None:
    assert {servo.round_trip_us for servo in scan(bench.bus, ONE_MBPS)} == {120 + 500}


def test_servos_at_other_bauds_are_found_at_their_baud(bench: Bench) -> None:
    bench.servos[1].set(ax12a.BAUD, 34)
    bench.servos[2].set(ax12a.BAUD, 207)
    steps: list[tuple[int, int, int]] = []
    found = scan(bench.bus, USUAL_BAUDS, range(8), lambda *step: steps.append(step))
    assert {(servo.servo_id, servo.baud) for servo in found} == {
        (1, 1_000_000), (2, 57_600), (3, 9_600), (4, 1_000_000), (5, 1_000_000), (6, 1_000_000),
    }  # fmt: skip
    assert steps[-1] == (9_600, 8, 8)
    assert len(steps) == 8 * len(USUAL_BAUDS)


def test_a_servo_that_answers_a_ping_only_is_found_without_a_model(bench: Bench) -> None:
    bench.servos[2].set(ax12a.RETURN_LEVEL, 0)
    third = scan(bench.bus, ONE_MBPS, range(10))[2]
    assert (third.servo_id, third.model, third.firmware, third.clash) == (3, None, None, False)


@pytest.mark.parametrize("latency_ms", [0.0, 16.0])
@pytest.mark.parametrize(("collide", "model"), [(False, 12), (True, None)])
def test_servos_with_one_id_clash_even_if_replies_collide(latency_ms: float, collide: bool, model: int | None) -> None:
    bench = Bench(latency_ms=latency_ms)
    bench.servos[3].set(ax12a.ID, 3)
    bench.servos[3].overloaded = collide
    found = scan(bench.bus, ONE_MBPS, range(10))
    assert [(servo.servo_id, servo.model, servo.clash) for servo in found] == [
        (1, 12, False), (2, 12, False), (3, model, True), (5, 12, False), (6, 12, False),
    ]  # fmt: skip


def received_first(bench: Bench, monkeypatch: pytest.MonkeyPatch, noise: Callable[[bytes], bytes]) -> None:
    """Before each reply the port receives something else, which depends on the request."""
    send = bench.port._send

    def noisy(packet: bytes) -> int:
        bench.port._received += noise(packet)
        return send(packet)

    monkeypatch.setattr(bench.port, "_send", noisy)


def test_noise_now_and_then_is_no_servo_and_hides_none(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []

    def noise(packet: bytes) -> bytes:
        asked.append(packet[2])
        return b"\xff\xff\x00" if packet[2] in (0, 4, 7) and asked.count(packet[2]) <= 2 else b""

    received_first(bench, monkeypatch, noise)
    assert [servo.servo_id for servo in scan(bench.bus, ONE_MBPS, range(9))] == [1, 2, 3, 4, 5, 6]


def test_an_echo_is_no_servo(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    received_first(bench, monkeypatch, lambda packet: packet)
    assert scan(bench.bus, ONE_MBPS, range(7, 12)) == []


def test_a_vanished_port_is_raised(bench: Bench) -> None:
    bench.port.unplug()
    with pytest.raises(PortGone):
        scan(bench.bus, ONE_MBPS)


def test_a_port_that_vanishes_before_the_read_is_raised(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    read = bench.bus.read_block

    def unplug(servo_id: int, begin: int, size: int, tries: int = 2) -> Reply:
        bench.port.unplug()
        return read(servo_id, begin, size, tries)

    monkeypatch.setattr(bench.bus, "read_block", unplug)
    with pytest.raises(PortGone, match="during the scan"):
        scan(bench.bus, ONE_MBPS, (1,))


def test_bauds_the_adapter_cannot_do_are_skipped_unless_all_are(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    set_baud = bench.port.setBaudRate

    def picky(baud: int) -> bool:
        if baud != 1_000_000:
            raise PortMissing(f"cannot do {baud}")
        return set_baud(baud)

    monkeypatch.setattr(bench.port, "setBaudRate", picky)
    assert len(scan(bench.bus, (400_000, 1_000_000), range(8))) == 6
    with pytest.raises(PortMissing, match="cannot do 400000"):
        scan(bench.bus, (400_000, 57_600))
