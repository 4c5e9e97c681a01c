"""000: grasping by a genetic algorithm (`xiang-6dof`): the grid with its six tables, the two targets, Figs. 7 to 12."""

from collections.abc import Iterable
from dataclasses import replace
from functools import partial
from itertools import product
from typing import get_args

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.genetic import plain
from armctl.kinematics.genetic.problem import Evolution, behind_the_waist, points_problem
from armctl.kinematics.inverse import refine_poses
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, IntArray
from armctl.lab.stage import Stage
from armctl.papers.comparison import Effort, PaperReport, Picture, Row, Table, claim, error, pictures, unprinted
from armctl.papers.transcription import introduced, said, transcription
from armctl.report import kinematics as drawn
from armctl.report.page import Figure, axes

SIDE_CM = np.arange(21.0, 31.0)
HEIGHT_CM = 10.0
# Of each target from the base's axis, shape (10, 10).
RADIUS_CM = np.hypot(SIDE_CM[:, None], SIDE_CM)
TARGETS_CM = ((20.0, 25.0, 30.0), (30.0, 25.0, 20.0))
STATISTICS = ("mean |dxy|", "greatest |dxy|", "mean |dz|", "greatest |dz|")
REACHED_M = 1e-9
# What the text leaves open: whether theta1 is searched or given by eq. (12), how parents are chosen, whether the best
# goes on as it is. Waist given, settings of the algorithm, by name.
READINGS = {
    f"{'three angles' if waist else 'four angles'}, {selection}, {'one elite' if elite else 'no elite'}": (
        waist,
        replace(plain.PAPER, selection=selection, elite=elite),
    )
    for waist, selection, elite in product((False, True), get_args(plain.Selection), (0, 1))
}
AS_PRINTED = "four angles, roulette, no elite"
# The text does not say what 0.01 is a share of: of all bits above, here of the individuals, a bit each.
PER_INDIVIDUAL = replace(plain.PAPER, mutation_probability=0.01 / (4 * plain.PAPER.bits))
READINGS[f"{AS_PRINTED}, mutation of 0.01 an individual"] = (False, PER_INDIVIDUAL)
# Rows and columns of Fig. 7.
POPULATION_SHOWN = (14, 10)
# What its cells are, of row r and column c.
POPULATION_WORDS = "45 + atan2(2 - 4r/13, 1 + 4c/13) / 2 deg"


def printed(table: str) -> FloatArray:
    """A table by its name in the transcription: one of the six, shape (10, 10), Fig. 7's population [deg], (14, 10)."""
    return transcription("000").tables[table].numbers


def grid_m() -> FloatArray:
    """The hundred targets [m], shape (100, 3); rows of the tables are x, columns y."""
    x, y = np.meshgrid(SIDE_CM, SIDE_CM, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_CM)], axis=1) / 100.0


def grid_errors_cm(points_m: FloatArray, rows: IntArray | slice = slice(None)) -> FloatArray:
    """What the grid's tables say of tool points [m], shape (m, 3): differences of radius and of height, (2, m).

    Args:
        rows: Which of the hundred targets the points are for.
    """
    targets = grid_m()[rows]
    radius = np.hypot(points_m[:, 0], points_m[:, 1]) - np.hypot(targets[:, 0], targets[:, 1])
    return np.stack([radius, points_m[:, 2] - targets[:, 2]]) * 100.0


def statistics(errors_cm: FloatArray) -> FloatArray:
    """Mean and greatest |dxy|, mean and greatest |dz| [cm]."""
    away = np.abs(errors_cm)
    return np.stack([away.mean(axis=1), away.max(axis=1)], axis=1).ravel()


def printed_statistics(rows: IntArray | slice = slice(None)) -> FloatArray:
    """Of the errors that are printed of some targets: mean and greatest |dxy|, mean and greatest |dz| [cm]."""
    return statistics(np.stack([printed(name).ravel()[rows] for name in ("delta_xy0", "delta_z0")]))


def population_formula() -> FloatArray:
    """What Fig. 7 holds instead of random numbers [deg]: half the angle of a regular grid of points, about 45 deg."""
    rows, columns = (np.arange(count) for count in POPULATION_SHOWN)
    y, x = 2.0 - 4.0 * rows[:, None] / 13.0, 1.0 + 4.0 * columns / 13.0
    return np.asarray(45.0 + 0.5 * np.degrees(np.arctan2(y, x)))


def evolve(
    robot: Robot, seed: int, targets: FloatArray, *, waist_given: bool = False, settings: plain.Settings = plain.PAPER
) -> Evolution:
    """The published algorithm on targets [m], shape (k, 3)."""
    problem = points_problem(robot.chain, targets, robot.limits_rad)
    problem = behind_the_waist(problem) if waist_given else problem
    return plain.evolve(problem, settings, [[seed, target] for target in range(len(targets))])


