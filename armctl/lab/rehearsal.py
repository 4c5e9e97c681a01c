"""A log's motion on a simulated arm: the real control loop and bus in front of simulated servos, in virtual time.

Rules.
1. The motion is what the servos were told while they had torque, and where the arm was led while it was limp.
2. The arm gets there slowly: torque comes on where it stands, an approach of at most 20 deg/s leads to the first
   pose, and the motion begins at rest. Nothing is sent but by the control step, within all of its limits.
3. Where the log moves faster than the arm may, time is stretched; where it leaves the limits, they are kept. Both
   are told.
4. A log of another arm is refused unless the caller insists.
"""

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from armctl.config import ArmConfig
from armctl.errors import LogError, RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory, Run, TickRecord, most_points
from armctl.recording.log_file import Progress
from armctl.recording.timeline import Timeline
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import ArmSpec
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.interpolate import columns_at

SPEED_MARGIN = 0.99
DWELL_S = 1.0
# How often a twin plays a log.
DRAWS = 5
PERIOD_S = 0.1


class Rehearsal(NamedTuple):
    """How well the arm followed. Errors are those of its encoders against the log's, at the same place."""

    ticks: int
    # Of the motion as it was run.
    duration_s: float
    # How much longer than in the log that is.
    stretched_s: float
    # The farthest the log was outside this arm's limits.
    clipped_rad: float
    joint_rms_rad: float
    joint_max_rad: float
    tool_mean_m: float
    tool_max_m: float


class Played(NamedTuple):
    """A motion as a simulated arm ran it."""

    # From its first tick on, shape (m,).
    time_s: FloatArray
    # What encoders showed, here and in the log at the same place [rad], both of shape (m, joints).
    followed_rad: FloatArray
    logged_rad: FloatArray
    clipped_rad: float
    stretched_s: float


def check_arm(timeline: Timeline, arm: ArmConfig) -> None:
    """Make sure that a log is of this very arm.

    Raises:
        RequestRefused: FOREIGN_LOG, with what differs.
    """
    reasons = [
        f"{timeline.path}: {what} of the log is {theirs}, of this arm {ours}"
        for what in ("arm_id", "calibration_hash")
        if (theirs := getattr(timeline.arm, what)) != (ours := getattr(arm, what))
    ]
    if reasons:
        raise RequestRefused("FOREIGN_LOG", (*reasons, "add --foreign to let this arm repeat its joint angles"))


def logged_motion(timeline: Timeline) -> FloatArray:
    """The motion of a log [rad], shape (m, n); frames before every joint is known are left out by the caller."""
    return np.where(timeline.torque_enabled, timeline.goal_rad, timeline.position_rad)


def rehearse(
    timeline: Timeline, arm: ArmConfig, *, foreign: bool = False, seed: int = 0, progress: Progress | None = None
) -> Rehearsal:
    """Let a simulated arm repeat a log.

    Args:
        arm: Which arm.
        foreign: Whether the log may be of another one; it needs as many joints.
        seed: Draws what the simulated arm is like.
        progress: Called with the fraction done.
    Raises:
        RequestRefused: FOREIGN_LOG; or whatever the control step refuses, or a fault that stopped it.
        LogError: the log knows no joint, or has another number of them.
    """
    if not foreign:
        check_arm(timeline, arm)
    played = _played(SimulatedArm(arm, seed=seed), _known(timeline, arm), progress)
    error, apart_m = np.abs(played.followed_rad - played.logged_rad), tool_apart_m(played, robots.of(arm).chain)
    return Rehearsal(
        ticks=len(error),
        duration_s=len(error) * PERIOD_S,
        stretched_s=played.stretched_s,
        clipped_rad=played.clipped_rad,
        joint_rms_rad=float(np.sqrt((error**2).mean())),
        joint_max_rad=float(error.max()),
        tool_mean_m=float(apart_m.mean()),
        tool_max_m=float(apart_m.max()),
    )


