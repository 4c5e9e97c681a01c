"""What the commands of `armctl study` share: options, the work handed out, and takes."""

from __future__ import annotations

import os
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeVar

import click

from armctl.cli.output import POINT, Output, config_option, output_option
from armctl.errors import ConfigError

if TYPE_CHECKING:
    from armctl.config import ArmConfig, Config
    from armctl.kinematics.transform import FloatArray

F = TypeVar("F", bound=Callable[..., Any])
A = TypeVar("A")
R = TypeVar("R")
Point = tuple[float, float, float]
TAKES = 5
PAGE = click.Path(dir_okay=False, path_type=Path)


def line_options(function: F) -> F:
    function = click.option("--to", "to_m", type=POINT, required=True, help="End of the line, metres.")(function)
    return click.option("--from", "from_m", type=POINT, required=True, help="Start of the line, metres.")(function)


def work_options(function: F) -> F:
    options = (
        click.option("--seed", type=click.IntRange(0, 2**31), default=0, show_default=True, help="Repeats a study."),
        click.option("--workers", type=click.IntRange(1, 1024), help="Processes.  [default: one a processor]"),
        click.option("--scheduler", metavar="ADDRESS", help="A Dask scheduler that does the work: tcp://host:8786."),
        config_option,
        output_option,
    )
    for option in reversed(options):
        function = option(function)
    return function


def gathered(
    output: Output, label: str, work: Callable[[A], R], cases: Sequence[A], workers: int | None, scheduler: str | None
) -> list[R]:
    """Outcomes of the work on every case, in their order, with progress shown."""
    from armctl.lab.study.workers import carry_out

    count = workers or len(os.sched_getaffinity(0))
    with output.progress(label, len(cases)) as show:
        return carry_out(
            work,
            cases,
            workers=count,
            scheduler=scheduler,
            tell=lambda done: show(done, f"{done} of {len(cases)}"),
        )


def candidates(
    output: Output, config: Config, arm: ArmConfig, names: Sequence[str], from_m: Point, to_m: Point, seed: int
) -> tuple[FloatArray, ...]:
    """The named recordings; without names, takes of the simulated hand."""
    import numpy as np

    from armctl.files import data_dir
    from armctl.host.jobs import load_takes
    from armctl.lab.rig import VirtualRig
    from armctl.recording import recordings
    from armctl.sim.arm import SimulatedArm
    from armctl.sim.spec import RANDOM_SPEC

    if names:
        folder = data_dir(config) / "recordings"
        paths = [Path(name) if "/" in name else recordings.find(folder, name) for name in names]
        return tuple(take.positions_rad for take in load_takes(arm, paths))
    rig = VirtualRig(SimulatedArm(arm, seed=seed, spec=RANDOM_SPEC), config.period_s)
    takes = []
    with output.progress("guiding by hand", TAKES) as show:
        for take in range(TAKES):
            takes.append(rig.teach(np.array(from_m), np.array(to_m), seed * 1000 + take))
            show(take + 1, "")
    return tuple(takes)


def whole_numbers(name: str, values: Sequence[float]) -> list[int]:
    if any(value != int(value) for value in values):
        raise ConfigError("armctl study ga", name, f"{list(values)} are not whole numbers")
    return [int(value) for value in values]
