"""One entry of a paper with its verdict; errata are the entries that are misprints."""

from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

EQUAL, MISPRINT, NOT_READABLE = "equal", "misprint", "not readable"
# A misprint is off by more than this, what is true by less.
PRINT_OFF, TRUE_OFF = 1e-3, 1e-9


@dataclass(frozen=True)
class Entry:
    """An entry of an equation, a cell of a table, or a statement."""

    paper: str
    # Its number, or the place of the table or of the words.
    equation: str
    # From 1 on; None: a statement.
    row: int | None
    column: int | None
    printed: str
    # None: it cannot be told.
    true: str | None
    verdict: str
    # Where it stands in the scanned text, which has no page marks.
    place: str
    # What is computed to prove it.
    how: str = "print against the symbolic derivation, both at random configurations"
    # How far print and the correction are from what is computed; None: nothing is.
    off: tuple[float, float] | None = None

    @property
    def where(self) -> str:
        """Its place among the errata."""
        number = f"eq. {self.equation}" if self.equation.startswith("(") else self.equation
        return number if self.row is None else f"{number}, row {self.row}, column {self.column}"

    @property
    def proven(self) -> bool:
        """Whether numbers say what the verdict says."""
        if self.off is None:
            return True
        printed, true = self.off
        return true < TRUE_OFF and (printed > PRINT_OFF) == (self.verdict == MISPRINT)

    @property
    def proof(self) -> str:
        """The computation and its outcome, in words."""
        if self.off is None:
            return self.how
        printed, true = self.off
        return f"{self.how}: print is off by {printed:.4g}, the correction by {true:.1e}"

    @property
    def told(self) -> tuple[str, ...]:
        """As an erratum: where, what is printed, what is true, and the proof."""
        return self.where, self.printed, str(self.true), self.proof


def errata(found: Sequence[Entry]) -> list[Entry]:
    """The entries that do not hold."""
    return [entry for entry in found if entry.verdict == MISPRINT]


def counted(found: Sequence[Entry]) -> dict[str, str]:
    """By paper how many entries have which verdict, in words."""
    count: defaultdict[str, Counter[str]] = defaultdict(Counter)
    for entry in found:
        count[entry.paper][entry.verdict] += 1
    return {paper: ", ".join(f"{n} {verdict}" for verdict, n in sorted(of.items())) for paper, of in count.items()}
