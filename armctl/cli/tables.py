"""Tables that fit the terminal, 80 columns wide where there is none.

Rules.
1. A figure is never cut off nor broken over lines; a pair of figures is, where nothing else helps.
2. Words are wrapped between words; a word is broken only if it alone is too long for the line.
3. Columns move together before anything is wrapped that need not be.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from rich.console import Console

Row = Mapping[str, Any]
# What stands in the tables that are made from rows of data, by their names.
TABLES = Path(__file__).with_name("tables.yaml")
# Characters between two columns, the first that fits is taken.
GAPS = (3, 2, 1)


def show_table(
    console: Console, title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[str] = ()
) -> None:
    """Print a table.

    Args:
        columns: Headings from the left.
        rows: A cell a column; markup in it is plain text.
        words: Headings of the columns whose cells are words, set from the left; in the others stand figures.
    """
    from rich.box import SIMPLE_HEAD
    from rich.table import Table
    from rich.text import Text

    cells = [[column, *(row[i] for row in rows)] for i, column in enumerate(columns)]
    gap, found = layout(cells, [column in words for column in columns], console.width)
    shown = Table(
        title=Text(title) if title else None,
        title_justify="left",
        box=SIMPLE_HEAD,
        show_edge=False,
        pad_edge=False,
        padding=(0, int(gap > 1)),
        collapse_padding=gap == 2,
    )
    for column, width in zip(columns, found, strict=True):
        shown.add_column(Text(column), justify="left" if column in words else "right", overflow="fold", width=width)
    for row in rows:
        shown.add_row(*map(Text, row))
    console.print(shown)


def show_rows(console: Console, table: str, title: str, rows: Iterable[Row]) -> None:
    """Print one of `tables.yaml` with a line for each row of data."""
    import yaml

    about = yaml.safe_load(TABLES.read_text(encoding="utf-8"))[table]
    cells = [[_filled(row, *cell) for _, *cell in about["columns"]] for row in rows]
    show_table(console, title, [heading for heading, *_ in about["columns"]], cells, about.get("words", ()))


def _filled(row: Row, template: str, needed: str | None = None, otherwise: str = "-") -> str:
    """The text of one cell; `needed` names what the row must hold for it."""
    if needed is not None and (row.get(needed) is None or row[needed] is False):
        return otherwise
    return template.format_map(row)


def layout(cells: Sequence[Sequence[str]], worded: Sequence[bool], total: int) -> tuple[int, list[int]]:
    """Gap between columns, and characters of each column.

    Args:
        cells: What stands in each column, heading included.
        worded: Which columns are words.
        total: Characters of a line.
    """
    wanted = [max(map(len, column)) for column in cells]
    words = [max((len(word) for cell in column for word in cell.split()), default=0) for column in cells]
    least = [word if may_wrap else want for word, may_wrap, want in zip(words, worded, wanted, strict=True)]
    for gap in GAPS:
        left = total - gap * (len(cells) - 1) - sum(least)
        if left >= 0:
            return gap, _spread(least, wanted, left)
    left += sum(least) - sum(words)
    if left < 0:  # a very long word gives way
        longest = words.index(max(words))
        words[longest] = max(1, words[longest] + left)
    return gap, _spread(words, wanted, max(0, left))


def _spread(least: Sequence[int], wanted: Sequence[int], left: int) -> list[int]:
    """What is left of the line goes to the columns that want more, each in its proportion."""
    more = [max(0, want - need) for want, need in zip(wanted, least, strict=True)]
    share = min(1.0, left / max(1, sum(more)))
    return [need + int(share * extra) for need, extra in zip(least, more, strict=True)]
