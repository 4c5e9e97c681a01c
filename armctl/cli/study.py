"""`armctl study`: the command line of every study, from `study.toml`: its options, and what a person is told.

What a study does stands in a second table by the same names, `armctl/lab/study/studies.py`; the columns that are shown
stand in `tables.yaml`.
"""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, NamedTuple

import click

from armctl.cli.output import CONFIG, Output
from armctl.cli.output import command as answering
from armctl.cli.parameters import tables
from armctl.cli.tables import Row, show_rows
from armctl.errors import ConfigError, LogError
from armctl.files import read_text

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config
    from armctl.lab.study.case import Case


class Command(NamedTuple):
    """A row of the table."""

    help: str
    # Of the table for people, filled in from its first row and the number of arms `drawn`.
    title: str
    # Options that say which cases there are.
    varied: Sequence[str] = ()
    # The option that names a file to write.
    file: str | None = None
    # What of the result the table shows.
    table: str = "rows"
    # A sentence below the table about every row that has, or has not, a value at a key.
    note: str = ""
    noted: str = ""
    noted_if: bool = True


COMMANDS = {name: Command(**about) for name, about in tables("study")["studies"].items()}


@click.group("study")
def study_command() -> None:
    """The same work many times over: settings, durations, arms drawn at random.

    Work is shared among this machine's processors; with --scheduler a Dask cluster does it, whose workers must have
    armctl installed. A seed repeats the figures, whoever works.

    Example: armctl study ga --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10
    """


def _add(name: str, command: Command) -> None:
    def callback(output: Output, **asked: Any) -> None:
        run(name, command, output, asked)

    answering(name, CONFIG, group=study_command, help=command.help)(callback)


for _name, _of in COMMANDS.items():
    _add(_name, _of)


def run(name: str, command: Command, output: Output, asked: dict[str, Any]) -> None:
    """Do one study and show it."""
    from armctl.lab.line_experiment import guided_takes, named_takes
    from armctl.lab.study.case import all_rows
    from armctl.lab.study.studies import STUDIES
    from armctl.lab.study.workers import Workers

    config, arm = output.config, output.arm
    study, case = STUDIES[name], _case(name, command, asked, arm, config)
    cases = study.vary(case, **{key: asked[key] for key in command.varied})  # refuses bad settings before any work
    workers = Workers(output.progress, asked["workers"] or len(os.sched_getaffinity(0)), asked["scheduler"])
    if "recordings" in asked:
        takes = named_takes(config, arm, asked["recordings"])
        takes = takes or guided_takes(case.rig(), case.line, case.seed, output.progress)
        cases = [replace(case, takes=tuple(takes)) for case in cases]
    path = asked.get(str(command.file))
    if command.file == "xlsx" and path is not None and path.exists():  # rather now than after the work
        raise LogError(f"{path}: exists already; choose another name, nothing is overwritten")
    found = workers.carry_out(study.label, study.run, cases)
    rows = study.told(all_rows(found), cases, workers)
    result = {"rows": rows} if study.summary is None else {"rows": rows, "summary": study.summary(rows)}
    told: dict[str, Any] = {**result, "seed": asked["seed"]}
    if command.file is not None:
        told[command.file] = None if path is None else str(path)
        if path is not None and study.write is not None:
            study.write(path, cases, found, rows, workers)
    output.answer(told, lambda: show(output, name, result))


def _case(name: str, command: Command, asked: dict[str, Any], arm: ArmConfig, config: Config) -> Case:
    """The case that every other one is made from."""
    from armctl.genetic.algorithm import PROFILES
    from armctl.lab.study.case import Case
    from armctl.trajectory.plan import plan_from_text

    given = {each.name: asked[each.name] for each in fields(Case) if asked.get(each.name) is not None}
    given["period_s"] = asked.get("period_s") or config.period_s
    if "plan" in given:
        plan = given["plan"] = plan_from_text(read_text(asked["plan"], "plan"), str(asked["plan"]))
        given |= {"from_m": plan.from_m, "to_m": plan.to_m, "duration_s": plan.duration_s}
    elif "from_m" not in given or "to_m" not in given:
        raise ConfigError(f"armctl study {name}", "--from/--to", "no line", "give both ends, or a plan")
    if "profile" in asked:
        given["settings"] = replace(PROFILES[asked["profile"]], generations=asked["generations"])
    return Case(arm=arm, **given)


def show(output: Output, name: str, result: Mapping[str, Sequence[Row]]) -> None:
    """The table of a study's result, and the sentences below it."""
    command = COMMANDS[name]
    rows = result[command.table]
    title = command.title.format_map({**rows[0], "drawn": len({row.get("arm") for row in result["rows"]})})
    show_rows(output.console, f"study {name}", title, rows)
    for row in result["rows"] if command.note else ():
        if bool(row[command.noted]) is command.noted_if:
            output.say(command.note.format_map(row))
