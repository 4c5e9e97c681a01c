"""The page that compares the papers with their recomputation: what is printed, what is found, what is wrong.

A `PaperReport` is data: rows of numbers with a verdict, tables, and pictures that are drawn only when a page is made.
"""

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from armctl.kinematics.errata import Erratum
from armctl.kinematics.transform import FloatArray
from armctl.report.page import Figure, Page, curve


@dataclass(frozen=True)
class Row:
    """One quantity of a paper beside armctl's."""

    quantity: str
    # None: the paper gives no number.
    printed: float | str | None
    armctl: float | str
    unit: str
    # "equal", "better", "misprint" or "differs: why".
    verdict: str


@dataclass(frozen=True)
class Table:
    """A table of a paper, recomputed."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


@dataclass(frozen=True)
class Picture:
    """A figure of a paper, redrawn when asked for."""

    title: str
    description: str
    draw: Callable[[], Figure]


def pictures(
    names: Iterable[str], title: str, description: str, draw: Callable[..., Figure], *of: Any
) -> list[Picture]:
    """One picture for each name: the name fills in title and description, and is what `draw` draws of `of`."""
    return [Picture(title.format(name), description.format(name), partial(draw, *of, name)) for name in names]


def by_generation(figure: Figure, name: str, colour: str, best: FloatArray, mean: FloatArray) -> None:
    """Add the best and the mean of a genetic algorithm's population, one value a generation from the first on."""
    for values, which, dash in ((best, "best", "solid"), (mean, "mean", "dot")):
        curve(figure, np.arange(1, len(values) + 1), values, name.format(which), colour, dash=dash)


@dataclass(frozen=True)
class PaperReport:
    """Everything about one paper."""

    paper: str
    title: str
    notes: tuple[str, ...]
    rows: tuple[Row, ...]
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


def write(reports: Sequence[PaperReport], errata: Sequence[Erratum], path: Path) -> None:
    """Write the page."""
    page = Page("Five papers, recomputed")
    page.text(
        "Each quantity that a paper prints is shown beside the one computed here. Equal: the same to the printed "
        "digits. Better: an error that is smaller here. Misprint: the print contradicts itself or the model of the "
        "paper; the proof is below. Differs: none of these; the reason is given."
    )
    for report in reports:
        page.heading(f"{report.paper}: {report.title}")
        page.text(*report.notes)
        page.table(
            ("quantity", "printed", "armctl", "unit", "verdict"),
            [(row.quantity, shown(row.printed), shown(row.armctl), row.unit, row.verdict) for row in report.rows],
            words=True,
        )
        for picture in report.pictures:
            page.heading(f"{report.paper}, {picture.title}")
            page.figure(picture.draw(), picture.description)
        for table in report.tables:
            page.heading(f"{report.paper}, {table.title}")
            page.table(table.header, table.rows, table.caption)
    page.heading("Errata")
    page.text(
        f"{len(errata)} statements of these papers do not hold. Each is proven by a computation that a test repeats."
    )
    page.table(
        ("paper", "where", "printed", "true", "proof"),
        [(one.paper, one.where, one.printed, one.true, one.proof) for one in errata],
        words=True,
    )
    page.write(path)


def shown(value: float | str | None) -> str:
    """A number as a person reads it."""
    return value if isinstance(value, str) else "-" if value is None else f"{value:.6g}"
