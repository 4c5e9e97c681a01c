"""Faults: their file, their calendar, and what each does to bytes and joints, on virtual time."""

import math
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

import armctl
from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit
from armctl.dynamixel.packet import BadChecksum, Decoder, Instruction, Packet, encode_instruction, encode_status
from armctl.errors import ConfigError, PortGone, PortMissing
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import _KINDS, DESCRIPTIONS, KINDS, Fault, Faults, parse
from armctl.sim.loopback import LoopbackPort
from tests.sim.conftest import WORKING_RAD, Bench, read, refusals, turned, write

REPLY = ("lost", "late", "duplicated", "corrupted", "truncated", "wrong_id")


# ------------------------------------------------------------------------------------------------- the file


def test_script_is_a_list_of_faults() -> None:
    text = "faults:\n  - {kind: lost, servo_id: 3, probability: 0.2, begin_s: 5, duration_s: 10}\n  - {kind: unplug}\n"
    lost, unplug = parse(text, "f.yaml", (1, 2, 3))
    assert lost == Fault(kind="lost", servo_id=3, probability=0.2, begin_s=5.0, duration_s=10.0)
    assert unplug == Fault(kind="unplug")
    assert set(DESCRIPTIONS) == set(KINDS)


@pytest.mark.parametrize(("entry", "why"), refusals("faults"))
def test_wrong_script_is_refused_with_file_and_key(entry: str, why: str) -> None:
    with pytest.raises(ConfigError, match=why):
        parse(f"faults:\n  - {entry}\n", "f.yaml", (1, 2, 3))


def test_docs_page_describes_every_kind_with_its_default() -> None:
    page = (Path(armctl.__file__).parent / "docs" / "simulator.md").read_text(encoding="utf-8")
    rows = [line.strip("| ").split(" | ") for line in page.splitlines() if line.startswith("| `")]
    described = {row[0].strip("`"): row[-1].strip(" |") for row in rows}
    for kind in KINDS:
        assert kind in described
        value = _KINDS[kind].value
        if value is not None and value.default is not None:
            assert described[kind].endswith(f", {value.default:g}"), kind


# --------------------------------------------------------------------------------------------- the calendar


def test_fault_is_in_force_from_its_begin_for_its_duration(arm: ArmConfig) -> None:
    bench = Bench(arm, Fault(kind="mute", servo_id=2, begin_s=1.0, duration_s=0.5))
    assert [bool(bench.hear(read(2))) for _ in range(40)] == [True] * 20 + [False] * 10 + [True] * 10
    assert (bench.arm.faults.planned, bench.arm.faults.due_s) == ([], math.inf)


@given(st.lists(st.tuples(st.floats(0.0, 3.0), st.floats(0.01, 3.0)), max_size=6), st.floats(0.0, 6.0))
def test_active_faults_are_those_whose_time_it_is(times: list[tuple[float, float]], now_s: float) -> None:
    faults = Faults([Fault(kind="mute", begin_s=begin_s, duration_s=span_s) for begin_s, span_s in times])
    expected = [i for i, (begin_s, span_s) in enumerate(times, start=1) if begin_s <= now_s < begin_s + span_s]
    faults.advance(now_s)
    assert [entry["id"] for entry in faults.listing() if entry["active"]] == expected
    assert (faults.in_force("mute") is not None) == bool(expected)
    assert faults.due_s > now_s


def test_live_fault_ends_when_ended_and_ending_twice_is_no_error(bench: Bench) -> None:
    number = bench.begin("mute", 2)
    assert bench.hear(read(2)) == b""
    bench.arm.faults.end(number)
    bench.end(number)
    assert bench.hear(read(2))
    bench.arm.faults.end(number)
    with pytest.raises(ValueError, match=r"fault 7: there never was one"):
        bench.arm.faults.end(7)


def test_count_and_probability_bound_the_strikes(arm: ArmConfig) -> None:
    bench = Bench(arm, Fault(kind="lost", servo_id=1, count=3), Fault(kind="lost", servo_id=2, probability=0.3))
    assert [bool(bench.hear(read(1))) for _ in range(6)] == [False] * 3 + [True] * 3
    lost = sum(not bench.hear(read(2)) for _ in range(300))
    assert 60 < lost < 120
    assert [entry["struck"] for entry in bench.arm.faults.listing()] == [3, lost]


