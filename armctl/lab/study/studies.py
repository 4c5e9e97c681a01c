"""The table of studies: what varies, how a case is run, what its rows come to, and the file that shows it.

A study is the same work over many cases. All of them begin with one case, which the command line describes.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from armctl.lab import table_ii
from armctl.lab.study import arms, ga, limits, pareto
from armctl.lab.study.case import Case, Found, Row, all_rows
from armctl.lab.study.workers import Workers
from armctl.report import pareto as fronts_page

Result = dict[str, list[Row]]
Cases = Sequence[Case]


@dataclass(frozen=True)
class Study:
    """A row of the table."""

    # What the work is called while it is done.
    label: str
    # Every case, from the one that is asked for and the values that are to be tried.
    vary: Callable[..., list[Case]]
    # One case; a plain function, so that any process may call it.
    run: Callable[[Case], Found]
    # The rows that are told, from all cases and what they gave.
    result: Callable[[Cases, Sequence[Found], Workers], Result]
    # Writes the study's file, from the cases, what they gave, and the rows.
    write: Callable[[Path, Cases, Sequence[Found], Sequence[Row], Workers], None] | None = None


# By the name of its command.
STUDIES = {
    "ga": Study(
        "evolving",
        ga.every_setting,
        ga.run,
        lambda cases, found, _workers: {"rows": ga.over_seeds(all_rows(found), cases[0].repeats)},
    ),
    "arms": Study(
        "arms",
        arms.every_arm,
        arms.run,
        lambda _cases, found, _workers: {"rows": all_rows(found), "summary": arms.summary(all_rows(found))},
    ),
    "pareto": Study(
        "optimising",
        pareto.every_duration,
        pareto.run,
        lambda cases, found, workers: {"rows": pareto.judged(cases, found, workers)},
        lambda path, _cases, _found, rows, _workers: fronts_page.write(rows, path),
    ),
    "limits": Study(
        "one effect off at a time",
        limits.every_effect,
        limits.run,
        lambda _cases, found, _workers: {"rows": limits.with_shares(all_rows(found))},
        limits.write,
    ),
    "paper": Study(
        "experiments",
        table_ii.every_experiment,
        table_ii.run,
        lambda _cases, found, _workers: {"rows": all_rows(found)},
        lambda path, cases, found, _rows, _workers: table_ii.write_angles(path, cases[0].arm.joint_names, found),
    ),
}
