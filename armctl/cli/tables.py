"""Tables that fit the terminal, 80 columns wide where there is none.

Rules.
1. A figure is never cut off nor broken over lines; a pair of figures is, where nothing else helps.
2. Words are wrapped between words; a word is broken only if it alone is too long for the line.
3. Columns move together before anything is wrapped that need not be.
"""

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from itertools import chain, zip_longest
from pathlib import Path
from textwrap import wrap
from typing import Any, cast

from armctl.cli.screen import Screen

Row = Mapping[str, Any]
# What stands in the tables that are made from rows of data, by their names.
TABLES = Path(__file__).with_name("tables.yaml")
# What a picture tells of a joint, by the heading: the quantity, what it is multiplied by, and digits.
QUANTITIES = {
    "deg": ("position_rad", math.degrees(1.0), 1),
    "goal": ("goal_rad", math.degrees(1.0), 1),
    "deg/s": ("velocity_rad_s", math.degrees(1.0), 0),
    "load %": ("load_ratio", 100.0, 0),
    "V": ("voltage_V", 1.0, 1),
    "degC": ("temperature_degC", 1.0, 0),
}
# Characters between two columns, the first that fits is taken.
GAPS = (3, 2, 1)


def show_table(
    screen: Screen, title: str, columns: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[str] = ()
) -> None:
    """Print a table, see `table_lines`."""
    screen.print(*screen.wrapped(title, italic=True), *table_lines(screen, columns, rows, words))


def table_lines(
    screen: Screen, columns: Sequence[str], rows: Sequence[Sequence[str]], words: Collection[str] = (), width: int = 0
) -> list[str]:
    """The lines of a table.

    Args:
        columns: Headings from the left.
        rows: A cell a column; what would steer the terminal is a blank.
        words: Headings of the columns whose cells are words, set from the left; in the others stand figures.
        width: Characters of a line; 0: the screen's.
    """
    cells = [[column, *(_plain(row[i]) for row in rows)] for i, column in enumerate(columns)]
    worded = [column in words for column in columns]
    gap, widths = layout(cells, worded, width or screen.width)
    line = (" " * gap).join(f"{{:{'<' if word else '>'}{width}}}" for word, width in zip(worded, widths, strict=True))
    heading, *lines = (_lines(row, widths, line) for row in zip(*cells, strict=True))
    rule = "─" * (sum(widths) + gap * (len(widths) - 1))
    return [*(screen.styled(part, bold=True) for part in heading), rule, *chain.from_iterable(lines)]


def _plain(cell: str) -> str:
    return cell if cell.isprintable() else "".join(c if c.isprintable() else " " for c in cell)


def _lines(row: Sequence[str], widths: Sequence[int], line: str) -> list[str]:
    """One row; a cell that does not fit goes on below itself.

    Args:
        line: The format of a line.
    """
    if all(len(cell) <= width for cell, width in zip(row, widths, strict=True)):
        return [line.format(*row).rstrip()]
    parts = (wrap(cell, width, break_on_hyphens=False) for cell, width in zip(row, widths, strict=True))
    return [line.format(*cells).rstrip() for cells in zip_longest(*parts, fillvalue="")]


def show_rows(screen: Screen, table: str, title: str, rows: Iterable[Row]) -> None:
    """Print one of `tables.yaml` with a line for each row of data."""
    about = _table(table)
    cells = [[_filled(row, *cell) for _, *cell in about["columns"]] for row in rows]
    show_table(screen, title, [heading for heading, *_ in about["columns"]], cells, about.get("words", ()))


def below(table: str, told: Row) -> str:
    """What is to be said below one of `tables.yaml`."""
    return str(_table(table)["below"].format_map(told))


def _table(name: str) -> dict[str, Any]:
    import yaml

    loader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)  # where it is compiled it takes a tenth of the time
    return cast(dict[str, Any], yaml.load(TABLES.read_bytes(), loader)[name])


def _filled(row: Row, template: str, needed: str | None = None, otherwise: str = "-") -> str:
    """The text of one cell; `needed` names what the row must hold for it."""
    if needed is not None and (row.get(needed) is None or row[needed] is False):
        return otherwise
    return template.format_map(row)


def joint_cells(read: Row, headings: Iterable[str]) -> list[str]:
    """What is told of a joint below some headings of `QUANTITIES`."""
    quantities = (QUANTITIES[heading] for heading in headings)
    return [number(read[name], factor, digits) for name, factor, digits in quantities]


def number(value: float | None, factor: float, digits: int) -> str:
    """A number as a picture shows it; a dash where it is not known."""
    return "-" if value is None or math.isnan(value) else f"{value * factor:.{digits}f}"


def layout(cells: Sequence[Sequence[str]], worded: Sequence[bool], total: int) -> tuple[int, list[int]]:
    """Gap between columns, and characters of each column.

    Args:
        cells: What stands in each column, heading included.
        worded: Which columns are words.
        total: Characters of a line.
    """
    widths = [max(map(len, column)) for column in cells]
    words = [max((len(word) for cell in column for word in cell.split()), default=0) for column in cells]
    least = [word if may_wrap else width for word, may_wrap, width in zip(words, worded, widths, strict=True)]
    gaps = {gap: total - gap * (len(cells) - 1) for gap in GAPS}
    if sum(widths) <= gaps[GAPS[0]]:
        return GAPS[0], widths
    gap, room = next(((gap, room) for gap, room in gaps.items() if sum(least) <= room), (GAPS[-1], gaps[GAPS[-1]]))
    for floor in (least, words, [1] * len(cells)):  # what has to give way, in this order; the widest does first
        while sum(widths) > room and (wide := [i for i, width in enumerate(widths) if width > floor[i]]):
            widths[max(wide, key=widths.__getitem__)] -= 1
    return gap, widths
