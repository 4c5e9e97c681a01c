"""Quantities that a request gives, with the bounds that every way in holds them to.

Texts of JSON have lists, Python has tuples: `strict=False` lets both in, and nothing else of a request is converted.
"""

from typing import Annotated

from pydantic import AfterValidator, Field

Metre = Annotated[float, Field(ge=-10.0, le=10.0)]
Radian = Annotated[float, Field(ge=-10.0, le=10.0)]
# x, y, z in the base frame [m].
Point = Annotated[tuple[Metre, Metre, Metre], Field(strict=False)]


def _somewhere(direction: tuple[float, float, float]) -> tuple[float, float, float]:
    if max(map(abs, direction)) < 1e-6:
        raise ValueError("0,0,0 points nowhere; give x,y,z in the base frame, such as 0,0,-1 for down")
    return direction


# Where the tool points, of any length, in the base frame.
Direction = Annotated[tuple[Metre, Metre, Metre], Field(strict=False), AfterValidator(_somewhere)]
# x, y, z [m], roll, pitch, yaw [rad] in the base frame, R = Rz(yaw) Ry(pitch) Rx(roll).
Pose = Annotated[tuple[Metre, Metre, Metre, Radian, Radian, Radian], Field(strict=False)]
# One number for each joint, in the calibration file's order.
Joints = Annotated[tuple[Radian, ...], Field(min_length=1, max_length=32, strict=False)]
