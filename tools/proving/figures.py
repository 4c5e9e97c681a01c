"""What every benchmark answers with: rows of figures side by side, and checks of them against a bound."""

from collections.abc import Sequence
from typing import Any

Row = dict[str, Any]


def row(work: str, who: str, value: float, unit: str, ratio: float) -> Row:
    """One figure of one of those compared; `ratio` is to what the benchmark says it is to."""
    return {"work": work, "who": who, "value": value, "unit": unit, "ratio": ratio}


def check(name: str, value: float, bound: float, *, least: bool = False) -> Row:
    """Whether a figure is at most its bound, or at least."""
    return {"name": name, "value": value, "bound": bound, "ok": value >= bound if least else value <= bound}


def violated(table: Sequence[dict[str, Any]], done: Sequence[dict[str, Any]]) -> list[str]:
    """Rows that are beyond their bounds, and what was broken in each trial."""
    beyond = [
        f"{row['what']}: median {row['median_mm']}, 95 % {row['share_mm']} mm, bound {row['bound']}"
        for row in table
        if not row["held"]
    ]
    return beyond + [f"arm {one['seed']}, {text}" for one in done for text in one["broken"]]
