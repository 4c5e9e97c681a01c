"""Identifying servos goes on between the ticks: no tick is held up, whoever is silent, and the rest is served."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from armctl.dynamixel.bus import PORT_GONE
from armctl.messages import Clear, Connected, Hold, Mode, Release, TickRecord
from armctl.sim.faults import Fault
from tests.control.test_loop import Rig, holding

# What the brief wait for silent servos may add to a tick.
MORE_NS = 50_000_000
SUBSETS = st.sets(st.integers(1, 6), min_size=1)


def silence(rig: Rig, servo_ids: set[int], kind: str = "mute") -> None:
    for servo_id in servo_ids:
        rig.simulated.faults.begin(Fault(kind=kind, servo_id=servo_id), rig.simulated.time_s)


def heal(rig: Rig) -> None:
    for planned in rig.simulated.faults.planned:
        rig.simulated.faults.end(planned.id)


def latched(servo_ids: set[int], period_s: float = 0.1, kind: str = "mute") -> Rig:
    """An arm that has held, and whose servos have been silent for a second."""
    rig = Rig(period_s=period_s)
    rig.ticks(round(0.3 / period_s) + 2)
    silence(rig, servo_ids, kind)
    rig.ticks(round(1.0 / period_s) + 3)
    assert rig.mode() is Mode.FAULTED
    return rig


def longest_ns(rig: Rig, count: int, *commands: Clear | Hold) -> int:
    """Of so many ticks, from when each is due or begins until it is over."""
    found = []
    for tick in range(count):
        rig.clock.sleep_until_ns(rig.loop._due_ns())
        begin_ns = rig.clock.now_ns()
        rig.tick(*(() if tick else commands))
        found.append(rig.clock.now_ns() - begin_ns)
    return max(found)


def connected(record: TickRecord) -> bool:
    return any(isinstance(command, Connected) for command in record.inputs.commands)


@given(SUBSETS, st.sampled_from([0.01, 0.1, 0.3, 1.0]), st.sampled_from(["mute", "corrupted"]))
@settings(deadline=None, max_examples=12)
def test_no_tick_is_longer_than_its_period_and_50_ms_while_a_fault_is_cleared(
    servo_ids: set[int], period_s: float, kind: str
) -> None:
    rig = latched(servo_ids, period_s, kind)
    period_ns = round(period_s * 1e9)
    assert longest_ns(rig, round(5.0 / period_s), Clear(7)) <= period_ns + MORE_NS
    reply = rig.replies()[7]
    assert (reply.ok, reply.code) == (False, "NOT_CLEARED")
    heal(rig)
    rig.ticks(round(1.0 / period_s) + 3)
    assert longest_ns(rig, round(1.0 / period_s) + 3, Clear(8)) <= period_ns + MORE_NS
    assert rig.replies()[8].ok


@given(SUBSETS)
@settings(deadline=None, max_examples=6)
def test_at_the_first_connection_no_tick_is_longer_either(servo_ids: set[int]) -> None:
    rig = Rig()
    silence(rig, servo_ids)
    assert longest_ns(rig, 50) <= 100_000_000 + MORE_NS
    first = next(command for record in rig.records for command in record.inputs.commands)
    assert isinstance(first, Connected)
    assert {problem.servo_id for problem in first.problems} == ({None} if len(servo_ids) == 6 else servo_ids)


def test_servos_that_answer_are_identified_within_one_tick() -> None:
    rig = latched({3})
    heal(rig)
    rig.ticks(8)
    record = rig.tick(Clear(7))
    assert connected(record)
    assert (rig.replies()[7].ok, rig.mode()) == (True, Mode.OFF)


def test_whatever_else_is_asked_for_meanwhile_is_served_at_once_and_every_clear_is_answered() -> None:
    rig = latched({1, 2, 3, 4, 5})
    rig.ticks(1, Clear(7))
    rig.ticks(1, Hold(8), Clear(9), Release(10))
    assert rig.replies().keys() & {7, 8, 9, 10} == {8}
    rig.ticks(6)
    assert rig.replies()[10].code == "NOT_LIMP", "the silent ones are not seen limp"
    assert not {7, 9} & rig.replies().keys()
    rig.ticks(40)
    assert [rig.replies()[number].code for number in (7, 9)] == ["NOT_CLEARED"] * 2
    assert sum(map(connected, rig.records)) == 2, "at first, and for both clears"


def test_samples_between_the_steps_wait_no_longer_than_usual() -> None:
    rig = latched({1, 2, 3, 4, 5})
    before_us = max(record.inputs.sample.bus_us for record in rig.records[-10:])
    rig.records.clear()
    rig.ticks(15, Clear(7))
    assert max(record.inputs.sample.bus_us for record in rig.records) <= before_us
    assert not any(map(connected, rig.records))


@pytest.mark.parametrize("after", [1, 3])
def test_a_port_that_is_lost_meanwhile_ends_it_and_is_identified_anew(after: int) -> None:
    rig = latched({1, 2, 3, 4, 5})
    rig.ticks(after, Clear(7))
    rig.port.unplug()
    rig.ticks(8)
    assert rig.replies()[7].code == "NOT_CLEARED"
    heal(rig)
    rig.records.clear()
    rig.port.replug()
    rig.ticks(12)
    (found,) = [
        command for record in rig.records for command in record.inputs.commands if isinstance(command, Connected)
    ]
    assert found.problems == ()
    assert PORT_GONE not in rig.codes()
    rig.ticks(2, Clear(8))
    assert rig.replies()[8].ok


def test_the_first_connection_after_a_restart_says_so_however_long_it_takes() -> None:
    rig = holding()
    rig.restart()
    silence(rig, {2, 3, 4})
    rig.records.clear()
    rig.ticks(40)
    (found,) = [
        command for record in rig.records for command in record.inputs.commands if isinstance(command, Connected)
    ]
    assert found.restarted
