"""Two servos on one joint: what the second one reads where the first one reads something.

They are bolted to one part, mostly facing each other. That `1023 - x` is what the second one reads holds on paper
alone: horns sit on their shafts by the tooth, and potentiometers are not alike. Real pairs are 10 to 15 ticks off, and
two stiff servos then push against each other for good. So a pair may have a measured table.
"""

from bisect import bisect_right
from typing import Annotated, Literal, NamedTuple

from pydantic import Field

from armctl.dynamixel.ax12a import TICK_MAX
from armctl.strict_yaml import Frozen, is_none

# Between two rows of a table the second servo turns by no less than this share of what the first one does, nor by more
# than its inverse.
LEAST_SHARE = 0.7

# Farther apart two servos of one joint do not agree.
APART_TICKS = 12

Points = tuple[tuple[float, float], ...]
Row = Annotated[tuple[float, float], Field(strict=False)]


class Linkage(NamedTuple):
    """How two servos that turn one joint read against each other."""

    # 1 where both read more at once, -1 where they face each other.
    sense: int
    # What the first and the second read at the same place, and the other way round; each rising.
    forth: Points
    back: Points

    def second(self, tick: float) -> float:
        """What the second servo reads where the first one reads `tick`; beyond what was measured it goes on evenly."""
        return _read_off(self.forth, self.sense, tick)

    def first(self, tick: float) -> float:
        """What the first servo reads where the second one reads `tick`."""
        return _read_off(self.back, self.sense, tick)


def linkage(points: Points, sense: int) -> Linkage:
    """Of two servos that read `points` (first, second) at the same places, in the first one's order."""
    return Linkage(sense, points, tuple(sorted([(b, a) for a, b in points])))


def _read_off(points: Points, sense: int, tick: float) -> float:
    above = bisect_right(points, (tick, TICK_MAX * 4.0))
    if above in (0, len(points)):
        x, y = points[max(0, above - 1)]
        return y + sense * (tick - x)
    (x, y), (x_end, y_end) = points[above - 1], points[above]
    return y + (y_end - y) * (tick - x) / (x_end - x)


class PairConfig(Frozen):
    """The second servo of a joint; model, compliance, torque and speed limits are those of the first one."""

    # Its ID on the bus.
    servo_id: int = Field(ge=0, le=253)
    # As of a joint; left out: it faces the first one.
    direction: Literal[1, -1] | None = Field(None, exclude_if=is_none)
    # What it reads at joint position 0; left out: 1023 less what the first one reads there, or the same if it faces the
    # same way.
    zero_tick: float | None = Field(None, ge=-1023.0, le=2046.0, exclude_if=is_none)
    # Instead of both, measured by `armctl calibrate --pairs`: what the first servo reads, rising, and what this one
    # reads there.
    table: tuple[Row, ...] | None = Field(None, min_length=2, max_length=64, strict=False, exclude_if=is_none)

    def _check(self) -> None:
        if self.table is None:
            return
        if self.direction is not None or self.zero_tick is not None:
            raise ValueError("pair has a table, which says all of direction and zero_tick; leave these two out")
        for number, row in enumerate(self.table, start=1):
            if not all(0.0 <= tick <= TICK_MAX for tick in row):
                raise ValueError(f"pair.table row {number} {list(row)}: a servo reads 0 to {TICK_MAX}")
        anew = "measure anew: `armctl calibrate --pairs`"
        sense = _sense(self.table)
        for number, ((a, b), (a_end, b_end)) in enumerate(zip(self.table, self.table[1:], strict=False), start=2):
            if a_end <= a:
                raise ValueError(f"pair.table row {number}: {a_end:g} after {a:g}; the first servo's ticks must rise")
            share = sense * (b_end - b) / (a_end - a)
            if share <= 0.0:
                raise ValueError(f"pair.table row {number}: {b_end:g} after {b:g}: the second servo turns back; {anew}")
            if not LEAST_SHARE <= share <= 1.0 / LEAST_SHARE:
                ways = f"by {abs(b_end - b):g} ticks where the first one turns by {a_end - a:g}"
                raise ValueError(f"pair.table row {number}: the second servo turns {ways}, on one shaft; {anew}")

    def linked(self, direction: int, zero_tick: float) -> Linkage:
        """How it reads against the first servo, which has this direction and zero tick."""
        if self.table is not None:
            return linkage(self.table, _sense(self.table))
        sense = -1 if self.direction is None else self.direction * direction
        mirrored = TICK_MAX - zero_tick if sense < 0 else zero_tick
        return linkage(((zero_tick, mirrored if self.zero_tick is None else self.zero_tick),), sense)


def _sense(table: Points) -> int:
    return 1 if table[-1][1] > table[0][1] else -1