def polished(robot: Robot, targets: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Configurations moved onto the targets [m], shape (k, 3), as far as possible, and the distance left [m]."""
    T = points_problem(robot.chain, targets, robot.limits_rad).T
    q = refine_poses(robot.chain, T, q, robot.limits_rad, turned=False, iterations=400)
    return q, np.linalg.norm(tool_position(robot.chain, q) - targets, axis=1)


def out_of_reach(robot: Robot) -> dict[tuple[float, float], tuple[float, FloatArray]]:
    """Targets of the grid (x, y) [cm] that the arm cannot reach: least distance [m] and nearest tool point [m]."""
    assert robot.closed_form is not None
    found = {}
    for target in grid_m():
        q, distance = robot.closed_form.nearest_position(target)
        if distance > 0.0:
            x, y, _ = np.round(target * 100.0, 9).tolist()
            found[x, y] = distance, tool_position(robot.chain, q[0])
    return found


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    robot = robots.get("xiang-6dof")
    rows = np.arange(0, len(grid_m()), effort.grid_step)
    found = {}
    with stage("000: readings of the text", len(READINGS)) as show:
        for done, (name, (waist_given, settings)) in enumerate(READINGS.items(), start=1):
            seeds = range(seed, seed + effort.grid_seeds)
            runs = [evolve(robot, one, grid_m()[rows], waist_given=waist_given, settings=settings) for one in seeds]
            reached = [tool_position(robot.chain, run.q_rad) for run in runs]
            found[name] = np.array([statistics(grid_errors_cm(points, rows)) for points in reached])
            show(done, name)
    with stage("000: the grid and two targets", 1):
        first, targets = evolve(robot, seed, grid_m()), np.array(TARGETS_CM) / 100.0
        two, calmer = (evolve(robot, seed, targets, settings=share) for share in (plain.PAPER, PER_INDIVIDUAL))
        two_q, two_missed = polished(robot, targets, two.q_rad)
    exact_q, missed = polished(robot, grid_m(), first.q_rad)
    agree = int((np.abs(printed("joint_1_population") - population_formula()) <= 0.6e-4).sum())
    return PaperReport(
        *introduced("000"),
        (
            *_grid_rows(found, rows),
            *_polish_rows(robot, exact_q, missed),
            *_target_rows(robot, targets, two, two_missed),
            claim(f"Fig. 7, cells equal to {POPULATION_WORDS}, of 140", said("000", "random"), str(agree), agree < 70),
            *_curve_rows(first, calmer),
        ),
        (
            _readings_table(found, rows),
            *_run_tables(grid_errors_cm(tool_position(robot.chain, first.q_rad))),
            _angles_table(robot, two.q_rad, two_q),
        ),
        tuple(_pictures(robot, (two, calmer), two_q)),
    )


def _statistics_rows(name: str, found: FloatArray, why: str, rows: IntArray | slice = slice(None)) -> list[Row]:
    pairs = zip(STATISTICS, printed_statistics(rows).tolist(), found.tolist(), strict=True)
    return [error(f"{which}{name}", before, after, "cm", why=why) for which, before, after in pairs]


def _grid_rows(found: dict[str, FloatArray], rows: IntArray) -> list[Row]:
    """The algorithm as printed, and the reading whose mean errors come nearest to print."""
    means, wanted = {name: values.mean(axis=0) for name, values in found.items()}, printed_statistics(rows)
    why = "four angles are searched; see the readings of the text"
    told = _statistics_rows(f" of the printed cells, {AS_PRINTED}", means[AS_PRINTED], why, rows)
    nearest = min(means, key=lambda name: float(np.abs(np.log(means[name] / wanted)).sum()))
    return [*told, unprinted("reading whose four statistics come nearest to print", nearest)]


def _polish_rows(robot: Robot, q: FloatArray, missed: FloatArray) -> list[Row]:
    found = statistics(grid_errors_cm(tool_position(robot.chain, q)))
    rows = _statistics_rows(", GA with polish", found, "not polished")
    rows.append(unprinted("targets of the grid reached to 1e-9 m, of 100", str((missed <= REACHED_M).sum())))
    for (x, y), (distance, near) in out_of_reach(robot).items():
        i, j = int(x - SIDE_CM[0]), int(y - SIDE_CM[0])
        least = abs(float(np.hypot(near[0], near[1])) * 100.0 - float(np.hypot(x, y)))
        quantity = f"|dxy| at ({x:.0f}, {y:.0f}, 10), out of reach by exactly {distance * 100.0:.9f} cm"
        rows.append(error(quantity, abs(float(printed("delta_xy0")[i, j])), least, "cm", why="the least there is"))
    return rows


def _target_rows(robot: Robot, targets: FloatArray, two: Evolution, missed: FloatArray) -> list[Row]:
    rows = []
    away_cm = np.linalg.norm(tool_position(robot.chain, two.q_rad) - targets, axis=1) * 100.0
    worst = float(np.abs(printed("delta_xy0")).max())
    for k, quote in enumerate(("first_target", "second_target")):
        in_print, name, away, exact = said("000", quote), f"target {_name(k)}: distance", float(away_cm[k]), missed[k]
        why = f"differs: {away:.2f} cm in this run"
        rows.append(claim(f"{name}, GA alone", in_print, away, away <= worst, unit="cm", why=why))
        holds, why = bool(exact < REACHED_M), "differs: not reached"
        rows.append(claim(f"{name}, with polish", in_print, float(exact) * 100.0, holds, unit="cm", why=why))
    return rows


def _curve_rows(run: Evolution, calmer: Evolution) -> list[Row]:
    """Fig. 8: the mean of the fitness beside the best after 200 generations, by what 0.01 is a share of."""
    at = min(200, len(run.best_cost)) - 1
    a_bit, an_individual = (float(np.sqrt(one.best_cost[at] / one.mean_cost[at]).mean()) for one in (run, calmer))
    why = "differs: with 0.01 a bit about half of all individuals have a flipped bit in every generation"
    name = "least / mean distance after 200 generations (Fig. 8)"
    return [
        claim(name, said("000", "coincident"), a_bit, a_bit > 0.9, why=why),
        unprinted(f"{name}, mutation of 0.01 an individual", an_individual),
    ]


def _run_tables(errors_cm: FloatArray) -> list[Table]:
    """The two tables of differences of one run, shape (2, 100), beside those that are transcribed."""
    columns = ("x \\ y", *(f"{y:.0f}" for y in SIDE_CM))
    tables = []
    for name, values in zip(("delta xy0", "delta z0"), errors_cm.reshape(2, *RADIUS_CM.shape), strict=True):
        rows = [(f"{x:.0f}", *(f"{value:z.3f}" for value in row)) for x, row in zip(SIDE_CM, values, strict=True)]
        tables.append(Table(f"{name} of one run", columns, tuple(rows), "cm; GA over theta1 to theta4, as printed"))
    return tables


def _readings_table(found: dict[str, FloatArray], rows: IntArray) -> Table:
    """What each reading of the text gives, statistics of shape (seeds, 4), beside print."""
    wanted = printed_statistics(rows)
    lines = [("print", *(f"{value:.3f}" for value in wanted), "")]
    for name, values in found.items():
        low, high = values.min(axis=0), values.max(axis=0)
        within = int(((wanted >= low) & (wanted <= high)).sum())
        lines.append((name, *(f"{value:.3f}" for value in values.mean(axis=0)), f"{within} of 4"))
    seeds = len(next(iter(found.values())))
    note = f"cm; means of {seeds} seeds over {len(rows)} targets; print within: statistics of print among the seeds'"
    return Table("readings of the text", ("reading", *STATISTICS, "print within"), tuple(lines), note)


def _angles_table(robot: Robot, *found: FloatArray) -> Table:
    """Fig. 10: the angles found for both targets, shape (2, n), put through forward kinematics."""
    lines = []
    for who, q in zip(("GA", "GA with polish"), found, strict=True):
        cells = np.column_stack([np.degrees(q), tool_position(robot.chain, q) * 100.0])
        lines += [(f"{_name(k)}, {who}", *(f"{value:z.3f}" for value in row)) for k, row in enumerate(cells)]
    header = ("target", *(f"theta{joint}" for joint in range(1, robot.chain.n + 1)), "x", "y", "z")
    return Table("Fig. 10: angles found", header, tuple(lines), "deg; cm by forward kinematics")


def _name(k: int) -> str:
    return "({:.0f}, {:.0f}, {:.0f})".format(*TARGETS_CM[k])


def _curves(runs: Iterable[Evolution], k: int) -> Figure:
    """Best and mean distance from one target in both readings of the mutation."""
    figure = axes("generation", "distance [cm]", drawn.HEIGHT)
    for run, share, colour in zip(runs, ("a bit", "an individual"), drawn.COLOURS[::2], strict=False):
        costs = (np.sqrt(cost[:, k]) * 100.0 for cost in (run.best_cost, run.mean_cost))
        drawn.by_generation(figure, f"{{}}, mutation of 0.01 {share}", colour, *costs)
    return figure


def _pictures(robot: Robot, runs: tuple[Evolution, Evolution], polished_q: FloatArray) -> list[Picture]:
    fitness = "fitness: best and mean error by generation"
    arms = [{"found by the GA": q, "with polish": exact} for q, exact in zip(runs[0].q_rad, polished_q, strict=True)]
    draw = partial(drawn.arm, unit="cm")
    changed = f"Fig. 12: target {_name(1)}"
    return [
        Picture(f"Fig. 8: {fitness}", f"target {_name(0)}", partial(_curves, runs, 0)),
        *pictures(drawn.ARM_VIEWS, f"Fig. 11: the arm at {_name(0)}", "{}", draw, robot.chain, arms[0]),
        Picture(changed, fitness, partial(_curves, runs, 1)),
        Picture(changed, "the arm", partial(draw, robot.chain, arms[1])),
    ]
