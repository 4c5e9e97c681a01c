"""Goals, writes and reads of single servos: their bytes, and what is refused before the wire."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import NO_REPLY
from armctl.messages import Goal, Write
from tests.dynamixel.conftest import BYTE_NS, LOST, ScriptedBus, echo


def test_goal_is_one_sync_write_of_four_bytes_at_address_30(bus: ScriptedBus) -> None:
    assert bus.write_goal(Goal((0, 1, 256, 512, 1022, 1023), (1, 2, 3, 300, 1023, 0)))
    assert len(bus.port.requests) == 1
    body = bus.port.requests[0][2:-1]
    rows = ((1, 0, 0, 1, 0), (2, 1, 0, 2, 0), (3, 0, 1, 3, 0), (4, 0, 2, 44, 1), (5, 254, 3, 255, 3), (6, 255, 3, 0, 0))
    assert list(body) == [254, 34, 0x83, 30, 4, *(byte for row in rows for byte in row)]
    assert bus.port.requests[0][-1] == ~sum(body) & 0xFF


@pytest.mark.parametrize("bad", [-1, 1024, 70_000, 512.0, None])
def test_goal_that_is_no_whole_tick_is_refused_before_the_wire(bus: ScriptedBus, bad: int) -> None:
    spoiled, fine = (512, 512, bad, 512, 512, 512), (512,) * 6
    for goal in (Goal(spoiled, fine), Goal(fine, spoiled)):
        with pytest.raises(ValueError, match=r"servo 3: .* no whole number in 0\.\.1023"):
            bus.write_goal(goal)
    assert bus.port.requests == []


def test_goal_of_another_arm_is_refused(bus: ScriptedBus) -> None:
    with pytest.raises(ValueError, match="5 values of moving speed for 6 servos"):
        bus.write_goal(Goal((512,) * 6, (50,) * 5))


@given(register=st.sampled_from([register for register in ax12a.REGISTERS if register.writable]), data=st.data())
def test_read_returns_what_write_wrote_for_every_register(register: ax12a.Register, data: st.DataObject) -> None:
    bus = ScriptedBus(1)
    value = data.draw(st.integers(register.minimum, register.maximum))
    assert bus.write(Write(1, register.address, register.size, value))
    assert bus.read(1, register) == value


def test_write_is_repeated_once(bus: ScriptedBus) -> None:
    bus.port.spoils[2] = [LOST]
    assert bus.write(Write(2, 24, 1, 1))
    bus.port.spoils[2] = [LOST, LOST]
    assert not bus.write(Write(2, 24, 1, 1))
    assert bus.is_open


def test_refused_write_is_no_good_reply_but_a_hot_servo_still_obeys(
    bus: ScriptedBus, caplog: pytest.LogCaptureFixture
) -> None:
    bus.port.errors[2] = int(ax12a.ErrorBit.RANGE)
    assert not bus.write(Write(2, 24, 1, 1))
    assert "servo 2 refused 1 at address 24: RANGE" in caplog.text
    bus.port.errors[2] = int(ax12a.ErrorBit.OVERHEAT)
    assert bus.write(Write(2, 24, 1, 1))


@pytest.mark.parametrize("write", [(1, 30, 2, 70_000), (1, 24, 1, -1), (1, 24, 3, 1), (254, 24, 1, 1)])
def test_write_that_does_not_fit_is_refused_before_the_wire(bus: ScriptedBus, write: tuple[int, int, int, int]) -> None:
    with pytest.raises(ValueError, match=r"does not fit|is not in"):
        bus.write(Write(*write))
    assert bus.port.requests == []


def test_echoing_adapter_never_looks_like_a_servo(bus: ScriptedBus) -> None:
    for register in ax12a.REGISTERS:
        bus.port.spoils[1] = [echo, echo]
        assert bus.read(1, register) is None
    bus.port.spoils[1] = [echo, echo]
    assert not bus.write(Write(1, 24, 1, 1))


def test_block_of_a_servo_tells_its_bytes_its_error_bits_and_its_time(bus: ScriptedBus) -> None:
    bus.port.errors[2] = ax12a.ErrorBit.OVERLOAD
    reply = bus.read_block(2, 0, ax12a.EEPROM_END)
    assert (reply.data, reply.error, reply.problem) == (bytes(bus.port.tables[2][:24]), ax12a.ErrorBit.OVERLOAD, "")
    assert reply.elapsed_ns == (8 + 30) * BYTE_NS + 500_000
    with pytest.raises(ValueError, match="two bytes"):
        bus.read_block(2, 0, 2)


def test_silent_servo_reads_as_none(bus: ScriptedBus) -> None:
    assert bus.read(77, ax12a.MODEL) is None
    assert bus.read_block(77, 0, 3).problem == NO_REPLY
