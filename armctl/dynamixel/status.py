"""What the status bytes of a servo (24..49) can be, judged without knowing the servo."""

from __future__ import annotations

from armctl.dynamixel import ax12a

MOTION_MARGIN = 1.5
MOTION_MARGIN_TICKS = 3.0
SPEED_BOUND_TICK_S = MOTION_MARGIN * (ax12a.NO_LOAD_SPEED_RAD_S / ax12a.TICK_RAD)
NS_PER_S = 1_000_000_000
POSITION_AT = ax12a.PRESENT_POSITION.address - ax12a.STATUS_BEGIN


def _impossible_bits() -> int:
    """Bits of the block 24..49, as a little-endian number, that the control table never sets."""
    mask = 0
    for register in ax12a.REGISTERS:
        if not register.eeprom and register.maximum & (register.maximum + 1) == 0:
            unused = (1 << 8 * register.size) - 1 - register.maximum
            mask |= unused << 8 * (register.address - ax12a.STATUS_BEGIN)
    return mask


IMPOSSIBLE_BITS = _impossible_bits()


Seen = tuple[int, int]
"""Where a servo was [tick], and when [ns]."""


def position_tick(block: bytes) -> int:
    """Present position [tick] in a block of status bytes."""
    return block[POSITION_AT] | block[POSITION_AT + 1] << 8


def believable(seen: Seen, last: Seen | None, doubted: Seen | None) -> bool:
    """Whether a servo can have moved to where it is seen.

    Args:
        last: Where it was by the last reading that was believed.
        doubted: Where it was by one that was not, if there was one since; two that agree are believed.
    """
    if last is not None and abs(seen[0] - last[0]) <= MOTION_MARGIN_TICKS:
        return True  # nearly always
    if last is None:
        return doubted is None or _reachable(seen, doubted)
    return _reachable(seen, last) or (doubted is not None and _reachable(seen, doubted))


def _reachable(seen: Seen, before: Seen) -> bool:
    time_s = max(0, seen[1] - before[1]) / NS_PER_S
    return abs(seen[0] - before[0]) <= SPEED_BOUND_TICK_S * time_s + MOTION_MARGIN_TICKS
