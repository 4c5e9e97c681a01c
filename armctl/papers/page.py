"""The page that compares the papers with their recomputation: what is printed, what is found, what is wrong."""

from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from armctl.papers.comparison import PaperReport
from armctl.papers.entries import MISPRINT, NOT_READABLE, Entry, counted, errata
from armctl.papers.transcription import transcription
from armctl.report.page import TEXTS, Marked, Page

QUANTITIES = ("quantity", "printed", "armctl", "verdict")
ERRATA = ("where", "printed", "true", "proof")
# Looks of the verdicts, by their first word.
KINDS = {"equal": "equal", "misprint": "misprint", "differs": "differs", "not": "unread"}


def quantities(report: PaperReport) -> list[tuple[str, ...]]:
    """The rows of a report as a table for people, under `QUANTITIES`."""
    named = [f"{row.quantity} [{row.unit}]" if row.unit else row.quantity for row in report.rows]
    shown = [(_shown(row.printed), _shown(row.armctl), row.verdict) for row in report.rows]
    return [(name, *cells) for name, cells in zip(named, shown, strict=True)]


def write(reports: Sequence[PaperReport], found: Sequence[Entry], path: Path) -> None:
    """Write the page: of every paper its quantities, figures and tables, and every entry that it prints."""
    page = Page("Five papers, recomputed")
    page.text(TEXTS["papers"], *(f"{paper}: {words}." for paper, words in counted(found).items()))
    for report in reports:
        page.chapter(f"{report.paper}: {report.title}")
        page.text(*report.notes)
        page.heading(f"{report.paper}, quantities")
        rows = [(*cells, _marked(verdict, verdict)) for *cells, verdict in quantities(report)]
        page.table(QUANTITIES, rows, words=True)
        for title, views in groupby(report.pictures, key=lambda one: one.title):
            page.heading(f"{report.paper}, {title}")
            page.figures((view.draw(), view.description) for view in views)
        for table in report.tables:
            page.heading(f"{report.paper}, {table.title}")
            page.table(table.header, table.rows, table.caption)
        _write_entries(page, report.paper, [entry for entry in found if entry.paper == report.paper])
    page.write(path)


def _write_entries(page: Page, paper: str, found: Sequence[Entry]) -> None:
    """What is wrong in a paper, and below it each equation and table as it is laid out in print."""
    wrong, print_ = errata(found), transcription(paper)
    columns = {**print_.equations, **{table.place: table for table in print_.tables.values()}}
    page.heading(f"{paper}, errata: {len(wrong)}")
    if wrong:
        page.table(ERRATA, [one.told for one in wrong], words=True)
    for equation, of in groupby((one for one in found if one.row is not None), key=lambda one: one.equation):
        rows = [list(row) for _, row in groupby(of, key=lambda one: one.row)]
        page.heading(f"{paper}, {equation}")
        verdicts = counted([one for row in rows for one in row])[paper]
        header = columns[equation].columns or tuple(map(str, range(1, max(map(len, rows)) + 1)))
        cells = [tuple(_marked(_cell(one), one.verdict) for one in row) for row in rows]
        page.table(header, cells, f"{verdicts}; from {rows[0][0].place} of the scanned text", words=True)


def _cell(entry: Entry) -> str:
    """What is printed; of what is not readable, what the scan shows."""
    if entry.verdict == MISPRINT:
        return f"{entry.printed} (misprint: {entry.true})"
    return f"{entry.printed[1:]} (not readable)".strip() if entry.verdict == NOT_READABLE else entry.printed


def _marked(text: str, verdict: str) -> Marked:
    """Text in the colour of a verdict."""
    return Marked(text, KINDS[verdict.split(":")[0].split(" ")[0]])


def _shown(value: float | str | None) -> str:
    """A number as a person reads it."""
    return value if isinstance(value, str) else "-" if value is None else f"{value:.6g}"
