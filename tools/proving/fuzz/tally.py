"""What was tried, and what came of it."""

import os
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

HANG_S = 1.0
GROWTH_BOUND_MB = 32.0
MOST_EXAMPLES = 8


@dataclass
class Tally:
    """What was tried, and what came of it."""

    runs: int = 0
    outcomes: Counter[str] = field(default_factory=Counter)
    violations: int = 0
    examples: list[str] = field(default_factory=list)
    slowest_s: float = 0.0
    growth_mb: float = 0.0

    def violation(self, text: str) -> None:
        self.violations += 1
        if len(self.examples) < MOST_EXAMPLES:
            self.examples.append(text[:600])

    def took(self, seconds: float, what: str) -> None:
        self.slowest_s = max(self.slowest_s, seconds)
        if seconds > HANG_S:
            self.violation(f"{seconds:.2f} s for {what}")

    def figures(self) -> dict[str, Any]:
        return {
            "runs": self.runs,
            "outcomes": dict(self.outcomes.most_common()),
            "slowest_s": round(self.slowest_s, 3),
            "growth_mb": round(self.growth_mb, 1),
            "violations": self.violations,
        }


class Memory:
    """How much more a process takes than at its mark."""

    def __init__(self, pid: int | None = None) -> None:
        self._path = Path(f"/proc/{pid or 'self'}/statm")
        self._mark_mb = 0.0
        self.marked = False

    def mark(self) -> None:
        self._mark_mb, self.marked = self._now_mb(), True

    def judge(self, tally: Tally) -> None:
        if self.marked:
            tally.growth_mb = self._now_mb() - self._mark_mb
            if tally.growth_mb > GROWTH_BOUND_MB:
                tally.violation(f"memory grew by {tally.growth_mb:.0f} MB (bound {GROWTH_BOUND_MB:.0f})")

    def _now_mb(self) -> float:
        return int(self._path.read_text(encoding="ascii").split()[1]) * os.sysconf("SC_PAGE_SIZE") / 1e6