def foretold(timeline: Timeline, twin: ArmSpec, progress: Progress) -> list[Played]:
    """What the twin of an arm does where the log's arm had torque: several times, what is not known of it drawn anew.

    Raises:
        RequestRefused: whatever the control step refuses, or a fault that stopped it.
        LogError: there is no motion under torque in the log.
    """
    known = _known(timeline, timeline.arm, powered=True)

    def played(seed: int) -> Played:
        simulated = SimulatedArm(timeline.arm, seed=seed, spec=twin)
        return _played(simulated, known, lambda share: progress((seed + share) / DRAWS))

    return list(map(played, range(DRAWS)))


def tool_apart_m(played: Played, chain: SerialChain) -> FloatArray:
    """Distance of the tool from where the log has it, by the encoders [m], shape (m,)."""
    here, there = (tool_position(chain, q[:, : chain.n]) for q in (played.followed_rad, played.logged_rad))
    return np.asarray(np.linalg.norm(here - there, axis=-1))


def _played(
    simulated: SimulatedArm, known: tuple[FloatArray, FloatArray, FloatArray], progress: Progress | None
) -> Played:
    """A motion on a simulated arm, begun at rest."""
    (q, measured, time_s), arm = known, simulated.config
    low, high = np.array([joint.limits_rad for joint in arm.joints]).T
    clipped = np.clip(q, low, high)
    grid, motion, run_s = _stretched(clipped, time_s, arm)
    virtual = VirtualArm(simulated, PERIOD_S)
    virtual.energise()
    approach = approach_trajectory(virtual.goals_rad, motion[0].tolist(), virtual, "approach")
    virtual.carry_out(Run(virtual.next_id(), replace(approach, corrected=False)))  # as what follows
    virtual.ticks(round(DWELL_S / PERIOD_S))  # it comes to rest
    records: list[TickRecord] = []
    most = most_points(len(arm.joints))
    for begin in range(0, len(motion) - 1, most - 1):
        rows = motion[begin : begin + most]
        part = JointTrajectory(PERIOD_S, tuple(map(tuple, rows.tolist())), label="log", corrected=False)
        # Each part ends at rest; what follows its last row until that is reported belongs to no row.
        records += virtual.carry_out(Run(virtual.next_id(), part))[: len(rows) - 1]
        if progress is not None:
            progress(min(1.0, (begin + most) / len(motion)))
    followed = np.array([[joint.position_rad for joint in record.outputs.joints] for record in records])
    then = columns_at(grid[:-1], run_s, measured)
    outside = float(np.abs(clipped - q).max())
    return Played(grid[:-1], followed, then, outside, float(run_s[-1] - (time_s[-1] - time_s[0])))


def _known(timeline: Timeline, arm: ArmConfig, *, powered: bool = False) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Motion, measured positions and times of the frames in which every joint is known, and has torque if need be."""
    if timeline.position_rad.shape[1] != len(arm.joints):
        joints = f"{timeline.position_rad.shape[1]} joints in the log, {len(arm.joints)} on the arm"
        raise LogError(f"{timeline.path}: {joints}; it cannot be repeated there")
    q = logged_motion(timeline)
    known = np.isfinite(q).all(axis=1) & np.isfinite(timeline.position_rad).all(axis=1)
    known &= timeline.torque_enabled.all(axis=1) | (not powered)
    if known.sum() < 2:
        under = " and has torque" if powered else ""
        text = f"fewer than two ticks in which every joint is known{under}; there is no motion in it"
        raise LogError(f"{timeline.path}: {text}")
    return q[known], timeline.position_rad[known], timeline.time_s[known]


def _stretched(q: FloatArray, time_s: FloatArray, arm: ArmConfig) -> tuple[FloatArray, FloatArray, FloatArray]:
    """The motion, no joint faster than its limit: times of the grid, motion on it, time of each frame of the log."""
    limits = SPEED_MARGIN * np.array([joint.speed_limit_rad_s for joint in arm.joints])
    needed_s = (np.abs(np.diff(q, axis=0)) / limits).max(axis=1)
    run_s = np.concatenate([[0.0], np.cumsum(np.maximum(np.diff(time_s), needed_s))])
    grid: FloatArray = np.arange(int(np.ceil(run_s[-1] / PERIOD_S - 1e-9)) + 1) * np.float64(PERIOD_S)
    return grid, columns_at(grid, run_s, q), run_s
