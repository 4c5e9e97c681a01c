"""003: the four-joint manipulator (`lanzhou-4dof`): test poses, inverse kinematics, workspace, quintic trajectory."""

from functools import partial

import numpy as np

from armctl.kinematics import robots, workspace
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.papers import FIG_5_DEG
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.lab.stage import Stage
from armctl.papers.comparison import Effort, PaperReport, Picture, Row, Table, claim, pictures, through_closed_form
from armctl.papers.transcription import introduced, said
from armctl.report import kinematics as drawn
from armctl.trajectory.quintic import Curves, curves, quintic

# The print's start, and qz with theta4 at the end of its range: print gives no end for the trajectory.
START_DEG = (0.0, 90.0, 0.0, 0.0)
END_DEG = (60.0, 45.0, -90.0, 82.0)
DURATION_S = 2.0
EXACT = 1e-12


def round_trip(robot: Robot, poses: int, rng: np.random.Generator) -> tuple[float, int, float]:
    """In-range poses through inverse and forward kinematics.

    Returns:
        The greatest pose error [m and rad] of any branch, the most branches of a pose, and how far [rad] the
        configuration that a pose was made of is from the nearest branch, at most.
    """
    q = rng.uniform(robot.limits_rad[:, 0], robot.limits_rad[:, 1], (poses, robot.chain.n))
    branches, missed = through_closed_form(robot, q)
    holds = missed < 1e-6
    away = np.abs((branches - q[:, None] + np.pi) % (2.0 * np.pi) - np.pi).max(axis=-1)
    away = np.where(holds, away, np.inf).min(axis=1)
    return float(missed[holds].max()), int(holds.sum(axis=1).max()), float(away.max())


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    robot = robots.get("lanzhou-4dof")
    rng = np.random.default_rng(seed)
    with stage("003: inverse kinematics and workspace", 2) as show:
        worst, most, away = round_trip(robot, effort.random_poses, rng)
        show(1, "workspace")
        extent = workspace.extents(robot.chain, robot.limits_rad, rng)
        points = workspace.cloud(robot.chain, robot.limits_rad, effort.samples, rng)
        show(2, "")
    # The quintic motion of Figs. 6 to 8.
    way, time_s = quintic(np.radians(START_DEG), np.radians(END_DEG), DURATION_S), np.linspace(0.0, DURATION_S, 201)
    motion = curves(robot.chain, time_s, *way.sample(time_s))
    rows = (
        claim("poses through IK and back", said("003", "no_error"), max(worst, away), away < 1e-9, unit="m, rad"),
        claim("solutions of a pose at most", said("003", "solutions"), str(most), most == 4),
        *_rows(robot, points, motion),
    )
    table = Table("Fig. 4: workspace", *drawn.extents_table(extent, points))
    return PaperReport(*introduced("003"), rows, (table,), tuple(_pictures(robot, extent, points, motion)))


def _rows(robot: Robot, points: FloatArray, motion: Curves) -> list[Row]:
    notch = float(np.hypot(points[:, 0], points[:, 1]).min()) * 1e3
    offset = robot.lengths_m["d2"] * 1e3
    hollow = f"radius of the cylindrical notch, Fig. 4 (d2 = {offset:g} mm)"
    missed = float(np.linalg.norm(motion.tool_position_m[-1] - tool_position(robot.chain, np.radians(END_DEG))))
    steps = float(np.abs(np.diff(motion.acceleration_rad_s2, axis=0)).max() / np.abs(motion.acceleration_rad_s2).max())
    return [
        claim(hollow, said("003", "notch"), notch, notch >= offset - 1e-6, unit="mm"),
        claim("distance of the trajectory's end", said("003", "reached"), missed, missed < EXACT, unit="m"),
        claim("greatest step of acceleration between samples, of its peak", said("003", "smooth"), steps, steps < 0.1),
    ]


def _pictures(robot: Robot, extent: FloatArray, points: FloatArray, motion: Curves) -> list[Picture]:
    ends = {"start": motion.position_rad[0], "end": motion.position_rad[-1]}
    space = partial(drawn.arm, robot.chain, ends, tool_m=motion.tool_position_m)
    described, tested = "{} of random configurations", {"arm": np.radians(FIG_5_DEG)}
    return [
        *pictures(drawn.WORKSPACE_VIEWS, "Fig. 4: workspace", described, drawn.workspace, points, extent),
        *pictures(drawn.ARM_VIEWS[:3:2], f"Fig. 5: the arm at {FIG_5_DEG} deg", "{}", drawn.arm, robot.chain, tested),
        Picture("Fig. 6: path of the tool", "the arm at both ends and the path of its tool", space),
        *pictures(list(drawn.CURVES)[3:4], "Fig. 7: position of the tool", "{} over time", drawn.curve, motion),
        *pictures(list(drawn.CURVES)[:3], "Fig. 8: joint 1", "{} over time", partial(drawn.curve, first=1), motion),
        *pictures(list(drawn.CURVES)[4:6], "the tool's other curves", "{} over time", drawn.curve, motion),
    ]
