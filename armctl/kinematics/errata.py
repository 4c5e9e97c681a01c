"""What a paper prints wrong, each with a computation that tells print and truth apart.

A proof stands beside the thing it is about: of a robot in its `PROOFS`, under the name that the statement has in
`papers/printed/`. Its `residuals` compute the same quantity independently (a matrix product, a distance, a count) and
return how far print is off and how far the correction is off, both in the quantity's own unit: print must be off by
more than `PRINT_OFF`, the correction by less than `TRUE_OFF`.
"""

from collections.abc import Callable
from dataclasses import dataclass

PRINT_OFF = 1e-3
TRUE_OFF = 1e-9

# How far print and the correction are from what is computed.
Residuals = Callable[[], tuple[float, float]]


@dataclass(frozen=True)
class Erratum:
    """One statement of a paper that does not hold."""

    # Number of the paper: 000 to 004.
    paper: str
    where: str
    printed: str
    true: str
    # What is computed to prove it.
    how: str
    residuals: Residuals

    @property
    def proven(self) -> bool:
        """Whether print fails and the correction holds."""
        printed, true = self.residuals()
        return printed > PRINT_OFF and true < TRUE_OFF

    @property
    def proof(self) -> str:
        """The computation and its outcome, in words."""
        printed, true = self.residuals()
        return f"{self.how}: print is off by {printed:.4g}, the correction by {true:.1e}"


def off(computed: float, printed: float, corrected: float) -> tuple[float, float]:
    """The residuals where all three are one number."""
    return abs(printed - computed), abs(corrected - computed)
