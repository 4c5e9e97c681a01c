"""What the position sensor of a servo reads at an angle of its shaft.

The sensor is a resistive track of 300 deg. Beyond its ends it saturates for `EDGE_TICK`. In the rest of the turn it is
open: what it reads there is erratic (here a function of the angle alone, so that it repeats).
"""

import math

from armctl.dynamixel.ax12a import TICK_MAX, TICK_RAD

TURN_TICK = 2.0 * math.pi / TICK_RAD
# The track ends this far beyond 0 and 1023: a guess.
EDGE_TICK = 10.0


def sensed_tick(position_tick: float) -> int:
    """What the sensor reads at a shaft angle [tick], any number of turns away."""
    tick = math.floor(position_tick + 0.5)
    if 0 <= tick <= TICK_MAX:
        return tick
    turned = position_tick % TURN_TICK
    if turned > TURN_TICK - EDGE_TICK:
        return 0
    if turned > TICK_MAX + EDGE_TICK:
        return int(turned * 64.0) * 0x9E3779B1 >> 12 & TICK_MAX  # a hash: scattered, yet the same at the same angle
    return min(math.floor(turned + 0.5), TICK_MAX)


def sensed_range(shaft_rad: float) -> tuple[int, float, float]:
    """What the sensor reads, and the shaft angles [rad] between which it reads the same: from the first to below the
    second. Off the track there is no such range: it has to be read in every step.
    """
    tick = math.floor(shaft_rad / TICK_RAD + 0.5)
    if not 0 <= tick <= TICK_MAX:
        return sensed_tick(shaft_rad / TICK_RAD), math.inf, -math.inf
    begin_rad = (tick - 0.5) * TICK_RAD
    return tick, begin_rad, begin_rad + TICK_RAD