def test_same_seed_same_bytes_and_other_seed_other_bytes(arm: ArmConfig) -> None:
    script = [Fault(kind=kind, probability=0.3) for kind in (*REPLY, "garbage")]
    script += [Fault(kind="second_writer", servo_id=1, begin_s=0.5, value=20), Fault(kind="brown_out", begin_s=1.0)]
    wires = []
    for seed in (1, 1, 2):
        bench = Bench(arm, *script, seed=seed)
        wires.append([bench.ask(read(1 + k % 6)) for k in range(60)])
    assert wires[0] == wires[1]
    assert wires[0] != wires[2]


def test_one_fault_does_not_change_the_draws_of_another(arm: ArmConfig) -> None:
    first = Fault(kind="lost", servo_id=1, probability=0.5)
    alone, together = Bench(arm, first), Bench(arm, first, Fault(kind="corrupted", servo_id=2, probability=0.5))
    for _ in range(50):
        assert bool(alone.hear(read(1))) == bool(together.hear(read(1)))
        together.hear(read(2))


# --------------------------------------------------------------------------------------------------- bytes


def test_planned_but_not_begun_faults_change_no_byte(arm: ArmConfig) -> None:
    plain, waiting = (Bench(arm), Bench(arm, *(Fault(kind=kind, servo_id=1, begin_s=1e6) for kind in (*REPLY, "mute"))))
    assert [plain.ask(read(i)) for i in range(1, 7)] == [waiting.ask(read(i)) for i in range(1, 7)]


@pytest.mark.parametrize(("kind", "servo_id", "acted"), [("lost", 2, 1), ("mute", 2, 0), ("dead_bus", None, 0)])
def test_lost_reply_was_still_acted_on_but_mute_servo_and_dead_bus_hear_nothing(
    bench: Bench, kind: str, servo_id: int | None, acted: int
) -> None:
    bench.begin(kind, servo_id)
    assert bench.hear(write(2, ax12a.LED, 1)) == b""
    assert bench.arm.servos[1].get(ax12a.LED) == acted
    assert bool(bench.hear(read(3))) is (servo_id is not None)


def test_late_reply_holds_up_what_follows_it(bench: Bench) -> None:
    on_time = bench.ask(read(2))
    bench.arm.faults.begin(Fault(kind="late", servo_id=2, count=1, value=12.0), bench.arm.time_s)
    bench.wait(0.001)
    bench.bus.receive(read(2), bench.now_ns)
    heard = bench.ask(read(3))
    assert [packet.servo_id for packet in Decoder().feed(bytes(value for _, value in heard))] == [2, 3]
    assert [at for at, _ in heard[:8]] == [at + 12_000_000 for at, _ in on_time]
    assert heard[8][0] >= heard[7][0]


# The reply of servo 2 that names its model.
GOOD = b"\xff\xff\x02\x04\x00\x0c\x00\xed"


@pytest.mark.parametrize(
    ("kind", "value", "reply"),
    [
        ("duplicated", None, GOOD + GOOD),
        ("truncated", 1, GOOD[:1]),
        ("truncated", 5, GOOD[:5]),
        ("wrong_id", None, encode_status(3, 0, b"\x0c\x00")),
        ("wrong_id", 5, encode_status(5, 0, b"\x0c\x00")),
        ("lost", None, b""),
        ("mute", None, b""),
    ],
)
def test_what_a_fault_makes_of_a_reply(bench: Bench, kind: str, value: float | None, reply: bytes) -> None:
    assert bench.hear(read(2, ax12a.MODEL)) == GOOD
    bench.begin(kind, 2, value)
    assert bench.hear(read(2, ax12a.MODEL)) == reply
    assert len(bench.hear(read(3))) == 8


