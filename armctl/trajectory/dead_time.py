"""Dead time: what a recording holds before the arm first moves and after it last does."""

import numpy as np

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.transform import FloatArray

# A joint has moved once it is farther than this from where it stood: noise is one tick, and a hand never stays still.
STILL_RAD = 4.0 * TICK_RAD


def moving_part(positions_rad: FloatArray) -> slice:
    """The samples from the last one at the beginning to the first one at the end; all of them where nothing moves.

    Args:
        positions_rad: Joint positions [rad], shape (m, joints), m >= 1.
    """
    left = np.abs(positions_rad - positions_rad[0]).max(axis=1) > STILL_RAD
    arriving = np.abs(positions_rad - positions_rad[-1]).max(axis=1) > STILL_RAD
    if not left.any():
        return slice(0, len(positions_rad))
    return slice(int(left.argmax()) - 1, len(positions_rad) - int(arriving[::-1].argmax()) + 1)
