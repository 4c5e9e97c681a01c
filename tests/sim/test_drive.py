"""What the registers of a servo mean for its position controller."""

import numpy as np
import pytest

from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.sim.servo import SimulatedServo


def test_drive_is_read_off_the_table() -> None:
    servo = SimulatedServo(1, np.random.default_rng(0))
    for register, value in {
        ax12a.TORQUE_ENABLE: 1, ax12a.GOAL: 700, ax12a.MOVING_SPEED: 100, ax12a.TORQUE_LIMIT: 900,
        ax12a.MAX_TORQUE: 800, ax12a.PUNCH: 50, ax12a.CW_MARGIN: 2, ax12a.CCW_MARGIN: 3,
        ax12a.CW_SLOPE: 16, ax12a.CCW_SLOPE: 64,
    }.items():  # fmt: skip
        servo.set(register, value)
    drive = servo.drive
    assert (drive.enabled, drive.goal_tick, drive.cw_margin, drive.ccw_margin, drive.spin) == (True, 700, 2, 3, None)
    assert drive.ramp_tick_s == pytest.approx(100 * ax12a.SPEED_UNIT_RAD_S / TICK_RAD)
    assert (drive.output_limit, drive.punch) == pytest.approx((800 / 1023, 50 / 1023))
    assert drive.output(3) == 0.0 == drive.output(-2)
    assert drive.output(-3) == pytest.approx(-50 / 1023 - (1.0 - 50 / 1023) / 16)
    assert drive.output(4) == pytest.approx(50 / 1023 + (1.0 - 50 / 1023) / 64)
    assert drive.output(500) == 800 / 1023
    servo.set(ax12a.TORQUE_LIMIT, 700)  # the lower of both counts
    assert servo.drive.output_limit == pytest.approx(700 / 1023)
    servo.set(ax12a.CW_LIMIT, 0)
    servo.set(ax12a.CCW_LIMIT, 0)
    assert servo.drive.spin == pytest.approx(100 / 1023)


@pytest.mark.parametrize(
    ("register", "slope"), [(1, 2), (2, 2), (3, 2), (4, 4), (32, 32), (63, 32), (64, 64), (254, 128)]
)
def test_compliance_slope_is_quantised(register: int, slope: int) -> None:
    assert ax12a.compliance_slope(register) == slope
