"""What the position sensor reads, on its track and off it."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.sim.potentiometer import TURN_TICK, sensed_range, sensed_tick


@given(st.floats(-2500.0, 2500.0))
def test_potentiometer_reads_a_tick_at_every_angle_and_the_angle_within_its_range(position_tick: float) -> None:
    tick = sensed_tick(position_tick)
    assert 0 <= tick <= 1023
    assert tick == sensed_tick(position_tick)
    turned = position_tick % TURN_TICK
    if turned <= 1023.0:
        assert abs(tick - turned) <= 0.5 + 1e-9 or abs(tick - turned) > 1022.0  # just below a whole turn it reads 0


def test_dead_zone_saturates_at_its_edges_and_is_erratic_inside() -> None:
    assert [sensed_tick(tick) for tick in (-8.0, -1.0, 1024.0, 1032.0)] == [0, 0, 1023, 1023]
    inside = [sensed_tick(tick) for tick in np.arange(1034.0, 1217.0, 0.5)]
    assert np.std(inside) > 200.0
    assert np.abs(np.diff(inside)).mean() > 100.0


@given(st.floats(-8.0, 8.0))
def test_a_range_reads_the_same_from_its_begin_to_below_its_end(shaft_rad: float) -> None:
    tick, begin, end = sensed_range(shaft_rad)
    assert tick == sensed_tick(shaft_rad / TICK_RAD)
    if begin < end:
        assert begin - 1e-12 <= shaft_rad <= end + 1e-12
        assert {sensed_tick(at / TICK_RAD) for at in np.linspace(begin + 1e-9, end - 1e-9, 5)} == {tick}
