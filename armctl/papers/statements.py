"""Proofs of what the papers say in words, or between the lines of a table.

Each computes how far print and the correction are from the same quantity, found independently, in its own unit.
"""

import math
from collections.abc import Callable

import numpy as np

from armctl.kinematics import robots
from armctl.kinematics.chain import DHRow, SerialChain, jacobian, tool_position
from armctl.kinematics.robots.papers import FIG_5_DEG, LANZHOU_RANGES_DEG, QZ_DEG
from armctl.lab import table_ii
from armctl.papers import paper_000, paper_003, paper_004
from armctl.trajectory.straightness import mean_error, progress_along_line

# How far print and the correction are from what is computed.
Residuals = Callable[[], tuple[float, float]]
# In range, with a tool that points backwards (cos theta_234 < 0).
SOME_Q = np.radians([20.0, 60.0, 70.0, 40.0])


def _off(computed: float, printed: float, corrected: float) -> tuple[float, float]:
    return abs(printed - computed), abs(corrected - computed)


def _without_d1() -> tuple[float, float]:
    """Height of the arm of Fig. 9 by A1 to A5, A1 as printed and with d1 [m]."""
    robot, q = robots.get("xiang-6dof"), np.array([0.4, 0.7, -0.5, 0.9, 1.1])
    height, without = (float(tool_position(one.chain, q)[2]) for one in (robot, robots.get("xiang-6dof", {"d1": 0.0})))
    return _off(height, without, without + robot.lengths_m["d1"])


def _reach_of_fig_9() -> tuple[float, float]:
    """Distance of the tool from the shoulder with every joint stretched [m]."""
    chain = robots.get("xiang-6dof").chain
    stretched = tool_position(chain, np.array([0.0, 0.0, 0.0, -math.pi / 2.0, 0.0])) - [0.0, 0.0, 0.101]
    return _off(float(np.linalg.norm(stretched)), 0.123 + 0.138, 0.123 + 0.138 + 0.155)


def _radius_alone() -> tuple[float, float]:
    """Delta xy0 of a tool at (25, 20, 30) whose target is (20, 25, 30), against the triangle of the two radii [cm]."""
    (x, y), (x0, y0) = (25.0, 20.0), (20.0, 25.0)
    radius, wanted, turned = math.hypot(x, y), math.hypot(x0, y0), math.atan2(y, x) - math.atan2(y0, x0)
    distance = math.sqrt(radius**2 + wanted**2 - 2.0 * radius * wanted * math.cos(turned))
    return _off(distance, abs(radius - wanted), math.hypot(x - x0, y - y0))


def _grid_reach() -> tuple[float, float]:
    """How far out of reach the furthest target of the grid is, and the furthest of the other 97 [cm]."""
    beyond = {key: distance for key, (distance, _) in paper_000.out_of_reach(robots.get("xiang-6dof")).items()}
    others = [distance for key, distance in beyond.items() if key not in {(30.0, 30.0), (29.0, 30.0), (30.0, 29.0)}]
    return max(beyond.values()) * 100.0, max(others, default=0.0) * 100.0


def _ordered_population() -> tuple[float, float]:
    """Median over pairs of |row i + row 15 - i - 90| [deg]: of random angles in the same range, and of Fig. 7."""
    shown = paper_000.printed("joint_1_population")
    drawn = np.random.default_rng(0).uniform(shown.min(), shown.max(), shown.shape)
    random, print_ = (float(np.median(np.abs(one + one[::-1] - 90.0))) for one in (drawn, shown))
    return random, print_


def _standing_still() -> tuple[float, float]:
    """A tool that stays at A: the share of AB that is left undone, and eq. (20), which is 0, its least value."""
    A, B = np.array(table_ii.FROM_M), np.array(table_ii.TO_M)
    still = np.repeat(A[None], 50, axis=0)
    return 1.0 - float(progress_along_line(still, A, B)[-1]), float(mean_error(still, A, B))


