"""`armctl study`: settings of the genetic algorithm, durations, simulated arms; here or on a Dask cluster."""

from __future__ import annotations

import click

from armctl.cli.study.arms import arms_command
from armctl.cli.study.ga import ga_command
from armctl.cli.study.limits import limits_command
from armctl.cli.study.paper import paper_command
from armctl.cli.study.pareto import pareto_command


@click.group("study")
def study_command() -> None:
    """The same work many times over: settings, durations, arms drawn at random.

    Work is shared among this machine's processors; with --scheduler a Dask cluster does it, whose workers must have
    armctl installed. A seed repeats the figures, whoever works.

    Example: armctl study ga --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10
    """


for _command in (ga_command, arms_command, pareto_command, limits_command, paper_command):
    study_command.add_command(_command)
