"""What grips: a joint of the arm, or a servo that is none of its joints."""

import math
from typing import Any

from pydantic import Field

from armctl.dynamixel import ax12a
from armctl.pair import PairConfig
from armctl.strict_yaml import Degrees, Frozen, Name, is_none

# 5.9 deg: nearer than what a joint may be behind its goal before it counts as blocked.
MAX_GRIP_TICK = 20


class OwnGripper(Frozen):
    """A gripper that is none of the joints: a servo of its own."""

    # What to call it.
    name: Name = "gripper"
    # Its ID on the bus.
    servo_id: int = Field(ge=0, le=253)
    # What the servo reads where the gripper has let go.
    open_tick: int = Field(ge=0, le=ax12a.TICK_MAX)
    # What it reads where it is closed with nothing in between.
    closed_tick: int = Field(ge=0, le=ax12a.TICK_MAX)
    # How wide it is where it has let go.
    open_mm: float | None = Field(None, ge=0.0, le=500.0)
    # And where it is closed.
    closed_mm: float | None = Field(None, ge=0.0, le=500.0)
    # The load that tells a grip, and that holds it.
    load_ratio: float = Field(0.3, ge=0.15, le=0.5)
    # A second servo that turns it.
    pair: PairConfig | None = None

    def as_joint(self) -> tuple[dict[str, Any], dict[str, Any]]:
        """The joint that it is, and what `gripper` then says."""
        closed_deg = math.degrees((self.closed_tick - self.open_tick) * ax12a.TICK_RAD)
        joint: dict[str, Any] = {"name": self.name, "servo_id": self.servo_id, "zero_tick": float(self.open_tick)}
        if self.pair is not None:
            joint["pair"] = self.pair.model_dump(exclude_unset=True)
        joint |= {"limits_deg": sorted((0.0, closed_deg)), "rest_deg": 0.0}
        sizes = {key: size for key in ("open_mm", "closed_mm") if (size := getattr(self, key)) is not None}
        gripper = {"joint": self.name, "open_deg": 0.0, "closed_deg": closed_deg, "load_ratio": self.load_ratio}
        return joint, gripper | sizes


class GripperConfig(Frozen):
    """The joint that grips. It moves no tool point, and gets from open to closed unless something is in between."""

    # Its name among the joints.
    joint: Name
    # Where it has let go.
    open_deg: Degrees
    # Where it is closed with nothing in between.
    closed_deg: Degrees
    # The load that tells a grip, and that holds it: above friction, below what makes the servo hot.
    load_ratio: float = Field(0.3, ge=0.15, le=0.5)
    # How wide it is where it has let go.
    open_mm: float | None = Field(None, ge=0.0, le=500.0, exclude_if=is_none)
    # And where it is closed.
    closed_mm: float | None = Field(None, ge=0.0, le=500.0, exclude_if=is_none)

    def opening_mm(self, position_rad: float) -> float | None:
        """How wide it is, if its file says how wide it opens and closes."""
        if self.open_mm is None or self.closed_mm is None:
            return None
        share = (math.degrees(position_rad) - self.open_deg) / (self.closed_deg - self.open_deg)
        return self.open_mm + share * (self.closed_mm - self.open_mm)
