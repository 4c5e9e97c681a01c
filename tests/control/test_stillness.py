"""Whether a limp shaft stands, and where, by readings of quiet and of noisy sensors."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.control.stillness import MANY, MOVING_TICKS, STILL_TICKS, shaft
from armctl.messages import Mode, TorqueOn
from armctl.sim.spec import RANDOM_SPEC, put_together
from tests.control.damaged_arm import Rig

seeds = st.integers(0, 2**32 - 1)


def read(seed: int, count: int, noise_tick: float, tick_per_reading: float = 0.0) -> list[int]:
    """Readings of a shaft at 500, or that comes from there."""
    rng = np.random.default_rng(seed)
    places = 500.0 + tick_per_reading * np.arange(count) + noise_tick * rng.standard_normal(count)
    return [math.floor(place + 0.5) for place in places]


@given(place=st.integers(0, 1023), count=st.integers(2, 40))
def test_a_shaft_that_always_reads_the_same_stands_there(place: int, count: int) -> None:
    assert shaft([place] * count) == (place, True, STILL_TICKS)


@given(before=st.integers(MANY, 30), way=st.integers(STILL_TICKS + 1, 200))
def test_of_a_quiet_sensor_one_reading_tells_that_the_shaft_moved(before: int, way: int) -> None:
    readings = [500] * before + [500 + way]
    assert shaft(readings).still is False
    assert shaft(readings, 500).still is False


@pytest.mark.parametrize("way", [5, 6, 9])
def test_a_shaft_between_two_ticks_that_is_pushed_away_hardly_ever_stands(way: int) -> None:
    rng, stands = np.random.default_rng(2), 0
    for _ in range(2000):
        readings = [math.floor(place + 0.5) for place in 500.5 + 0.5 * rng.standard_normal(MANY)]
        stands += any(shaft([*readings, 501 + way], anchor).still is True for anchor in (None, 500))
    assert stands <= 10


@pytest.mark.parametrize("tick_per_reading", [5.0, 8.0, 20.0, 60.0])
@pytest.mark.parametrize(("noise_tick", "share"), [(0.0, 0.0), (0.5, 0.05), (2.0, 0.25)])
def test_a_shaft_that_is_led_somewhere_hardly_ever_stands(
    tick_per_reading: float, noise_tick: float, share: float
) -> None:
    found = [shaft(read(seed, MANY, noise_tick, tick_per_reading)).still is True for seed in range(2000)]
    assert sum(found) <= share * len(found)  # with two ticks of noise it may seem to stand beside where it was


@pytest.mark.parametrize("way", [7, 9, 13])
@pytest.mark.parametrize("noise_tick", [0.7, 1.0, 1.5])
def test_a_shaft_that_falls_at_the_last_moment_stands_nowhere_whatever_the_noise(noise_tick: float, way: int) -> None:
    fallen = [(*read(seed, MANY, noise_tick), read(seed + 5000, 1, noise_tick)[0] + way) for seed in range(1000)]
    assert sum(shaft(readings, 500).still is True for readings in fallen) <= 100


def test_a_shaft_that_stands_is_hardly_ever_told_to_move_for_two_ticks_of_noise() -> None:
    rng = np.random.default_rng(1)
    for count in (2, 3, 5, MANY):
        found = [shaft(read(seed, count, 2.0), 500 + int(rng.integers(-3, 4))) for seed in range(5000)]
        assert sum(one.still is False for one in found) <= 2
        assert all(abs(one.tick - 500) <= MOVING_TICKS for one in found)


def test_where_a_noisy_shaft_stands_is_known_within_a_tick_or_two() -> None:
    off = np.array([shaft(read(seed, MANY, 2.0)).tick - 500 for seed in range(2000)])
    assert off.std() < 1.0
    assert np.abs(off).max() <= 5


def test_a_shaft_that_was_led_and_stands_now_is_known_to_at_once() -> None:
    for way in (4, 7, 40):
        assert shaft([500, *range(520, 520 + 12 * way, way), *(520 + 11 * way,) * 2])[:2] == (520 + 11 * way, True)


@pytest.mark.parametrize("way", range(4, 14))
def test_where_a_quiet_shaft_fell_to_is_known_after_three_readings(way: int) -> None:
    fell = [
        shaft([*read(seed, MANY - 3, 0.5), *(place + way for place in read(seed + 1000, 3, 0.5))]).tick
        for seed in range(200)
    ]
    assert sum(abs(tick - 500 - way) > 2 for tick in fell) <= 4  # of a few the noise seems more than half a tick


@given(jump=st.integers(MOVING_TICKS + 1, 500), seed=seeds, noise_tick=st.floats(0.0, 2.0))
def test_a_jump_that_no_noise_makes_is_one(jump: int, seed: int, noise_tick: float) -> None:
    readings = read(seed, MANY, noise_tick)
    assert shaft([*readings, readings[-1] + jump]).still is False


@pytest.mark.parametrize("age", ["new", "worn"])
def test_an_arm_of_noisy_sensors_takes_torque_near_its_shafts(age: str) -> None:
    spec = replace(put_together(RANDOM_SPEC, "perfect", age), noise_tick=2.0, noise_spread=0.0)
    for seed in range(40):
        rig = Rig(seed, spec)
        rig.ticks(45, TorqueOn(900))
        assert rig.replies()[900].ok, rig.replies()[900].message
        assert rig.mode() is Mode.HOLDING
        shafts = np.array([servo.position_tick for servo in rig.simulated.servos])
        assert np.abs(shafts - rig.loop.state.goal).max() < 12.0
