"""Rows with their verdict: how a number of print compares with one computed."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass

from armctl.papers.page import Row

Progress = Callable[[float, str], None]
Stage = Callable[[str, float], AbstractContextManager[Progress]]
"""Begins a stage of so many steps; what it yields is told how many are done."""


@dataclass(frozen=True)
class Effort:
    """How much is computed."""

    grid_seeds: int
    """Runs of the genetic algorithm over the grid of 000."""
    pose_seeds: int
    """Runs on the pose of 001."""
    random_poses: int
    """Poses put through inverse kinematics."""
    samples: int
    """Points of a workspace."""
    rounds: int
    """Corrections of the straight line."""
    repeats: int
    """Runs of each straight-line plan."""


FULL = Effort(grid_seeds=10, pose_seeds=50, random_poses=1000, samples=20_000, rounds=5, repeats=3)
QUICK = Effort(grid_seeds=2, pose_seeds=8, random_poses=50, samples=2000, rounds=0, repeats=1)


def same(
    paper: str, quantity: str, printed: float, armctl: float, unit: str, *, digits: float, why: str = "misprint"
) -> Row:
    """Equal if within half a unit of the last printed digit (`digits`), else `why`."""
    return Row(paper, quantity, printed, armctl, unit, "equal" if abs(printed - armctl) <= 0.5 * digits else why)


def error(paper: str, quantity: str, printed: float, armctl: float, unit: str, *, why: str) -> Row:
    """An error, of which less is better; `why` says what a greater one comes from."""
    verdict = "better" if armctl < printed else "equal" if armctl == printed else f"differs: {why}"
    return Row(paper, quantity, printed, armctl, unit, verdict)


def claim(paper: str, quantity: str, printed: str, armctl: float | str, unit: str, holds: bool, why: str) -> Row:
    """A statement in words that holds or does not."""
    return Row(paper, quantity, printed, armctl, unit, "equal" if holds else why)
