"""What recomputing a paper gives: rows of numbers with a verdict, tables, pictures; and a check that several need.

A `PaperReport` is data; its pictures are drawn only when a page is made.
"""

from collections.abc import Callable, Iterable
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from armctl.kinematics.chain import forward_kinematics
from armctl.kinematics.inverse import pose_errors
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.report.page import Figure


class Row(NamedTuple):
    """One quantity of a paper beside armctl's."""

    quantity: str
    # None: the paper gives no number.
    printed: float | str | None
    armctl: float | str
    unit: str
    # "equal", "misprint", "differs: why" or "not printed".
    verdict: str


class Table(NamedTuple):
    """A table of a paper, recomputed."""

    title: str
    header: tuple[str, ...]
    rows: tuple[tuple[str, ...], ...]
    caption: str = ""


class Picture(NamedTuple):
    """A figure of a paper, redrawn when asked for; those with one title in a row are its parts, side by side."""

    title: str
    description: str
    draw: Callable[[], Figure]


def pictures(names: Iterable[str], title: str, words: str, draw: Callable[..., Figure], *of: Any) -> list[Picture]:
    """One picture for each name: the name fills in title and words, and is what `draw` draws of `of`."""
    return [Picture(title.format(name), words.format(name), partial(draw, *of, name)) for name in names]


class PaperReport(NamedTuple):
    """Everything about one paper."""

    paper: str
    title: str
    notes: tuple[str, ...]
    rows: tuple[Row, ...]
    tables: tuple[Table, ...] = ()
    pictures: tuple[Picture, ...] = ()


class Effort(NamedTuple):
    """How much is computed."""

    # Runs of the genetic algorithm over the grid of 000 in each reading, and every which target of the grid.
    grid_seeds: int
    grid_step: int
    # Runs on the pose of 001.
    pose_seeds: int
    # Poses put through inverse kinematics.
    random_poses: int
    # Simulated arms that make the experiments of 002.
    arms: int
    # Points of a workspace.
    samples: int


SMALLER = "differs: less of it here"

FULL = Effort(grid_seeds=5, grid_step=1, pose_seeds=50, random_poses=1000, arms=12, samples=20_000)
QUICK = Effort(grid_seeds=1, grid_step=25, pose_seeds=3, random_poses=20, arms=1, samples=2000)


def error(quantity: str, printed: float, armctl: float, unit: str, *, why: str) -> Row:
    """An error, of which less is better; `why` says what a greater one comes from."""
    verdict = SMALLER if armctl < printed else "equal" if armctl == printed else f"differs: {why}"
    return Row(quantity, printed, armctl, unit, verdict)


def claim(what: str, printed: str, armctl: float | str, holds: bool, *, unit: str = "", why: str = "misprint") -> Row:
    """A statement in a paper's words: equal if it holds, else `why` it does not."""
    return Row(what, printed, armctl, unit, "equal" if holds else why)


def unprinted(quantity: str, armctl: float | str, unit: str = "") -> Row:
    """What the paper has no word and no number of: it is shown, and not scored."""
    return Row(quantity, None, armctl, unit, "not printed")


def through_closed_form(robot: Robot, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """The poses of configurations [rad], shape (m, n), through closed inverse kinematics and back.

    Returns:
        Every branch [rad], shape (m, branches, n), and how far it misses its pose [m or rad, the greater], shape
        (m, branches). A branch that does not exist holds the configuration itself, and misses by infinity.
    """
    assert robot.closed_form is not None
    T = forward_kinematics(robot.chain, q)
    branches = robot.closed_form.poses(T)
    exists = np.asarray(np.isfinite(branches).all(axis=-1))
    shown = np.where(exists[..., None], branches, q[:, None])
    missed = np.maximum(*pose_errors(robot.chain, shown, np.broadcast_to(T[:, None], (*shown.shape[:2], 4, 4))))
    return shown, np.where(exists, missed, np.inf)