def _subscripts() -> tuple[float, float]:
    """a_2 = 77 mm as the table's a_{i-1} of row 3 says, put into eq. (2), against a_2 = 9 mm."""
    c = [math.cos(float(angle)) for angle in np.cumsum(SOME_Q[1:])]
    c1, s1 = math.cos(SOME_Q[0]), math.sin(SOME_Q[0])

    def eq_2(a2: float, a3: float, a4: float, a5: float) -> float:
        return (a2 + a3 * c[0] + a4 * c[1] + a5 * c[2]) * c1 - 0.042 * s1

    x = float(tool_position(robots.get("lanzhou-4dof").chain, SOME_Q)[0])
    return _off(x, eq_2(0.077, 0.097, 0.133, 0.0), eq_2(0.009, 0.077, 0.097, 0.133))


def _solutions() -> tuple[float, float]:
    """Most joint positions of one pose: theta1 and theta234 are fixed by the rotation, the elbow has two."""
    _, most, _ = paper_003.round_trip(robots.get("lanzhou-4dof"), 20, np.random.default_rng(0))
    return _off(most, 4.0, 2.0)


def _standard_link() -> tuple[float, float]:
    """The table given to a standard link() puts Fig. 5's x elsewhere than the printed and computed 219 mm."""
    chain, q = robots.get("lanzhou-4dof").chain, np.radians(FIG_5_DEG)
    standard = SerialChain((*chain.rows, DHRow(a=0.133)), "standard")
    return _off(0.219, float(tool_position(standard, np.append(q, 0.0))[0]), float(tool_position(chain, q)[0]))


def _out_of_range(*q_deg: float) -> float:
    """The largest amount by which a joint lies outside Table 1 of 003 [deg]."""
    return max(max(low - q, q - high, 0.0) for q, (low, high) in zip(q_deg, LANZHOU_RANGES_DEG, strict=True))


def _beyond_reach() -> tuple[float, float]:
    """How far places of 004's tool lie outside the sphere about the shoulder that holds them all [m]."""
    places = ((0.660, 0.0, 0.640), (0.0, -0.160, 0.450))
    print_, true = (math.hypot(math.hypot(x, y) - 0.100, z) - (0.450 + 0.160 + 0.100) for x, y, z in places)
    return print_, max(0.0, true)


def _branches_of_theta2() -> tuple[float, float]:
    """Distinct theta2 for one theta1 and theta3 that put the wrist on one place: print says two."""
    q = np.array([0.3, -1.0, 0.5, 0.2, 0.7, 0.1])
    chain = robots.get("transfer-6dof", {"d6": 0.0}).chain
    turns = np.linspace(-math.pi, math.pi, 7201)[:-1] + (q[1] + math.pi) % math.radians(0.05)
    others = np.repeat(q[None], len(turns), axis=0)
    others[:, 1] = turns
    hits = np.linalg.norm(tool_position(chain, others) - tool_position(chain, q), axis=1) < 1e-6
    return _off(float(hits.sum()), 2.0, 1.0)


def _column_of_the_jacobian() -> tuple[float, float]:
    """The tool's motion by J whose i-th row, and whose i-th column, is (Z x P, Z), against finite differences."""
    robot = robots.get("transfer-6dof")
    q, rate = np.array([0.3, -1.0, 0.5, 0.2, 0.7, 0.1]), np.array([0.2, -0.1, 0.3, 0.4, -0.2, 0.1])
    J, true = jacobian(robot.chain, q), paper_004.tool_rate(robot.chain, q, rate)
    return float(np.abs(J.T @ rate - true).max()), float(np.abs(J @ rate - true).max())


# By their names, which the statements have in the transcriptions.
PROOFS: dict[str, Residuals] = {
    proof.__name__.removeprefix("_"): proof
    for proof in (
        _without_d1, _reach_of_fig_9, _radius_alone, _grid_reach, _ordered_population, _standing_still, _subscripts,
        _solutions, _standard_link, _beyond_reach, _branches_of_theta2, _column_of_the_jacobian,
    )
} | {
    "fig_5_range": lambda: (_out_of_range(*FIG_5_DEG), _out_of_range(0.0, 7.0, -90.0, 82.0)),
    "qz_range": lambda: (_out_of_range(*QZ_DEG), _out_of_range(*QZ_DEG[:3], 82.0)),
}  # fmt: skip
