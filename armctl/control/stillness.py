"""Whether a limp shaft stands still, and where, by its latest readings [tick], the latest last.

Rules.
1. Noise is told by how readings go to and fro; a shaft that is led somewhere goes one way. What was read before the
   last jump does not count.
2. Of a sensor that is known to be quiet the latest reading counts. The shaft stands if the one before is within
   `STILL_TICKS`, and so is where it stood when torque began to come on. One that is not known yet counts as quiet as
   long as its readings look so. What was quiet up to three readings ago is where these agree, wherever it fell to.
3. Of any other it takes `MANY` readings. The shaft is at the mean of the later half of them, and stands if that of the
   earlier half is as near, and the latest reading is as near as the noise lets it be. So two ticks of noise refuse no
   arm, and torque comes on near the shaft.
"""

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

# Largest change between two readings of a quiet sensor on a shaft that stands (its noise is one tick).
STILL_TICKS = 3
# What even a worn sensor does not read of a shaft that stands, and what it reads once in 200 times.
MOVING_TICKS, JUMP_TICKS = 14, 8
# Second differences of readings, summed: of a sensor that is known to be quiet by so many, for each of them; of one
# that may be, for each and on top. With two ticks of noise 13 are less than 14 once in 5000 times, and with half a tick
# more than 31 once in 2000.
KNOWN, QUIET_TICKS = 13, 1.1
# So many latest readings that agree tell where a shaft stands that was quiet before, as told by so many differences.
AGREE, SETTLED_KNOWN = 3, 10
UNSURE_TICKS, MORE_TICKS = 2, 5
# The latest reading of a standing shaft is this near to the mean but once in a hundred times, as a share of the mean
# second difference, which is 1.95 times the noise; another reading is waited for then.
NEAR_SHARE = 1.25
MANY = 16


class Shaft(NamedTuple):
    """What is known of a limp shaft."""

    tick: int
    # None: more readings are needed to tell.
    still: bool | None
    # Readings of a shaft that stands are this near to where it is.
    noise_ticks: int


def shaft(readings: Sequence[int], anchor: int | None = None) -> Shaft:
    """Where a shaft is, and whether it stands.

    Args:
        readings: Two or more.
        anchor: Where it stood when torque began to come on; None: nobody has looked yet.
    """
    now, last, before, latest = readings[-1], readings[-2], _to_and_fro(readings[:-AGREE]), readings[-AGREE:]
    settled = len(before) >= SETTLED_KNOWN and sum(before) <= UNSURE_TICKS * len(before)
    settled = settled and max(latest) - min(latest) <= STILL_TICKS
    jumps = [k for k, (a, b) in enumerate(pairwise(readings[:-1]), start=1) if abs(b - a) > JUMP_TICKS]
    readings = readings[max(jumps, default=0) :]
    fro = _to_and_fro(readings[:-1])
    near = abs(now - last) <= STILL_TICKS and abs(now - (last if anchor is None else anchor)) <= STILL_TICKS
    known = len(fro) >= KNOWN and sum(fro) <= QUIET_TICKS * len(fro)
    if known or (near and sum(fro) <= UNSURE_TICKS * len(fro) + MORE_TICKS):
        return Shaft(now, near, STILL_TICKS)
    half = min(len(readings), MANY) // 2
    late, early = sum(readings[-half:]) / half, sum(readings[-2 * half : -half]) / half
    if abs(now - last) > MOVING_TICKS or (anchor is not None and abs(late - anchor) > MOVING_TICKS):
        return Shaft(round(late), False, MOVING_TICKS)
    still = len(readings) >= MANY and abs(late - early) <= STILL_TICKS
    still = still and abs(now - late) <= NEAR_SHARE * sum(fro) / len(fro)
    return Shaft(sorted(latest)[AGREE // 2] if settled else round(late), still or None, MOVING_TICKS)


def _to_and_fro(readings: Sequence[int]) -> list[int]:
    """Second differences of readings, as they are without a sign."""
    return [abs(c - 2 * b + a) for a, b, c in zip(readings, readings[1:], readings[2:], strict=False)]