def test_corrupted_reply_never_passes(bench: Bench) -> None:
    bench.begin("corrupted", 2)
    for _ in range(200):
        bad = bench.hear(read(2, ax12a.MODEL))
        assert sum(a != b for a, b in zip(GOOD, bad, strict=True)) == 1
        assert not any(isinstance(packet, Packet) for packet in Decoder().feed(bad))


def test_truncated_reply_is_cut_anywhere_if_no_length_is_named(bench: Bench) -> None:
    bench.begin("truncated", 2)
    assert {bench.hear(read(2, ax12a.MODEL)) for _ in range(30)} == {GOOD[:size] for size in range(1, len(GOOD))}


def test_garbage_comes_before_the_reply(bench: Bench) -> None:
    bench.begin("garbage", 2, 5)
    heard = bench.hear(read(2, ax12a.MODEL))
    assert (len(heard), heard[5:]) == (5 + 8, GOOD)
    assert len(bench.hear(read(3))) == 8


def test_echo_gives_the_host_its_own_bytes_first(bench: Bench) -> None:
    bench.begin("echo")
    request = read(2, ax12a.MODEL)
    heard = bench.ask(request)
    assert bytes(value for _, value in heard) == request + GOOD
    assert [at for at, _ in heard[:3]] == [10_000, 20_000, 30_000]
    assert bench.hear(encode_instruction(99, Instruction.PING)) == encode_instruction(99, Instruction.PING)


def test_second_servo_with_the_same_id_garbles_what_differs(bench: Bench) -> None:
    number = bench.begin("same_id", 2)
    for request, heard in ((read(2, ax12a.MODEL, 24), Packet), (read(2, ax12a.TORQUE_ENABLE, 26), BadChecksum)):
        assert [type(packet) for packet in bench.packets(request)] == [heard]
    assert len(bench.hear(read(3))) == 8
    bench.end(number)
    assert [type(packet) for packet in bench.packets(read(2))] == [Packet]


def test_latency_changes_and_changes_back(bench: Bench) -> None:
    before = [at for at, _ in bench.ask(read(2))]
    number = bench.begin("latency", value=16.0)
    assert len({at for at, _ in bench.ask(read(2))}) == 1
    bench.end(number)
    assert [at for at, _ in bench.ask(read(2))] == before


def test_unplugged_port_vanishes_and_comes_back(arm: ArmConfig) -> None:
    clock = VirtualClock()
    faults = Faults([Fault(kind="unplug", duration_s=1.0), Fault(kind="unplug", begin_s=2.0, duration_s=2.0)])
    port = LoopbackPort(SimulatedBus(SimulatedArm(arm, faults=faults)), clock)
    with pytest.raises(PortMissing, match="unplugged"):
        port.openPort()
    clock.advance_ns(NS_PER_S)
    assert port.openPort()
    clock.advance_ns(1_500_000_000)
    with pytest.raises(PortGone):
        port.getBytesAvailable()
    with pytest.raises(PortMissing, match="unplugged"):
        port.openPort()
    clock.advance_ns(1_500_000_000)
    assert port.openPort()


# --------------------------------------------------------------------------------------------------- joints


def test_brown_out_restarts_servos_and_sags_the_supply(held: Bench) -> None:
    number = held.begin("brown_out", 2)
    shoulder, others = held.arm.servos[1], [s for i, s in enumerate(held.arm.servos) if i != 1]
    assert (shoulder.torque_enabled, shoulder.get(ax12a.MOVING_SPEED)) == (False, 0)
    assert all(servo.torque_enabled for servo in others)
    assert held.hear(read(2)) == b""  # its firmware starts
    assert held.error(1) == ErrorBit.VOLTAGE
    held.wait(0.4)
    assert held.hear(read(2))
    held.arm.faults.end(number)
    held.wait(0.01)
    assert shoulder.voltage_V > 11.5
    assert not shoulder.torque_enabled


