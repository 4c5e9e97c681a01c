"""000: grasping by a genetic algorithm (`xiang-6dof`): the grid with its six tables, the two targets, Figs. 7 to 12."""

from functools import partial
from itertools import product

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.annulus import PlaneReach
from armctl.kinematics.chain import tool_position
from armctl.kinematics.genetic import plain
from armctl.kinematics.genetic.problem import Evolution, behind_the_waist, points_problem
from armctl.kinematics.inverse import refine_poses
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.lab.stage import Stage
from armctl.papers.page import PaperReport, Picture, Row, Table, by_generation, pictures
from armctl.papers.transcription import introduced, transcription
from armctl.papers.verdict import Effort, claim, error
from armctl.report import kinematics as drawn
from armctl.report.page import Figure, axes

SIDE_CM = np.arange(21.0, 31.0)
HEIGHT_CM = 10.0
# Of each target from the base's axis, shape (10, 10).
RADIUS_CM = np.hypot(SIDE_CM[:, None], SIDE_CM)
TARGETS_CM = ((20.0, 25.0, 30.0), (30.0, 25.0, 20.0))
TABLES = ("xy0_test", "z0_test", "delta_xy0", "delta_z0", "p_xy0", "p_z0")
STATISTICS = ("mean |dxy|", "greatest |dxy|", "mean |dz|", "greatest |dz|")
REACHED_M = 1e-9
# Rows and columns of Fig. 7.
POPULATION_SHOWN = (14, 10)
# What its cells are, of row r and column c.
POPULATION_WORDS = "45 + atan2(2 - 4r/13, 1 + 4c/13) / 2 deg"


def printed() -> dict[str, FloatArray]:
    """The tables as printed: six of shape (10, 10) and Fig. 7's population [deg], (14, 10)."""
    return {name: table.numbers for name, table in transcription("000").tables.items()}


def grid_m() -> FloatArray:
    """The hundred targets [m], shape (100, 3); rows of the tables are x, columns y."""
    x, y = np.meshgrid(SIDE_CM, SIDE_CM, indexing="ij")
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, HEIGHT_CM)], axis=1) / 100.0


def grid_errors_cm(points_m: FloatArray) -> FloatArray:
    """What the grid's tables say of tool points [m], shape (100, 3): differences of radius and of height, (2, 100)."""
    targets = grid_m()
    radius = np.hypot(points_m[:, 0], points_m[:, 1]) - np.hypot(targets[:, 0], targets[:, 1])
    return np.stack([radius, points_m[:, 2] - targets[:, 2]]) * 100.0


def statistics(errors_cm: FloatArray) -> FloatArray:
    """Mean and greatest |dxy|, mean and greatest |dz| [cm]."""
    away = np.abs(errors_cm)
    return np.stack([away.mean(axis=1), away.max(axis=1)], axis=1).ravel()


def printed_statistics() -> FloatArray:
    """Of the errors that are printed: mean and greatest |dxy|, mean and greatest |dz| [cm]."""
    return statistics(np.stack([printed()["delta_xy0"].ravel(), printed()["delta_z0"].ravel()]))


def consistent_cells() -> int:
    """How many of the 600 printed cells agree with the others and the targets within their rounding."""
    table, half = printed(), {name: one.rounding for name, one in transcription("000").tables.items()}
    agree = 0
    for axis, target in (("xy0", RADIUS_CM), ("z0", HEIGHT_CM)):
        measured, away, share = f"{axis}_test", f"delta_{axis}", f"p_{axis}"
        gap, bound = table[measured] - target - table[away], half[measured] + half[away]
        # A cell of a measured table agrees where its difference does.
        agree += 2 * int((np.abs(gap) <= bound * (1.0 + 1e-9)).sum())
        gap, bound = table[away] / target - table[share], half[share] + half[away] / target
        agree += int((np.abs(gap) <= bound * (1.0 + 1e-9)).sum())
    return agree


def population_formula() -> FloatArray:
    """What Fig. 7 holds instead of random numbers [deg]: half the angle of a regular grid of points, about 45 deg."""
    rows, columns = (np.arange(count) for count in POPULATION_SHOWN)
    y, x = 2.0 - 4.0 * rows[:, None] / 13.0, 1.0 + 4.0 * columns / 13.0
    return np.asarray(45.0 + 0.5 * np.degrees(np.arctan2(y, x)))


def evolve_grid(robot: Robot, seed: int, *, waist_given: bool, targets: FloatArray | None = None) -> Evolution:
    """The published algorithm on the grid, or on other targets [m], shape (k, 3)."""
    points = grid_m() if targets is None else targets
    problem = points_problem(robot.chain, points, robot.limits_rad)
    if waist_given:
        problem = behind_the_waist(problem)
    return plain.evolve(problem, plain.PAPER, [[seed, target] for target in range(len(points))])


