"""The position controller of a servo: where to go, how fast, and how hard to try.

A goal is not reached at once: the *reference* goes there at the moving speed, and the controller pulls the shaft to the
reference. Its output depends on the error, in whole ticks:

    output |          ______ limit
           |        /           slope: `gain` per tick
     punch |      /
           |     |              margin: no output
         --+-----+-----------> error
"""

import math
from collections.abc import Sequence
from struct import Struct
from typing import NamedTuple

from armctl.dynamixel import ax12a

# Of the table: angle limits; max torque; torque enable; margins, slopes; goal, moving speed, torque limit; punch.
DRIVING = Struct("<6xHH4xH8xBx4BHHH12xH")


class Ramp(NamedTuple):
    """The way of the reference to the goal at constant speed; its steps count from 1."""

    begin_tick: float
    goal_tick: float
    # Way in one step, with its sign.
    step_tick: float
    # The step in which the reference reaches the goal; 0: it is there.
    arrival: int

    def at(self, step: int) -> float:
        """The reference [tick] after so many steps."""
        return self.goal_tick if step >= self.arrival else self.begin_tick + self.step_tick * step

    def last_step_at(self, whole_tick: int, step: int, end: int) -> int:
        """The last step, from `step` to at most `end`, in which the reference still rounds to a tick."""
        if step >= self.arrival or whole_tick == self.goal_tick:
            return end
        if self.step_tick > 0.0:
            last = math.ceil((whole_tick + 0.5 - self.begin_tick) / self.step_tick) - 1
        else:
            last = math.floor((whole_tick - 0.5 - self.begin_tick) / self.step_tick)
        return min(end, max(step, last))


class Drive(NamedTuple):
    """What the registers tell the position controller; ticks count CCW, outputs are fractions of full output."""

    enabled: bool
    goal_tick: int
    # Speed of the reference; 0: the reference jumps to the goal.
    ramp_tick_s: float
    output_limit: float
    punch: float
    cw_margin: int
    ccw_margin: int
    # Output per tick beyond the margin.
    cw_gain: float
    ccw_gain: float
    # Output in wheel mode, which knows no goal; None: not in wheel mode.
    spin: float | None

    def output(self, error_tick: int) -> float:
        """Output at an error, which is reference less shaft; both have the same sign."""
        if error_tick > self.ccw_margin:
            return min(self.punch + (error_tick - self.ccw_margin) * self.ccw_gain, self.output_limit)
        if error_tick < -self.cw_margin:
            return -min(self.punch - (error_tick + self.cw_margin) * self.cw_gain, self.output_limit)
        return 0.0

    def ramp(self, reference_tick: float, step_s: float) -> Ramp:
        """The reference's way from where it is."""
        goal_tick = float(self.goal_tick)
        if self.spin is not None:
            reference_tick = goal_tick
        elif not self.enabled:
            goal_tick = reference_tick  # it stays
        way_tick, step_tick = goal_tick - reference_tick, self.ramp_tick_s * step_s
        # At once, unless it has a speed.
        arrival = math.ceil(abs(way_tick) / step_tick) if step_tick != 0.0 else int(way_tick != 0.0)
        return Ramp(reference_tick, goal_tick, step_tick if way_tick > 0.0 else -step_tick, arrival)


def drive_of(registers: Sequence[int], slope_share: float = 1.0) -> Drive:
    """What the registers of `DRIVING` mean to a controller whose output climbs over this share of their slopes."""
    cw_limit, ccw_limit, max_torque, enabled, *compliance, goal, moving_speed, torque_limit, punch = registers
    cw_margin, ccw_margin, *slopes = compliance
    limit, least = min(torque_limit, max_torque) / ax12a.LOAD_MAX, punch / ax12a.LOAD_MAX
    cw_gain, ccw_gain = ((1.0 - least) / (slope_share * ax12a.compliance_slope(slope)) for slope in slopes)
    ramp_tick_s = moving_speed * ax12a.SPEED_UNIT_RAD_S / ax12a.TICK_RAD
    spin: float | None = None
    if cw_limit == ccw_limit == 0:
        spin = min(max(ax12a.load_ratio(moving_speed), -limit), limit) + 0.0  # which turns -0.0 into 0.0
    return Drive(bool(enabled), goal, ramp_tick_s, limit, least, cw_margin, ccw_margin, cw_gain, ccw_gain, spin)
