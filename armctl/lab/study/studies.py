"""The table of studies: what varies, how a case is run, what its rows come to, and the file that shows it.

A study is the same work over many cases. All of them begin with one case, which the command line describes.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

from armctl.lab import table_ii
from armctl.lab.study import arms, ga, limits, pareto
from armctl.lab.study.case import Case, Found, Row
from armctl.lab.study.workers import Workers
from armctl.report import pareto as fronts

Rows = Sequence[Row]
Cases = Sequence[Case]


class Study(NamedTuple):
    """A row of the table."""

    # What the work is called while it is done.
    label: str
    # Every case, from the one that is asked for and the values that are to be tried.
    vary: Callable[..., list[Case]]
    # One case; a plain function, so that any process may call it.
    run: Callable[[Case], Found]
    # The rows that are told, from those of all cases.
    told: Callable[[Rows, Cases, Workers], Rows] = lambda rows, _cases, _workers: rows
    # A few rows over all of those.
    summary: Callable[[Rows], Rows] | None = None
    # Writes the study's file, from the cases, what they gave, and the rows that are told.
    write: Callable[[Path, Cases, Sequence[Found], Rows, Workers], None] | None = None


def _fronts(path: Path, _cases: Cases, _found: Sequence[Found], rows: Rows, _workers: Workers) -> None:
    fronts.write(rows, path)


# By the name of its command.
STUDIES = {
    "ga": Study("evolving", ga.every_setting, ga.run, ga.over_seeds),
    "arms": Study("arms", arms.every_arm, arms.run, summary=arms.summary),
    "pareto": Study("optimising", pareto.every_duration, pareto.run, pareto.judged, write=_fronts),
    "limits": Study(
        "one effect off at a time", limits.every_effect, limits.run, limits.with_shares, write=limits.write
    ),
    "paper": Study("experiments", table_ii.every_experiment, table_ii.run, write=table_ii.write),
}