def polished(robot: Robot, targets: FloatArray, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Configurations moved onto the targets [m], shape (k, 3), as far as possible, and the distance left [m]."""
    T = points_problem(robot.chain, targets, robot.limits_rad).T
    q = refine_poses(robot.chain, T, q, robot.limits_rad, turned=False, iterations=400)
    return q, np.linalg.norm(tool_position(robot.chain, q) - targets, axis=1)


def out_of_reach(robot: Robot) -> dict[tuple[float, float], tuple[float, FloatArray]]:
    """Targets of the grid (x, y) [cm] that the arm cannot reach: least distance [m] and nearest tool point [m]."""
    lengths = robot.lengths_m
    # Where the tool point can go.
    where = PlaneReach((lengths["a2"], lengths["a3"], lengths["d5"]), 0.0, 0.0, lengths["d1"])
    found = {}
    for target in grid_m():
        near, distance = where.nearest(target)
        if distance > 0.0:
            found[(round(100.0 * float(target[0]), 9), round(100.0 * float(target[1]), 9))] = (distance, near)
    return found


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    robot = robots.get("xiang-6dof")
    runs: dict[bool, list[Evolution]] = {False: [], True: []}
    with stage("000: the grid", 2 * effort.grid_seeds) as show:
        for done, (waist_given, number) in enumerate(product(runs, range(effort.grid_seeds)), start=1):
            runs[waist_given].append(evolve_grid(robot, seed + number, waist_given=waist_given))
            show(done, f"seed {seed + number}")
    with stage("000: two targets", 1):
        targets = np.array(TARGETS_CM) / 100.0
        two = evolve_grid(robot, seed, waist_given=False, targets=targets)
        two_q, two_missed = polished(robot, targets, two.q_rad)
    first = runs[False][0]
    exact_q, missed = polished(robot, grid_m(), first.q_rad)
    agree = int((np.abs(printed()["joint_1_population"] - population_formula()) <= 0.6e-4).sum())
    return PaperReport(
        *introduced("000"),
        (
            *_grid_rows(robot, runs),
            *_polish_rows(robot, exact_q, missed),
            *_target_rows(robot, targets, two, two_missed),
            claim(f"Fig. 7, cells equal to {POPULATION_WORDS}, of 140", "random numbers", str(agree), agree < 70),
            _curve_row(runs[False]),
        ),
        (*_six_tables(robot, first, exact_q), _population_table()),
        (
            Picture(
                "Figs. 8 and 12: fitness", "best and mean error by generation for two targets", partial(_curves, two)
            ),
            *_arm_pictures(robot, two_q),
            Picture("the grid", "difference of radius at every target", partial(_heat_maps, robot, first)),
        ),
    )


def _grid_rows(robot: Robot, runs: dict[bool, list[Evolution]]) -> list[Row]:
    rows = [claim("cells of the six tables that agree", "600", str(consistent_cells()), consistent_cells() == 600)]
    for waist_given, what, why in (
        (False, "GA over theta1 to theta4", "four angles are harder than the three that eq. (18) names"),
        (True, "GA over theta2 to theta4, theta1 by eq. (12)", "settings that the paper does not print"),
    ):
        reached = [tool_position(robot.chain, run.q_rad) for run in runs[waist_given]]
        found = np.array([statistics(grid_errors_cm(points)) for points in reached])
        for name, before, values in zip(STATISTICS, printed_statistics(), found.T, strict=True):
            quantity = f"{name}, {what}, mean of {len(values)} seeds (spread {values.std():.3g})"
            rows.append(error(quantity, float(before), float(values.mean()), "cm", why=why))
    return rows


def _polish_rows(robot: Robot, q: FloatArray, missed: FloatArray) -> list[Row]:
    found = statistics(grid_errors_cm(tool_position(robot.chain, q)))
    reached = int((missed <= REACHED_M).sum())
    rows = [
        *(
            error(f"{name}, GA with polish", before, after, "cm", why="not polished")
            for name, before, after in zip(STATISTICS, printed_statistics().tolist(), found.tolist(), strict=True)
        ),
        claim("targets of the grid reached to 1e-9 m", "100 (no other word)", str(reached), reached == 100),
    ]
    for (x, y), (distance, near) in out_of_reach(robot).items():
        i, j = int(x - SIDE_CM[0]), int(y - SIDE_CM[0])
        least = abs(float(np.hypot(near[0], near[1])) * 100.0 - float(np.hypot(x, y)))
        quantity = f"|dxy| at ({x:.0f}, {y:.0f}, 10), out of reach by exactly {distance * 100.0:.9f} cm"
        rows.append(error(quantity, abs(float(printed()["delta_xy0"][i, j])), least, "cm", why="the least there is"))
    return rows


def _target_rows(robot: Robot, targets: FloatArray, two: Evolution, missed: FloatArray) -> list[Row]:
    rows, in_print = [], "in accordance, error small"
    points = tool_position(robot.chain, two.q_rad)
    worst = float(np.abs(printed()["delta_xy0"]).max())
    for target, point, exact in zip(targets, points, missed.tolist(), strict=True):
        name = "target ({:.0f}, {:.0f}, {:.0f}): distance".format(*(target * 100.0))
        away = float(np.linalg.norm(point - target)) * 100.0
        why = f"differs: {away:.2f} cm in this run"
        rows.append(claim(f"{name}, GA alone", in_print, away, away <= worst, unit="cm", why=why))
        why = "differs: not reached"
        rows.append(claim(f"{name}, with polish", in_print, exact * 100.0, exact < REACHED_M, unit="cm", why=why))
    return rows


def _curve_row(runs: list[Evolution]) -> Row:
    """Fig. 8: the mean of the fitness beside the best after 200 generations."""
    at = min(200, len(runs[0].best_cost)) - 1
    ratio = float(np.mean([np.sqrt(run.best_cost[at] / run.mean_cost[at]).mean() for run in runs]))
    why = "differs: about half of all individuals have a flipped bit in every generation"
    return claim("least / mean distance after 200 generations (Fig. 8)", "almost 1", ratio, ratio > 0.9, why=why)


def _six_tables(robot: Robot, run: Evolution, exact_q: FloatArray) -> list[Table]:
    ga, polish = (_tables_of(tool_position(robot.chain, q)) for q in (run.q_rad, exact_q))
    columns = ("x \\ y", *(f"{y:.0f}" for y in SIDE_CM))
    note = "print | one run of the GA | polished; cm, P as a share of the target's radius or height"
    tables = []
    for name in TABLES:
        rows = []
        for x, *cells in zip(SIDE_CM, printed()[name], ga[name], polish[name], strict=True):
            shown = (f"{print_:g} | {one:.5f} | {exact:.5f}" for print_, one, exact in zip(*cells, strict=True))
            rows.append((f"{x:.0f}", *shown))
        tables.append(Table(f"table {name}", columns, tuple(rows), note))
    return tables


def _tables_of(points_m: FloatArray) -> dict[str, FloatArray]:
    """The six tables of tool points [m], shape (100, 3), each of shape (10, 10)."""
    away, above = grid_errors_cm(points_m).reshape(2, *RADIUS_CM.shape)
    found = (RADIUS_CM + away, HEIGHT_CM + above, away, above, away / RADIUS_CM, above / HEIGHT_CM)
    # What rounds to zero shall not show as -0.
    return {name: np.round(values, 5) + 0.0 for name, values in zip(TABLES, found, strict=True)}


def _population_table() -> Table:
    shown, formula = printed()["joint_1_population"], population_formula()
    rows = tuple(
        (str(r + 1), *(f"{a:.4f} | {b:.4f}" for a, b in zip(shown[r], formula[r], strict=True)))
        for r in range(POPULATION_SHOWN[0])
    )
    columns = tuple(f"{c + 1}" for c in range(POPULATION_SHOWN[1]))
    note = f"print | {POPULATION_WORDS}: the picture shows a smooth function, no population"
    return Table("Fig. 7: joint 1 initial population", ("", *columns), rows, note)


def _curves(run: Evolution) -> Figure:
    figure = axes("generation", "distance [cm]", 400, yaxis_type="log")
    for k, (x, y, z) in enumerate(TARGETS_CM):
        costs = (np.sqrt(cost[:, k]) * 100.0 for cost in (run.best_cost, run.mean_cost))
        by_generation(figure, f"({x:.0f}, {y:.0f}, {z:.0f}) {{}}", drawn.COLOURS[2 * k], *costs)
    return figure


def _arm_pictures(robot: Robot, q: FloatArray) -> list[Picture]:
    names = ["target ({:.0f}, {:.0f}, {:.0f})".format(*target) for target in TARGETS_CM]
    arms = dict(zip(names, q, strict=True))
    return pictures(drawn.ARM_VIEWS, "Fig. 11: the arm {}", "the arm at both targets, {}", drawn.arm, robot.chain, arms)


def _heat_maps(robot: Robot, run: Evolution) -> Figure:
    found = grid_errors_cm(tool_position(robot.chain, run.q_rad))[0].reshape(10, 10)
    both = np.concatenate((np.abs(printed()["delta_xy0"]), np.full((10, 1), np.nan), np.abs(found)), axis=1)
    ticks = [f"{y:.0f}" for y in SIDE_CM]
    figure = axes("y [cm]: print | one run of the GA", "x [cm]", 420)
    figure.add_heatmap(z=both, y=ticks, colorbar={"title": "|dxy| [cm]"}, colorscale="Viridis")
    figure.update_xaxes(tickvals=list(range(21)), ticktext=[*ticks, "", *ticks])
    return figure
