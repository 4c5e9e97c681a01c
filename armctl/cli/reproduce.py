"""`armctl reproduce`: the papers recomputed."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from rich.box import SIMPLE_HEAD
from rich.table import Table

from armctl.cli.output import Output, output_option

if TYPE_CHECKING:
    from armctl.kinematics.errata import Erratum
    from armctl.report.reproduce import PaperReport

PAPERS = ("000", "001", "002", "003", "004")


@click.command("reproduce")
@click.argument("paper", type=click.Choice((*PAPERS, "all")))
@click.option("--out", type=click.Path(file_okay=False, path_type=Path), help="Folder for the page, reproduce.html.")
@click.option("--quick", is_flag=True, help="Fewer seeds, poses and runs: a look instead of the figures.")
@click.option("--seed", type=click.IntRange(0, 2**31), default=0, show_default=True, help="Repeats a run.")
@output_option
def reproduce_command(output: Output, paper: str, out: Path | None, quick: bool, seed: int) -> int:
    """Recompute every table and figure of the five papers beside print, and prove what print has wrong.

    Exit status 1 if an erratum is not proven.

    Example: armctl reproduce all --out reproduction
    """
    from armctl.report import reproduce as report
    from armctl.reproduce.errata import errata
    from armctl.reproduce.run import reproduce
    from armctl.reproduce.verdict import FULL, QUICK

    papers = PAPERS if paper == "all" else (paper,)
    if out is not None:
        from armctl.report.page import plotly

        plotly()  # refuse now rather than after minutes
    reports = reproduce(papers, QUICK if quick else FULL, seed, output.progress)
    wrong = errata(papers)
    page = None
    if out is not None:
        out.mkdir(parents=True, exist_ok=True)
        page = out / "reproduce.html"
        report.write(reports, wrong, page)
    result: dict[str, Any] = {
        "rows": [asdict(row) for one in reports for row in one.rows],
        "errata": [
            {
                "paper": one.paper,
                "where": one.where,
                "printed": one.printed,
                "true": one.true,
                "proof": one.proof,
            }
            for one in wrong
        ],
        "page": None if page is None else str(page),
        "seed": seed,
    }
    if not output.result(result):
        _show(output, reports, wrong, page)
    return 0 if all(one.proven for one in wrong) else 1


def _show(output: Output, reports: list[PaperReport], wrong: list[Erratum], page: Path | None) -> None:
    from armctl.report.reproduce import shown

    for report in reports:
        table = Table(title=f"{report.paper}: {report.title}", title_justify="left", box=SIMPLE_HEAD, pad_edge=False)
        for column in ("quantity", "printed", "armctl", "unit", "verdict"):
            table.add_column(column, justify="right" if column in ("printed", "armctl") else "left", overflow="fold")
        for row in report.rows:
            table.add_row(row.quantity, shown(row.printed), shown(row.armctl), row.unit, row.verdict)
        output.console.print(table)
    output.say(f"{len(wrong)} errata, {sum(one.proven for one in wrong)} of them proven:")
    for one in wrong:
        output.say(f"  {one.paper} {one.where}: {one.printed} -> {one.true} ({one.proof})")
    output.say(f"page: {page}" if page is not None else "--out DIR writes a page with the tables and pictures")