@pytest.mark.parametrize(
    ("limits", "restarted", "least_V"), [({"count": 2}, 2, 5.0), ({"probability": 0.0, "value": 8.5}, 0, 8.0)]
)
def test_brown_out_restarts_as_many_as_it_says_and_sags_for_all(
    arm: ArmConfig, limits: dict[str, float], restarted: int, least_V: float
) -> None:
    bench = Bench(arm, Fault.model_validate({"kind": "brown_out", "begin_s": 7.0, "duration_s": 5.0, **limits}))
    bench.hold()
    bench.wait(2.0)
    assert [servo.torque_enabled for servo in bench.arm.servos] == [False] * restarted + [True] * (6 - restarted)
    assert least_V < bench.arm.servos[0].voltage_V < least_V + 0.5


def test_trip_takes_torque_and_limit(held: Bench) -> None:
    held.begin("trip", 3)
    elbow = held.arm.servos[2]
    assert (elbow.torque_enabled, elbow.get(ax12a.TORQUE_LIMIT), elbow.led) == (False, 0, "blinking")
    assert held.arm.servos[1].torque_enabled


def test_hot_servo_says_so_and_shuts_down(held: Bench) -> None:
    held.begin("hot", 3, 80.0)
    held.wait(0.1)
    assert held.error(3) == ErrorBit.OVERHEAT
    assert not held.arm.servos[2].torque_enabled


def test_blocked_joint_stays_and_its_servo_strains(held: Bench) -> None:
    held.begin("blocked_joint", 1)
    before = held.arm.true_positions()[0]
    held.goto(turned(math.radians(40.0)), wait_s=3.0)
    assert held.arm.true_positions()[0] == pytest.approx(before, abs=1e-6)
    assert held.arm.servos[0].output == 1.0
    held.wait(4.0)
    assert (held.arm.servos[0].overloaded, held.arm.servos[0].torque_enabled) == (True, False)


def test_blocked_joint_let_go_moves_again(held: Bench) -> None:
    number = held.begin("blocked_joint", 1)
    held.goto(turned(math.radians(40.0)), wait_s=2.0)
    held.end(number)
    held.wait(2.0)
    assert held.arm.true_positions()[0] == pytest.approx(math.radians(40.0), abs=0.05)


def test_stuck_joints_motor_strains_in_vain(held: Bench) -> None:
    held.begin("stuck_joint", 2)
    height = held.arm.true_tool_position()[2]
    held.wait(1.0)
    assert held.arm.true_tool_position()[2] < height - 0.02
    assert held.arm.servos[1].output > 0.2


def test_frozen_sensor_reads_one_tick_while_the_joint_runs_away(held: Bench) -> None:
    number = held.begin("frozen_sensor", 1)
    frozen = {held.hear(read(1)) for _ in range(5)}
    held.goto(turned(math.radians(20.0)), wait_s=1.0)
    assert {held.hear(read(1))} == frozen
    assert held.arm.servos[0].get(ax12a.PRESENT_SPEED) == 0
    assert held.arm.true_positions()[0] > math.radians(40.0)
    held.end(number)
    assert held.arm.servos[0].get(ax12a.PRESENT_POSITION) == round(held.arm.servos[0].position_tick)


def test_second_writer_keeps_writing_its_own_goal(held: Bench) -> None:
    own = held.arm.servos[0].get(ax12a.GOAL)
    number = held.begin("second_writer", 1, 50)
    written = held.arm.servos[0].get(ax12a.GOAL)
    assert abs(written - own - 50) <= 3
    held.goto(WORKING_RAD, wait_s=0.01)
    assert held.arm.servos[0].get(ax12a.GOAL) == own
    held.wait(0.1)
    assert held.arm.servos[0].get(ax12a.GOAL) == written
    assert held.arm.servos[5].get(ax12a.GOAL) != written
    held.arm.faults.end(number)
    held.goto(WORKING_RAD, wait_s=0.5)
    assert held.arm.servos[0].get(ax12a.GOAL) == own


def test_second_writer_energises_a_limp_arm(bench: Bench) -> None:
    bench.begin("second_writer", 6, 10)
    assert [servo.torque_enabled for servo in bench.arm.servos] == [False] * 5 + [True]


def test_fault_is_frozen() -> None:
    with pytest.raises(ValidationError):
        Fault(kind="mute").servo_id = 3  # type: ignore[misc]
