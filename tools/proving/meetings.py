"""Which faults met in an episode: began within one tick while a program had the arm under torque."""

from collections import Counter
from collections.abc import Iterator, Mapping

from proving.story import HAPPENINGS, PAIRS, TOGETHER_S, Garble, Kill, Late, Line, Story, Strike

# Of a pair that is met the first one begins in the tick looked at, or a part of one before.
WITHIN_S = TOGETHER_S + 0.1


class Meetings:
    """Looks at every tick for what has just begun."""

    def __init__(self, story: Story) -> None:
        self._coming = [(line.at_s, what) for line in story.lines if (what := _happening(line)) in HAPPENINGS]
        self._begun: list[tuple[float, str]] = []
        self.met: Counter[tuple[str, str]] = Counter()

    def tick(self, now_s: float, powered: bool) -> None:
        """A tick is over; whether some servo has torque."""
        while self._coming and self._coming[0][0] <= now_s:
            at_s, what = self._coming.pop(0)
            self._begun = [begun for begun in self._begun if at_s - begun[0] <= WITHIN_S]
            for _, other in self._begun if powered else ():
                self.met[_pair(what, other)] += 1
            self._begun.append((at_s, what))


def _happening(line: Line) -> str:
    """What a line is in the table of pairs; empty: none of it."""
    match line:
        case Strike(fault):
            return fault.kind
        case Garble():
            return "requests"
        case Late():
            return "late tick"
        case Kill():
            return "kill"
    return ""


def _pair(one: str, other: str) -> tuple[str, str]:
    first, second = sorted((one, other), key=HAPPENINGS.index)
    return first, second


def never_met(met: Mapping[tuple[str, str], int]) -> list[str]:
    """Pairs that could have met and did not."""
    return [" + ".join(pair) for pair in PAIRS if not met.get(pair)]


def table(met: Mapping[tuple[str, str], int]) -> Iterator[str]:
    """How often each two of them met, as lines of a triangle."""
    for number, what in enumerate(HAPPENINGS):
        counts = (met.get((other, what), 0) for other in HAPPENINGS[: number + 1])
        yield f"{number:2} {what:<13} " + " ".join(f"{count:3}" for count in counts)
    yield " " * 17 + " ".join(f"{number:3}" for number in range(len(HAPPENINGS)))
