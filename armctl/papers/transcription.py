"""What the papers print and how it is read: one YAML file a paper, in `printed/`.

A file holds the paper's title, notes on how it is read, every table that is compared with its place in the paper, and
the errata (`errata.py` has their proofs, or the robot that they are about). Cells stay the text that is printed: the
last digit tells the rounding.
"""

from decimal import Decimal
from functools import cache
from importlib import resources

import numpy as np
from pydantic import Field

from armctl.config import Frozen, parse_yaml, validate
from armctl.kinematics.transform import FloatArray


class PrintedTable(Frozen):
    """The numbers of a table, a figure or a sentence."""

    # Such as "Table II" or "Fig. 7".
    place: str
    unit: str
    columns: tuple[str, ...] = Field((), strict=False)
    # A line a row, blanks between the cells.
    cells: str

    @property
    def rows(self) -> list[list[str]]:
        return [line.split() for line in self.cells.splitlines()]

    @property
    def numbers(self) -> FloatArray:
        return np.array(self.rows, dtype=np.float64)

    @property
    def rounding(self) -> FloatArray:
        """Half a unit of each cell's last digit."""
        return np.array([[0.5 * 10.0 ** int(Decimal(cell).as_tuple().exponent) for cell in row] for row in self.rows])

    @property
    def by_column(self) -> dict[str, float]:
        """Of a table of one row."""
        return dict(zip(self.columns, self.numbers[0].tolist(), strict=True))


class PrintedError(Frozen):
    """The words of an `Erratum`."""

    # The name of its proof in `PROOFS` of a robot; empty: `errata.py` has it, by paper and place.
    proof: str = ""
    where: str
    printed: str
    corrected: str
    how: str


class Transcription(Frozen):
    """One paper."""

    title: str
    notes: tuple[str, ...] = Field(strict=False)
    tables: dict[str, PrintedTable] = Field({})
    errata: tuple[PrintedError, ...] = Field((), strict=False)


@cache
def transcription(paper: str) -> Transcription:
    """What is transcribed of a paper, "000" to "004"."""
    file = f"printed/{paper}.yaml"
    text = resources.files("armctl.papers").joinpath(file).read_text(encoding="utf-8")
    return validate(Transcription, parse_yaml(text, file), file)


def introduced(paper: str, **values: object) -> tuple[str, str, tuple[str, ...]]:
    """A paper's number, its title, and its notes with the values that they tell."""
    of = transcription(paper)
    return paper, of.title, tuple(note.format(**values) for note in of.notes)
