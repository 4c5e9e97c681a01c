"""A port that vanishes is data to whoever uses the bus, and leaves nothing locked."""

from collections.abc import Callable

import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import NO_REPLY, PORT_GONE
from armctl.dynamixel.identify import answers_twice
from armctl.messages import Goal, Write
from tests.dynamixel.conftest import ARM, ScriptedBus, at

GOAL = Goal((512,) * 6, (50,) * 6)
TORQUE_ON = Write(1, 24, 1, 1)


@pytest.mark.parametrize("requests", range(7))
def test_port_that_vanishes_within_a_sample_is_data(bus: ScriptedBus, requests: int) -> None:
    before = bus.read_sample()
    bus.port.gone_after = requests
    sample = bus.next_sample()
    if requests == 6:  # it vanished only after the last answer was in
        sample = bus.next_sample()
    assert (sample.port_open, bus.is_open, bus.port.is_using) == (False, False, False)
    assert [(reading.fresh, reading.problem) for reading in sample.servos] == [(False, PORT_GONE)] * 6
    assert all(new.stamp_ns >= old.stamp_ns > 0 for new, old in zip(sample.servos, before.servos, strict=True))


def test_port_that_vanishes_while_draining_closes_the_bus(bus: ScriptedBus, monkeypatch: pytest.MonkeyPatch) -> None:
    bus.read_sample()
    bus.port.spoils[1] = [at(16384)]
    monkeypatch.setattr(bus.port, "drain", lambda *_: bus.port.check(gone=True))
    assert not bus.next_sample().port_open
    assert not bus.is_open


def test_closed_bus_answers_everything_with_data(bus: ScriptedBus) -> None:
    bus.close()
    assert not bus.read_sample().port_open
    assert not bus.write_goal(GOAL)
    assert not bus.write(TORQUE_ON)
    assert bus.read(1, ax12a.MODEL) is None
    assert bus.read_block(1, 0, 3).problem == PORT_GONE
    assert not answers_twice(bus, 1)
    assert [problem.code for problem in bus.identify(ARM.joints)] == [PORT_GONE]
    assert bus.port.requests == []


def test_reopened_bus_reads_again(bus: ScriptedBus) -> None:
    bus.read_sample()
    bus.port.gone_after = 0
    bus.read_sample()
    bus.close()
    bus.open()
    sample = bus.next_sample()
    assert sample.port_open
    assert all(reading.fresh for reading in sample.servos)


def test_every_way_the_port_can_vanish_leaves_is_using_false(bus: ScriptedBus) -> None:
    calls: list[Callable[[], object]] = [
        bus.read_sample,
        lambda: bus.write_goal(GOAL),
        lambda: bus.write(TORQUE_ON),
        lambda: bus.read(1, ax12a.GOAL),
        lambda: answers_twice(bus, 1),
        lambda: bus.identify(ARM.joints),
    ]
    for call in calls:
        bus.open()
        bus.port.gone_after = 0
        call()
        assert (bus.port.is_using, bus.is_open) == (False, False)


def test_unexpected_error_in_the_transport_leaves_is_using_false(
    bus: ScriptedBus, monkeypatch: pytest.MonkeyPatch
) -> None:
    with monkeypatch.context() as broken:
        broken.setattr(bus.port, "_fill", None)
        with pytest.raises(TypeError):
            bus.read_sample()
    assert not bus.port.is_using
    assert bus.read_sample().servos[0].fresh


def test_line_that_takes_no_bytes_is_no_reply(bus: ScriptedBus) -> None:
    bus.port.stuck = True
    assert {reading.problem for reading in bus.read_sample().servos} == {NO_REPLY}
    assert not bus.write_goal(GOAL)
    assert bus.is_open
