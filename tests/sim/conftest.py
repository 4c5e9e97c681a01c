"""The arm every simulator test plays with, and the bytes that move it."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, encode_instruction
from armctl.files import load_arm


@pytest.fixture(scope="session")
def arm() -> ArmConfig:
    return load_arm("ax12-line")


def sync_write(arm: ArmConfig, positions_rad: Sequence[float], speeds: Sequence[int]) -> bytes:
    """SYNC_WRITE of goals (clamped to the limits) and moving speeds [register units]."""
    data = bytes((ax12a.GOAL.address, 4))
    for joint, position, speed in zip(arm.joints, positions_rad, speeds, strict=True):
        low, high = joint.limits_tick
        tick = min(max(round(joint.tick(position)), low), high)
        data += bytes((joint.servo_id,)) + tick.to_bytes(2, "little") + speed.to_bytes(2, "little")
    return encode_instruction(BROADCAST_ID, Instruction.SYNC_WRITE, data)
