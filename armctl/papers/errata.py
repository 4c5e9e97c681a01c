"""Every erratum of the five papers: those of the robots' equations, and those of tables, figures and algorithms."""

import math
from collections.abc import Sequence

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import jacobian, tool_position
from armctl.kinematics.errata import Erratum, Residuals
from armctl.lab import table_ii
from armctl.papers import paper_000, paper_004
from armctl.papers.transcription import transcription
from armctl.trajectory.straightness import mean_error, progress_along_line


def errata(papers: Sequence[str]) -> list[Erratum]:
    """The errata of some papers ("000" to "004"), in the order of the papers."""
    of_robots = {name: proof for robot in robots.names() for name, proof in robots.get(robot).proofs.items()}
    found = []
    for paper in sorted(papers):
        for one in transcription(paper).errata:
            residuals = of_robots[one.proof] if one.proof else _PROOFS[paper, one.where]
            found.append(Erratum(paper, one.where, one.printed, one.corrected, one.how, residuals))
    return found


def _height_alone() -> tuple[float, float]:
    """Eq. (18), as printed and corrected, against the squared distance of tool and target [cm^2].

    Its angles count from the vertical; the hand's joint of Fig. 9 has a quarter turn.
    """
    robot = robots.get("xiang-6dof")
    l1, l2, l3, l4 = (100.0 * robot.lengths_m[name] for name in ("d1", "a2", "a3", "d5"))
    target, (theta1, t2, t3, t4) = np.array([20.0, 25.0, 30.0]), (0.4, 0.3, 0.5, 0.2)
    q = np.array([theta1, math.pi / 2.0 - t2, -t3, -t4 - math.pi / 2.0, 0.0])
    missed = float(((tool_position(robot.chain, q) * 100.0 - target) ** 2).sum())
    out = l2 * math.sin(t2) + l3 * math.sin(t2 + t3) + l4 * math.sin(t2 + t3 + t4)
    height = (target[2] - l1 - l2 * math.cos(t2) - l3 * math.cos(t2 + t3) - l4 * math.cos(t2 + t3 + t4)) ** 2
    plane = (target[0] - out * math.cos(theta1)) ** 2 + (target[1] - out * math.sin(theta1)) ** 2
    return abs(float(height) - missed), abs(float(height + plane) - missed)


def _radius_alone() -> tuple[float, float]:
    """Delta xy0 of a tool at (25, 20, 30) whose target is (20, 25, 30), against the triangle of the two radii [cm]."""
    (x, y), (x0, y0) = (25.0, 20.0), (20.0, 25.0)
    radius, wanted, turned = math.hypot(x, y), math.hypot(x0, y0), math.atan2(y, x) - math.atan2(y0, x0)
    distance = math.sqrt(radius**2 + wanted**2 - 2.0 * radius * wanted * math.cos(turned))
    return abs(abs(radius - wanted) - distance), abs(math.hypot(x - x0, y - y0) - distance)


def _grid_reach() -> tuple[float, float]:
    """How far out of reach the furthest target of the grid is, and the furthest of the other 97 [cm]."""
    robot = robots.get("xiang-6dof")
    beyond = {key: distance for key, (distance, _) in paper_000.out_of_reach(robot).items()}
    named = {(30.0, 30.0), (29.0, 30.0), (30.0, 29.0)}
    others = [distance for key, distance in beyond.items() if key not in named]
    return max(beyond.values()) * 100.0, max(others, default=0.0) * 100.0


def _ordered_population() -> tuple[float, float]:
    """Median over pairs of |row i + row 15 - i - 90| [deg]: of random angles in the same range, and of Fig. 7."""
    shown = paper_000.printed()["joint_1_population"]
    drawn = np.random.default_rng(0).uniform(shown.min(), shown.max(), shown.shape)
    random, print_ = (float(np.median(np.abs(one + one[::-1] - 90.0))) for one in (drawn, shown))
    return random, print_


def _standing_still() -> tuple[float, float]:
    """A tool that stays at A: the share of AB that is left undone, and eq. (20), which is 0, its least value."""
    A, B = np.array(table_ii.FROM_M), np.array(table_ii.TO_M)
    still = np.repeat(A[None], 50, axis=0)
    gone = float(progress_along_line(still, A, B)[-1])
    return 1.0 - gone, float(mean_error(still, A, B))


def _column_of_the_jacobian() -> tuple[float, float]:
    """The tool's motion by J whose i-th row, and whose i-th column, is (Z x P, Z), against finite differences."""
    robot = robots.get("transfer-6dof")
    q, rate = np.array([0.3, -1.0, 0.5, 0.2, 0.7, 0.1]), np.array([0.2, -0.1, 0.3, 0.4, -0.2, 0.1])
    J, true = jacobian(robot.chain, q), paper_004.tool_rate(robot.chain, q, rate)
    return float(np.abs(J.T @ rate - true).max()), float(np.abs(J @ rate - true).max())


# By paper and place of the errata in the transcriptions.
_PROOFS: dict[tuple[str, str], Residuals] = {
    ("000", "eq. (18)"): _height_alone,
    ("000", "tables, delta xy0"): _radius_alone,
    ("000", "grid x, y in 21..30, z = 10"): _grid_reach,
    ("000", "Fig. 7"): _ordered_population,
    ("002", "eqs. (19), (20)"): _standing_still,
    ("004", "before eq. (8)"): _column_of_the_jacobian,
}
