"""Every entry that a paper prints, beside what it should be, with a verdict.

Of an equation's entry the verdict is symbolic: print against the derivation. Then both are put to numbers, at random
configurations: the derivation has to agree with what `measurements.py` finds there, and a misprint has not to. Of a
table's cell, and of words, the verdict is a difference beyond rounding.
"""

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from armctl.papers.derivations import derived
from armctl.papers.measurements import MEASURED, TRUE_CELLS
from armctl.papers.notation import read, same, show, some_value, sympy
from armctl.papers.statements import PROOFS
from armctl.papers.transcription import Transcription, transcription

EQUAL, MISPRINT, NOT_READABLE = "equal", "misprint", "not readable"
NOT_DERIVED = "differs: print gives nothing to compute it from"
CONFIGURATIONS = 8
# A misprint is off by more than this, what is true by less.
PRINT_OFF, TRUE_OFF = 1e-3, 1e-9


class Entry(NamedTuple):
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
    count = sorted(Counter((entry.paper, entry.verdict) for entry in found).items())
    papers = dict.fromkeys(entry.paper for entry in found)
    return {paper: ", ".join(f"{n} {verdict}" for (of, verdict), n in count if of == paper) for paper in papers}


@dataclass(eq=False)
class _Formula:
    """An entry of an equation on its way to a verdict."""

    number: str
    row: int
    column: int
    printed: str
    # An expression; None: it is not derived, or words.
    read: Any
    # An expression, words, or None.
    derived: Any
    off: tuple[float, float] | None = None


def entries(papers: Sequence[str]) -> list[Entry]:
    """Every entry of some papers ("000" to "004"), in their order."""
    return [entry for paper in sorted(papers) for entry in of_paper(paper, transcription(paper))]


def of_paper(paper: str, printed: Transcription) -> list[Entry]:
    """Every entry of one paper, as it is transcribed."""
    return [*_equations(paper, printed), *_tables(paper, printed), *_statements(paper, printed)]


def _equations(paper: str, printed: Transcription) -> Iterator[Entry]:
    formulas = list(_formulas(paper, printed))
    _measure(paper, formulas)
    for one in formulas:
        of = printed.equations[one.number]
        # The rows of a table stand on a line each.
        place = f"line {of.line + (one.row - 1 if of.columns else 0)}"
        verdict, true = _judged(one, small=paper in ("003", "004"))
        # What no number says is not proven.
        off = (0.0, 0.0) if verdict == MISPRINT and one.off is None else one.off
        yield Entry(paper, one.number, one.row, one.column, one.printed, true, verdict, place, off=off)


def _formulas(paper: str, printed: Transcription) -> Iterator[_Formula]:
    known = derived(paper)
    for number, equation in printed.equations.items():
        for r, row in enumerate(equation.rows):
            for c, text in enumerate(row):
                true = known[number][r][c] if number in known and not text.startswith("?") else None
                place = number, r + 1, c + 1, text
                words = true is None or isinstance(true, str)
                yield _Formula(*place, None, true) if words else _Formula(*place, read(text), sympy.sympify(true))


def _measure(paper: str, formulas: list[_Formula]) -> None:
    """How far print and derivation are off, at most, at several configurations."""
    computed = [one for one in formulas if one.read is not None]
    pairs = [expression for one in computed for expression in (one.read, one.derived)]
    names = sorted({name for pair in pairs for name in pair.free_symbols}, key=str)
    value_of = sympy.lambdify([names], pairs, "numpy")
    for seed in range(CONFIGURATIONS):
        values, cells = MEASURED[paper](np.random.default_rng(seed))
        # A name that the derivation does not know has some value too.
        given = [values.get(str(name), some_value(str(name))) for name in names]
        with np.errstate(all="ignore"):
            numbers = iter(value_of(given))
        for one in formulas:
            pair = (next(numbers), next(numbers)) if one.read is not None else (one.printed, one.derived)
            measured = cells[one.number][one.row - 1][one.column - 1] if one.number in cells else None
            if measured is not None and one.derived is not None:
                gaps = [measured(value) if callable(measured) else abs(value - measured) for value in pair]
                print_, true = np.maximum(np.nan_to_num(gaps, nan=np.inf), one.off or 0.0).tolist()
                one.off = print_, true


def _judged(one: _Formula, *, small: bool) -> tuple[str, str | None]:
    """The verdict, and what is true."""
    if one.printed.startswith("?"):
        return NOT_READABLE, None
    if one.derived is None:
        return NOT_DERIVED, None
    if one.read is None:
        return (EQUAL if one.printed == one.derived else MISPRINT), one.derived
    if one.read.is_Number and one.derived.is_Number and "." in one.printed:
        holds = abs(float(one.read - one.derived)) <= 0.5 * 10.0 ** -len(one.printed.split(".")[1])
    else:
        holds = one.read is not sympy.nan and same(one.read, one.derived)
    return (EQUAL, one.printed) if holds else (MISPRINT, show(one.derived, small=small))


def _tables(paper: str, printed: Transcription) -> Iterator[Entry]:
    known = TRUE_CELLS[paper](printed) if paper in TRUE_CELLS else {}
    for name, table in printed.tables.items():
        true, slack = known.get(name, (np.full_like(table.numbers, np.nan), 0.0))
        bound = (table.rounding + slack) * (1.0 + 1e-9)
        gap = np.abs(table.numbers - true)
        for r, c in np.ndindex(true.shape):
            place = paper, table.place, r + 1, c + 1, table.rows[r][c]
            line = f"line {table.line + r}"
            if np.isnan(true[r, c]):
                yield Entry(*place, None, NOT_DERIVED, line)
                continue
            how = f"computed: print is off by {gap[r, c]:.2g}, rounding by {bound[r, c]:.2g} at most"
            yield Entry(*place, f"{true[r, c]:.7g}", EQUAL if gap[r, c] <= bound[r, c] else MISPRINT, line, how)


def _statements(paper: str, printed: Transcription) -> Iterator[Entry]:
    for name, of in printed.statements.items():
        off = PROOFS[name]()
        verdict = MISPRINT if off[0] > PRINT_OFF else EQUAL
        yield Entry(paper, of.where, None, None, of.printed, of.corrected, verdict, f"line {of.line}", of.how, off)
