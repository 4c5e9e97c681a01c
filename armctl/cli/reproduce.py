"""`armctl reproduce`: the papers recomputed."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from armctl.cli.output import Output, command
from armctl.cli.tables import show_table

if TYPE_CHECKING:
    from armctl.papers.comparison import PaperReport
    from armctl.papers.entries import Entry


@command("reproduce")
def reproduce_command(output: Output, paper: str, out: Path | None, quick: bool, seed: int) -> int:
    """Recompute every table and figure of the five papers beside print, and judge every entry of every equation.

    Exit status 1 if the verdict on an entry is not proven by numbers. Needs the extra `papers`.

    Example: armctl reproduce all --out reproduction
    """
    from armctl.papers import entries as judged
    from armctl.papers import page as report
    from armctl.papers.comparison import FULL, QUICK
    from armctl.papers.run import PAPERS
    from armctl.recording.disk import writing

    papers = tuple(PAPERS) if paper == "all" else (paper,)
    page = None if out is None else out / "reproduce.html"
    if page is not None:
        with writing(page):  # rather now than after the work
            page.parent.mkdir(parents=True, exist_ok=True)
    reports = [PAPERS[one](QUICK if quick else FULL, seed, output.progress) for one in papers]
    found = judged.entries(papers)
    wrong = judged.errata(found)
    if page is not None:
        report.write(reports, found, page)
    told = ("paper", "equation", "row", "column", "printed", "true", "verdict", "place")
    result: dict[str, Any] = {
        "rows": [{"paper": made.paper, **row._asdict()} for made in reports for row in made.rows],
        "errata": [{key: getattr(one, key) for key in ("paper", "where", "printed", "true", "proof")} for one in wrong],
        "entries": [{key: getattr(one, key) for key in told} for one in found],
        "page": None if page is None else str(page),
        "seed": seed,
    }
    output.answer(result, lambda: show(output, reports, found, page))
    return 0 if all(entry.proven for entry in found) else 1


def show(output: Output, reports: list[PaperReport], found: list[Entry], page: Path | None) -> None:
    from armctl.papers.entries import counted, errata
    from armctl.papers.page import ERRATA, QUANTITIES, quantities

    for report in reports:
        title = f"{report.paper}: {report.title}"
        show_table(output.console, title, QUANTITIES, quantities(report), words=("quantity", "printed", "verdict"))
        output.say("")
    wrong = errata(found)
    words = [(f"{one.paper} {where}", *others) for one in wrong for where, *others in (one.told,)]
    title = f"{len(wrong)} errata, {sum(one.proven for one in wrong)} of them proven"
    show_table(output.console, title, ERRATA, words, words=ERRATA)
    for paper, said in counted(found).items():
        output.say(f"{paper}: {said}")
    output.say(f"page: {page}" if page is not None else "--out DIR writes a page with the tables and pictures")
