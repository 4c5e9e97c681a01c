"""Timing and parsing of the simulated bus, byte by byte on virtual time."""

import itertools

import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BadChecksum, Decoder, Instruction, Packet, encode_instruction
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from tests.sim.conftest import read

BEGIN_NS = 10**9
FAR_NS = 10**13
PING = encode_instruction(1, Instruction.PING)
READ_STATUS = read(2, ax12a.TORQUE_ENABLE, ax12a.STATUS_SIZE)


@pytest.fixture
def bus(arm: ArmConfig) -> SimulatedBus:
    return SimulatedBus(SimulatedArm(arm))


def arrivals(bus: SimulatedBus) -> list[tuple[int, int]]:
    """Every byte under way: when it arrives and what it is."""
    found = []
    while (at := bus.arrival_ns()) is not None:
        assert bus.transmit(at - 1) == b""
        found += [(at, byte) for byte in bus.transmit(at)]
    return found


def replies(bus: SimulatedBus) -> list[Packet | BadChecksum]:
    return Decoder().feed(bus.transmit(FAR_NS))


@pytest.mark.parametrize(("baud", "byte_ns"), [(1_000_000, 10_000), (57_600, 173_611)])
@pytest.mark.parametrize("delay", [0, 250])
def test_reply_comes_after_wire_time_and_return_delay(arm: ArmConfig, baud: int, byte_ns: int, delay: int) -> None:
    simulated = SimulatedArm(arm)
    for servo in simulated.servos:
        servo.set(ax12a.BAUD, round(2e6 / baud) - 1)
        servo.set(ax12a.RETURN_DELAY, delay)
    bus = SimulatedBus(simulated, baud=baud)
    bus.receive(READ_STATUS, BEGIN_NS)
    times = [at for at, _ in arrivals(bus)]
    first = BEGIN_NS + len(READ_STATUS) * byte_ns + delay * 2000 + byte_ns
    assert times == [first + i * byte_ns for i in range(6 + ax12a.STATUS_SIZE)]


def test_replies_never_overlap_on_the_wire(bus: SimulatedBus) -> None:
    for servo in bus.arm.servos:
        servo.set(ax12a.RETURN_DELAY, 0)
    bus.receive(READ_STATUS + PING + READ_STATUS, BEGIN_NS)
    times = [at for at, _ in arrivals(bus)]
    assert all(b - a >= 10_000 for a, b in itertools.pairwise(times))
    assert len(times) == 2 * 32 + 6


@pytest.mark.parametrize(("gap_ns", "answered"), [(99_000_000, True), (101_000_000, False)])
def test_gap_of_100_ms_between_bytes_resets_the_parser(bus: SimulatedBus, gap_ns: int, answered: bool) -> None:
    bus.receive(PING[:3], BEGIN_NS)
    bus.receive(PING[3:], BEGIN_NS + gap_ns)
    assert bool(replies(bus)) == answered
    bus.receive(PING, BEGIN_NS + 3 * gap_ns)
    assert replies(bus) == [Packet(1, 0)]


def test_adapter_latency_delivers_in_batches(arm: ArmConfig) -> None:
    bus = SimulatedBus(SimulatedArm(arm), latency_ms=16.0, seed=1)
    now_ns = BEGIN_NS
    for _ in range(6):
        bus.receive(READ_STATUS, now_ns)
        times = {at for at, _ in arrivals(bus)}
        assert len(times) == 1
        now_ns = times.pop()
    assert 80_000_000 < now_ns - BEGIN_NS <= 96_000_000


def told(bus: SimulatedBus, servo_id: int, instruction: Instruction, parameters: bytes = b"") -> int | None:
    """The error byte of the reply to one more packet; None: nobody answers."""
    bus.receive(encode_instruction(servo_id, instruction, parameters), BEGIN_NS)
    answers = replies(bus)
    assert len(answers) < 2
    return answers[0].code if answers and isinstance(answers[0], Packet) else None


def test_who_hears_the_host_changes_with_a_wizards_hand_and_with_a_reset_of_all(bus: SimulatedBus) -> None:
    bus.baud = 57_600
    assert told(bus, 2, Instruction.PING) is None
    for servo in bus.arm.servos:
        servo.set(ax12a.BAUD, 34)
    assert told(bus, 2, Instruction.PING) == 0
    assert told(bus, 0xFE, Instruction.RESET) is None
    assert {servo.servo_id for servo in bus.arm.servos} == {1}
    assert told(bus, 1, Instruction.PING) is None
    bus.baud = 1_000_000
    bus.arm.servos[3].set(ax12a.ID, 200)
    assert told(bus, 200, Instruction.PING) == 0
