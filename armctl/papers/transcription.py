"""What the papers print and how it is read: one YAML file a paper, in `printed/`.

A file holds the paper's title, notes on how it is read, every numbered equation and every table, cell by cell, and the
statements that are put to a proof (`statements.py`). Cells stay the text that is printed: the last digit tells the
rounding. The papers are at hand as scanned text without page marks: a place is a line of that text.
"""

from decimal import Decimal
from functools import cache
from importlib import resources
from typing import Any, ClassVar

import numpy as np
from pydantic import Field

from armctl.config import Frozen, parse_yaml, validate
from armctl.kinematics.transform import FloatArray


class PrintedEquation(Frozen):
    """Formulas in the paper's notation (`notation.py`)."""

    line: int
    # Of a table: what its columns are called.
    columns: tuple[str, ...] = Field((), strict=False)
    # A line a row, `|` between the cells; "?" begins a cell that is not readable, what the scan shows follows.
    cells: str

    between: ClassVar[str | None] = "|"

    @property
    def rows(self) -> list[list[str]]:
        return [[cell.strip() for cell in line.split(self.between)] for line in self.cells.splitlines()]


class PrintedTable(PrintedEquation):
    """The numbers of a table, a figure or a sentence; blanks between the cells."""

    # Such as "Table II" or "Fig. 7".
    place: str
    unit: str
    between = None

    @property
    def numbers(self) -> FloatArray:
        return np.array([[float(cell.replace(",", "")) for cell in row] for row in self.rows])

    @property
    def rounding(self) -> FloatArray:
        """Half a unit of each cell's last digit."""
        decimals = [[Decimal(cell.replace(",", "")) for cell in row] for row in self.rows]
        return np.array([[0.5 * 10.0 ** int(cell.as_tuple().exponent) for cell in row] for row in decimals])


class Quote(Frozen):
    """Words of a paper that a row of its page is compared with."""

    line: int
    text: str


class PrintedStatement(Frozen):
    """Words of a paper that a proof is about."""

    line: int
    where: str
    printed: str
    corrected: str
    how: str


class Transcription(Frozen):
    """One paper."""

    title: str
    notes: tuple[str, ...] = Field(strict=False)
    tables: dict[str, PrintedTable] = Field({})
    equations: dict[str, PrintedEquation] = Field({})
    quotes: dict[str, Quote] = Field({})
    # By the names of their proofs in `statements.py`.
    statements: dict[str, PrintedStatement] = Field({})


@cache
def transcription(paper: str) -> Transcription:
    """What is transcribed of a paper, "000" to "004"."""
    file = f"printed/{paper}.yaml"
    return validate(Transcription, written(file), file)


def written(file: str) -> Any:
    """What stands in a YAML file of this package."""
    return parse_yaml(resources.files("armctl.papers").joinpath(file).read_text(encoding="utf-8"), file)


def said(paper: str, quote: str) -> str:
    """Words of a paper, by their name among its quotes."""
    return transcription(paper).quotes[quote].text


def introduced(paper: str, **values: object) -> tuple[str, str, tuple[str, ...]]:
    """A paper's number, its title, and its notes with the values that they tell."""
    of = transcription(paper)
    return paper, of.title, tuple(note.format(**values) for note in of.notes)
