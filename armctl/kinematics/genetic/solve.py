"""One target answered by a genetic algorithm, as the closed form and the numeric method answer it."""

from typing import Literal

import numpy as np

from armctl.kinematics import solution
from armctl.kinematics.genetic import improved, plain
from armctl.kinematics.genetic.problem import points_problem, poses_problem
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.solution import Answer
from armctl.kinematics.target import Target
from armctl.kinematics.transform import FloatArray

Method = Literal["ga", "ga-improved"]
# k of eq. (4) [1/m^2]: 0.1 m counts as much as a radian.
POSITION_WEIGHT = 100.0


def solve(
    robot: Robot, target: Target, method: Method, present: FloatArray | None = None, polish: bool = True, seed: int = 0
) -> Answer:
    """The configuration that the algorithm finds, which alone says whether the target is reached.

    How near the tool can come is still what the closed form says.

    Args:
        method: "ga": the algorithm of Xiang Yao et al., for a pose with the error of eq. (4); "ga-improved": with
            niches, catastrophe and migration.
        present: Where the arm is [rad], shape (n,); the joints that a point leaves alone stay there.
        polish: Bring what was found onto the target.
    Raises:
        ConfigError: `present` has another number of joints than the chain.
    """
    limits = robot.limits_rad
    exact = solution.solve(robot, target, present=present)
    present = limits.mean(axis=1) if present is None else np.asarray(present, dtype=np.float64)
    if target.turned:
        problem = poses_problem(robot.chain, target.T[None], limits, POSITION_WEIGHT)
    else:
        problem = points_problem(robot.chain, target.position_m[None], limits, present)
    if method == "ga":
        q = plain.evolve(problem, plain.PAPER, [seed]).q_rad
    else:
        q = improved.evolve(problem, improved.DEFAULT, [seed]).q_rad
    return solution.answer(robot, target, q, present, limits, least=exact.least_position_error_m, polish=polish)
