"""What a servo's registers come to for its motor: where to go, how fast, and how hard to try."""

from __future__ import annotations

from struct import Struct
from typing import NamedTuple

from armctl.dynamixel import ax12a

DRIVING = Struct("<6xHH4xH8xBx4BHHH12xH")
"""Of the table: angle limits; max torque; torque enable; margins, slopes; goal, moving speed, torque limit; punch."""


class Drive(NamedTuple):
    """What the registers tell the position controller; ticks count CCW, outputs are fractions of full output."""

    enabled: bool
    goal_tick: int
    ramp_tick_s: float
    """Speed of the reference; 0: the reference jumps to the goal."""
    output_limit: float
    punch: float
    cw_margin: int
    ccw_margin: int
    cw_gain: float
    """Output per tick beyond the margin."""
    ccw_gain: float
    spin: float | None
    """Output in wheel mode, which knows no goal; None: not in wheel mode."""


def drive_of(
    cw_limit: int,
    ccw_limit: int,
    max_torque: int,
    enabled: int,
    cw_margin: int,
    ccw_margin: int,
    cw_slope: int,
    ccw_slope: int,
    goal: int,
    moving_speed: int,
    torque_limit: int,
    punch: int,
) -> Drive:
    """What the registers of `DRIVING` come to."""
    limit = min(torque_limit, max_torque) / ax12a.LOAD_MAX
    ramp = 1.0 - punch / ax12a.LOAD_MAX
    return Drive(
        enabled=bool(enabled),
        goal_tick=goal,
        ramp_tick_s=moving_speed * ax12a.SPEED_UNIT_RAD_S / ax12a.TICK_RAD,
        output_limit=limit,
        punch=punch / ax12a.LOAD_MAX,
        cw_margin=cw_margin,
        ccw_margin=ccw_margin,
        cw_gain=ramp / compliance_slope(cw_slope),
        ccw_gain=ramp / compliance_slope(ccw_slope),
        spin=min(max(ax12a.load_ratio(moving_speed), -limit), limit) if cw_limit == ccw_limit == 0 else None,
    )


def compliance_slope(register: int) -> int:
    """Slope [tick] of a compliance-slope register: the steps are 2, 4, 8, ..., 128."""
    return max(2, 1 << (register.bit_length() - 1))
