"""004: the transfer robot (`transfer-6dof`): kinematics both ways, Jacobian, the curves of a cycle (Figs. 3 to 7).

The curves are those of a cycle by the model (`simulated_cycle`), and beside them those of a recorded one.
"""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np

from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, forward_kinematics, jacobian
from armctl.kinematics.differential import dexterity
from armctl.kinematics.robots.papers import INITIAL_DEG
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray, rotation_error
from armctl.lab.stage import Stage
from armctl.lab.virtual_transfer import record
from armctl.papers.comparison import Effort, PaperReport, Picture, Row, claim, pictures, through_closed_form, unprinted
from armctl.papers.transcription import introduced, said, transcription
from armctl.report import kinematics as drawn
from armctl.report import transfer_curves
from armctl.trajectory import transfer as trajectory
from armctl.trajectory.quintic import Curves, curves

ROBOT = "transfer-6dof"
# Of the arm in calibration/transfer-6dof.yaml.
SCALE = 0.4
LOGGED = trajectory.TransferRequest(pick_m=(0.176, -0.132, -0.15), place_m=(0.176, 0.132, -0.15))
# The same cycle at the size of print.
WHOLE = trajectory.TransferRequest(pick_m=(0.44, -0.33, -0.375), place_m=(0.44, 0.33, -0.375), height_m=0.15)
SAMPLES = 600
EXACT = 1e-12
STEP_RAD = 1e-5
# What central differences of that step can tell.
DIFFERENCE_BOUND = 1e-8


def simulated_cycle(robot: Robot) -> Curves:
    """The cycle by the model.

    Raises:
        RequestRefused: never for the paper's lengths.
    """
    motion = trajectory.motion(WHOLE, load_arm(ROBOT), robot)
    time_s = np.linspace(0.0, motion.duration_s, SAMPLES)
    return curves(robot.chain, time_s, *motion.sample(time_s))


def tool_rate(chain: SerialChain, q: FloatArray, rate: FloatArray) -> FloatArray:
    """Linear and angular velocity of the tool, shape (..., 6), at q, shape (..., n), by central differences.

    Args:
        rate: Of the joints [rad/s], shape (n,).
    """
    ahead, behind = (forward_kinematics(chain, q + side * STEP_RAD * rate) for side in (1.0, -1.0))
    turn = rotation_error(behind[..., :3, :3], ahead[..., :3, :3])
    return np.concatenate((ahead[..., :3, 3] - behind[..., :3, 3], turn), axis=-1) / (2.0 * STEP_RAD)


def reproduce(effort: Effort, seed: int, stage: Stage) -> PaperReport:
    """Recompute the paper."""
    robot = robots.get(ROBOT)
    q = np.random.default_rng(seed).uniform(-np.pi, np.pi, (effort.random_poses, robot.chain.n))
    with stage("004: kinematics and cycle", 1):
        with tempfile.TemporaryDirectory(prefix="armctl-") as folder:
            logged = transfer_curves.load(record(load_arm(ROBOT), LOGGED, Path(folder) / "transfer.mcap", seed=seed))
        shown, described = simulated_cycle(robot), "{}: the model's and the recorded one"
        seen = pictures(transfer_curves.TITLES, "from the log, {}", described, transfer_curves.draw, logged)
        rows = [*_pose_rows(robot), *_inverse_rows(robot, q), *_jacobian_rows(robot, q), *_curve_rows(shown)]
    return PaperReport(*introduced("004", scale=SCALE), tuple(rows), (), (*_pictures(robot, shown), *seen))


def _pose_rows(robot: Robot) -> list[Row]:
    printed = transcription("004")
    R = np.array(printed.equations["after (3), 0T6"].rows, dtype=np.float64)[:3, :3]
    off = float(np.abs(R @ R.T - np.eye(3)).max())
    rows = [claim("R R^T - 1 of the initial rotation", said("004", "correct"), off, off < 1e-9)]
    assert robot.closed_form is not None
    start = printed.tables["fig_3"].numbers[0]
    _, beyond = robot.closed_form.nearest_position(start / 1e3)
    quantity = "Fig. 3 starts at ({:.0f}, {:.0f}, {:.0f}): out of reach by".format(*start)
    rows.append(claim(quantity, said("004", "start"), beyond * 1e3, beyond == 0.0, unit="mm"))
    return rows


def _inverse_rows(robot: Robot, q: FloatArray) -> list[Row]:
    _, missed = through_closed_form(robot, q)
    exists = np.isfinite(missed)
    worst, most = float(missed[exists].max()), int(exists.sum(axis=1).max())
    what, why = f"{len(q)} poses through IK and back, every branch: greatest error", "differs: near a singularity"
    return [
        claim(what, said("004", "mutually"), worst, worst < EXACT, unit="m, rad", why=why),
        claim("solutions of a pose at most", said("004", "possibilities"), str(most), most == 16),
    ]


def _jacobian_rows(robot: Robot, q: FloatArray) -> list[Row]:
    columns = [tool_rate(robot.chain, q, rate) for rate in np.eye(robot.chain.n)]
    gap = float(np.abs(np.stack(columns, axis=-1) - jacobian(robot.chain, q)).max())
    found = dexterity(jacobian(robot.chain, np.radians(INITIAL_DEG)))
    return [
        claim("Jacobian by eq. (8) against central differences", said("004", "jacobian"), gap, gap < DIFFERENCE_BOUND),
        unprinted("rank of the Jacobian at the initial position", str(found.rank)),
        unprinted("manipulability at the initial position", found.manipulability),
    ]


def _curve_rows(shown: Curves) -> list[Row]:
    why = "differs: print does not give its motion"
    found = {"speed": shown.tool_velocity_m_s, "acceleration": shown.tool_acceleration_m_s2}
    print_ = transcription("004").tables
    return [
        Row(f"greatest {what} along {axis}, {print_[what].place}", float(printed), float(most), print_[what].unit, why)
        for what, values in found.items()
        for axis, printed, most in zip("xyz", print_[what].numbers[0], np.abs(values).max(axis=0) * 1e3, strict=True)
    ]


def _pictures(robot: Robot, shown: Curves) -> list[Picture]:
    stations = {"pick": WHOLE.pick_m, "place": WHOLE.place_m}
    away_m = {name: np.linalg.norm(shown.tool_position_m - place, axis=1) for name, place in stations.items()}
    arms = {name: shown.position_rad[distances.argmin()] for name, distances in away_m.items()}
    space = partial(drawn.arm, robot.chain, arms, tool_m=shown.tool_position_m)
    figures = [
        Picture(f"Fig. {number}: {title}", f"{title} over time", partial(drawn.curve, shown, title))
        for number, title in enumerate(list(drawn.CURVES)[3:], start=3)
    ]
    return [Picture("the cycle", "the arm at pick and place and the path of its tool", space), *figures]
