"""The tool draws a circle twice: its points are an array of numpy."""

import numpy as np

from armctl import Arm

turn = np.linspace(0.0, 4.0 * np.pi, 73)
circle = np.column_stack([np.full(73, 0.18), 0.03 * np.sin(turn), 0.15 + 0.03 * np.cos(turn)])
with Arm() as arm:
    arm.torque_on()
    done = arm.path(circle, duration_s=12.0)
print(f"{done['mean_error_mm']:.1f} mm off the circle, by the encoders; recorded as {done['recording']}")
