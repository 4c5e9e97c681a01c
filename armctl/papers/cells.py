"""What the cells of the papers' tables should be, where that can be computed: from the other tables, or by a robot."""

from collections.abc import Callable

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.papers import FIG_5_DEG, INITIAL_DEG, QZ_DEG
from armctl.kinematics.transform import FloatArray
from armctl.papers.paper_000 import HEIGHT_CM, RADIUS_CM, population_formula
from armctl.papers.transcription import Transcription

# By table: what is true, and how uncertain that is because it is computed from rounded cells; shapes as the table's.
TrueCells = dict[str, tuple[FloatArray, FloatArray | float]]


def _grid(printed: Transcription) -> TrueCells:
    """Each of the six tables from one of the others and the targets; Fig. 7 by its formula."""
    true: TrueCells = {"joint_1_population": (population_formula(), 0.0)}
    for axis, target in (("xy0", RADIUS_CM), ("z0", np.full_like(RADIUS_CM, HEIGHT_CM))):
        measured, away = (printed.tables[name] for name in (f"{axis}_test", f"delta_{axis}"))
        true[f"{axis}_test"] = target + away.numbers, away.rounding
        true[f"delta_{axis}"] = measured.numbers - target, measured.rounding
        true[f"p_{axis}"] = away.numbers / target, away.rounding / target
    return true


def _lanzhou(_printed: Transcription) -> TrueCells:
    robot = robots.get("lanzhou-4dof")
    place_mm = tool_position(robot.chain, np.radians(FIG_5_DEG)) * 1e3
    return {"ikine": (np.radians([QZ_DEG]), 0.0), "fig_5": (np.round(place_mm[None, [0, 2]], 9) + 0.0, 0.0)}


def _transfer(_printed: Transcription) -> TrueCells:
    """By the text the arm is in its initial position at t = 0 of Fig. 3."""
    place_mm = tool_position(robots.get("transfer-6dof").chain, np.radians(INITIAL_DEG)) * 1e3
    return {"fig_3": (np.round(place_mm[None], 9) + 0.0, 0.0)}


# By paper; tables that are not named hold measurements, what was chosen, or motions that print does not give.
TRUE_CELLS: dict[str, Callable[[Transcription], TrueCells]] = {"000": _grid, "003": _lanzhou, "004": _transfer}
