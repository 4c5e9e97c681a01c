"""The latest ticks, for files that begin with something that happened before them.

A file replays alone if it begins with a keyframe and the inputs of every tick since; a snapshot of a fault wants the
ticks before the fault as well. So the history reaches back to the newest keyframe that is older than `keep_s`.
"""

from collections import deque
from dataclasses import dataclass

from armctl.clock import NS_PER_S
from armctl.messages import TickRecord

# Kept beyond those of the last `keep_s`; several times what stands between two keyframes.
MAX_RECORDS = 2000


@dataclass(frozen=True)
class Beginning:
    """What a file begins with: a keyframe (empty: none is known), ticks for replay alone, ticks of its own."""

    keyframe: str
    inputs_only: tuple[TickRecord, ...]
    records: tuple[TickRecord, ...]


class History:
    """The last `keep_s` seconds of ticks, and those before them back to a keyframe."""

    def __init__(self, keep_s: float, period_s: float) -> None:
        self._keep_ns = round(keep_s * NS_PER_S)
        self._records: deque[TickRecord] = deque(maxlen=MAX_RECORDS + round(keep_s / period_s))

    def add(self, record: TickRecord) -> None:
        """The newest tick."""
        self._records.append(record)
        if not record.keyframe:
            return
        begin_ns = record.inputs.sample.time_ns - self._keep_ns
        older = [i for i, old in enumerate(self._records) if old.keyframe and old.inputs.sample.time_ns <= begin_ns]
        for _ in range(older[-1] if older else 0):
            self._records.popleft()

    def beginning(self, begin_ns: int | None = None) -> Beginning:
        """For a file of everything since `begin_ns` (monotonic), or of what comes from now on."""
        records = tuple(self._records)
        first = len(records)
        while begin_ns is not None and first > 0 and records[first - 1].inputs.sample.time_ns >= begin_ns:
            first -= 1
        for index in range(first - 1, -1, -1):
            if records[index].keyframe:
                return Beginning(records[index].keyframe, records[index + 1 : first], records[first:])
        return Beginning("", (), records[first:])
