"""The case that the tests of studies begin with."""

from typing import Any

from armctl.lab.study.case import Case
from tests.genetic import hand


def case(**changes: Any) -> Case:
    """A short line on one arm, nothing corrected."""
    line = {"from_m": (0.18, -0.1, 0.10), "to_m": (0.18, 0.1, 0.10), "via": (2, "stream"), "duration_s": 3.0}
    return Case(**{"arm": hand.arm(), "seed": 1, **line, **changes})
