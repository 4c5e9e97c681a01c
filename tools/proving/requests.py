"""What the user of an episode asks for, drawn by a seed: motions, right and wrong ones, and words out of the blue."""

import math
from collections.abc import Callable, Sequence
from itertools import pairwise

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import (
    Clear,
    Command,
    Hold,
    HostSilent,
    Jog,
    JointTrajectory,
    Park,
    Pause,
    Release,
    Resume,
    Run,
    SetRate,
    Teach,
    TeachEnd,
    TorqueOn,
)
from armctl.trajectory.approach import approach_trajectory, lowest_link_m
from armctl.trajectory.interpolate import PEAK_SPEED
from armctl.trajectory.plan import Plan, joint_trajectory
from armctl.trajectory.preflight import DrivenArm
from proving.story import Word

PERIOD_S = 0.1
# Of a joint's speed limit, in the fastest runs.
FAST_SHARE = 0.97
# Joints that hardly move the tool, and how often they turn alone: nothing but their own limits makes them slow.
WRIST, WRIST_SHARE = 2, 0.25
POSTURES = 64
ELSEWHERE_RAD = 0.2
# How many are drawn of those in which the arm may touch itself, and how often a joint goes to a limit in one.
FOLDS, FOLD_SHARE = 40, 0.6


class Requests:
    """What may be asked of one arm; each draw takes its own random numbers."""

    def __init__(self, arm: ArmConfig, robot: Robot, postures: Sequence[FloatArray]) -> None:
        self._arm, self._robot, self._postures = arm, robot, postures

    def right(self, rng: np.random.Generator, q_now: Sequence[float]) -> JointTrajectory | None:
        """A motion from where the arm is commanded to be, as the host would build it; None: none was found."""
        for _ in range(6):
            trajectory = self.draw(rng, np.array(q_now))
            if lowest_link_m(trajectory, self._robot) > self._arm.floor_m:
                return trajectory
        return None

    def draw(self, rng: np.random.Generator, q_now: FloatArray) -> JointTrajectory:
        """Over some postures at some pace within the limits; nobody has looked at the floor."""
        postures = self._postures
        via = int(rng.integers(3))
        rows = [q_now, *(postures[int(rng.integers(len(postures)))] for _ in range(via + 1))]
        if rng.random() < 0.3:
            return approach_trajectory(
                q_now.tolist(), rows[-1].tolist(), DrivenArm(self._arm, self._robot, PERIOD_S), "a slow way"
            )
        waypoints = np.array(rows)
        if rng.random() < WRIST_SHARE:
            waypoints[:, :-WRIST] = q_now[:-WRIST]
        limits = np.array([joint.speed_limit_rad_s for joint in self._arm.joints]) * FAST_SHARE
        ways_s = (np.abs(np.diff(waypoints, axis=0)) / limits).max(axis=1) + 0.05
        slow = 1.0 if rng.random() < 0.5 else float(rng.uniform(1.0, 3.0))
        duration_s = float(ways_s.sum()) * PEAK_SPEED * slow
        progress = [0.0, *np.cumsum(ways_s / ways_s.sum()).tolist()]
        progress[-1] = 1.0
        plan = Plan(
            arm_id=self._arm.arm_id,
            calibration_hash=self._arm.calibration_hash,
            from_m=(0.0, 0.0, 0.0),
            to_m=(0.0, 0.0, 0.0),
            duration_s=duration_s,
            via=via,
            interpolation="cubic" if slow > 1.5 else "linear",
            waypoints_rad=tuple(map(tuple, waypoints.tolist())),
            waypoint_progress=tuple(progress),
            predicted_mean_error_mm=0.0,
            predicted_max_error_mm=0.0,
            seed=0,
        )
        on = DrivenArm(self._arm, self._robot, PERIOD_S)
        trajectory = joint_trajectory(plan, on, q_now.tolist())
        points = tool_position(self._robot.chain, np.array(trajectory.positions_rad)[:, : self._robot.chain.n])
        tool_m_s = float(np.linalg.norm(np.diff(points, axis=0), axis=1).max()) / PERIOD_S
        slower = tool_m_s / (FAST_SHARE * self._arm.tool_speed_limit_m_s)
        if slower > 1.0:  # the host refuses a faster one
            slow_plan = plan.model_copy(update={"duration_s": duration_s * slower})
            trajectory = joint_trajectory(slow_plan, on, q_now.tolist())
        return trajectory

    def planned(self, rng: np.random.Generator, q_now: Sequence[float]) -> JointTrajectory:
        """A motion at which nobody has looked: between its ends it may leave the limits, hit the floor or the arm."""
        limits = np.array([joint.limits_rad for joint in self._arm.joints])
        # Many at a limit, where an arm folds on itself; raised, for most that fold touch the floor first.
        shares = np.clip(rng.uniform(-0.4, 1.4, size=(int(rng.integers(1, 4)), len(limits))), 0.0, 1.0)
        others = limits[:, 0] + shares * (limits[:, 1] - limits[:, 0])
        if rng.random() < 0.5:
            others[:, :2] = self._postures[int(rng.integers(len(self._postures)))][:2]
        rows = [np.array(q_now), *others]
        what = rng.random()
        if what < 0.3 and len(rows) > 2:  # a via point beyond a limit, far or by little
            joint, side = int(rng.integers(len(limits))), int(rng.integers(2))
            beyond = float(rng.choice((0.03, 0.2)))
            rows[1] = np.array(q_now)
            rows[1][joint] = limits[joint, side] + (beyond if side else -beyond)
            rows[-1] = rows[0]
        elif what < 0.6:  # there and back again: its ends tell nothing
            rows[-1] = rows[0]
        elif what < 0.75:  # one joint that hardly moves the tool: too fast for its own limit alone
            rows = [rows[0], rows[0].copy()]
            rows[1][-1] = others[0, -1]
            return _paced(rows, self._arm, self._robot, float(rng.uniform(0.6, 1.2)))
        slow = float(rng.uniform(1.05, 3.0) if rng.random() < 0.8 else rng.uniform(0.6, 1.0))
        return _paced(rows, self._arm, self._robot, slow)

    def going_on(self, q_now: Sequence[float]) -> JointTrajectory:
        """A few degrees of every joint, towards the middle of its range."""
        target = [
            q + math.copysign(math.radians(4.0), (joint.limits_rad[0] + joint.limits_rad[1]) / 2.0 - q)
            for q, joint in zip(q_now, self._arm.joints, strict=True)
        ]
        return approach_trajectory(q_now, target, DrivenArm(self._arm, self._robot, PERIOD_S), "going on")

    def against(
        self,
        rng: np.random.Generator,
        q_now: Sequence[float],
        wrong: Callable[[JointTrajectory], Sequence[str]],
        why: str,
    ) -> JointTrajectory:
        """A motion against which one thing alone speaks, if one is found.

        Args:
            wrong: What is plainly wrong with a motion.
            why: Words of what it is to be.
        """
        pace = 0.85 if "tool" in why else 1.1
        limits, begin = np.array([joint.limits_rad for joint in self._arm.joints]), np.array(q_now)
        for _ in range(FOLDS):
            # An arm folds on itself where joints are at their limits.
            shares = rng.integers(2, size=len(limits)) if "other" in why else rng.random(len(limits))
            ends = limits[:, 0] + shares * (limits[:, 1] - limits[:, 0])
            folded = rng.random(len(limits)) < FOLD_SHARE
            folded[0] = "tool" in why  # the base turns everything else
            rows = [begin, np.where(folded, ends, begin)]
            trajectory = _paced(rows, self._arm, self._robot, pace)
            reasons = wrong(trajectory)
            if reasons and all(why in reason for reason in reasons):
                break
        return trajectory

    def dashing(self, rng: np.random.Generator, q_now: Sequence[float]) -> JointTrajectory:
        """One joint that hardly moves the tool goes to its farther limit, a little too fast for it alone."""
        index = len(q_now) - 1 - int(rng.integers(WRIST))
        target = np.array(q_now)
        target[index] = max(self._arm.joints[index].limits_rad, key=lambda limit: abs(limit - target[index]))
        return _paced([np.array(q_now), target], self._arm, self._robot, float(rng.uniform(0.75, 0.95)))

    def leaning(self, q_now: Sequence[float], index: int, tick: int, ahead_ticks: int) -> JointTrajectory:
        """A little way of one joint, which stands at `tick`."""
        target = list(q_now)
        way_ticks = ahead_ticks if tick < ax12a.TICK_MAX / 2 else -ahead_ticks
        target[index] = self._arm.joints[index].position_rad(tick + way_ticks)
        return approach_trajectory(q_now, target, DrivenArm(self._arm, self._robot, PERIOD_S), "leaning")

    def straining(self, q_now: Sequence[float], index: int, tick: int, ahead_ticks: int) -> JointTrajectory:
        """The same, and another joint turns to and fro meanwhile: an arm that moves is not judged by its push."""
        rows = [list(row) for row in self.leaning(q_now, index, tick, ahead_ticks).positions_rad]
        other, middle_rad = index - 1, sum(self._arm.joints[index - 1].limits_rad) / 2.0
        step_rad = math.copysign(ax12a.TICK_RAD, middle_rad - q_now[other])
        for k in range(60):
            rows.append([*rows[-1]])
            rows[-1][other] += step_rad if k // 10 % 2 == 0 else -step_rad
        return JointTrajectory(PERIOD_S, tuple(map(tuple, rows)), label="straining")

    def velocities(self, rng: np.random.Generator) -> tuple[tuple[float, ...], tuple[float, ...]]:
        """What a jog asks of the joints [rad/s] or of the tool [m/s]; the other one is empty."""
        if rng.random() < 0.5:
            return tuple(rng.uniform(-1.5, 1.5, size=len(self._arm.joints)).tolist()), ()
        return (), tuple(rng.uniform(-0.2, 0.2, size=3).tolist())

    def wrong(self, rng: np.random.Generator, q_now: Sequence[float]) -> JointTrajectory:
        """A run that must be refused: one that starts elsewhere, is too fast or, now and then, holds no number."""
        what = rng.random()
        if what < 0.3:
            return JointTrajectory(PERIOD_S, (tuple(q_now), (math.nan, *q_now[1:])), label="no number")
        if what < 0.65:
            return self.draw(rng, np.array(q_now) + ELSEWHERE_RAD * rng.choice((-1.0, 1.0)))
        way = self.draw(rng, np.array(q_now))
        return JointTrajectory(PERIOD_S / 4.0, way.positions_rad, label="too fast")

    def blurt(self, word: Word, request_id: int, q_now: Sequence[float] | None) -> tuple[Command, ...]:
        """What a word out of the blue comes to; a run only where it is known where the arm is commanded to be."""
        rng = np.random.default_rng(word.number)
        match word.what:
            case "hold":
                return (Hold(request_id),)
            case "host_silent":
                return (HostSilent(),)
            case "clear":
                return (Clear(request_id),)
            case "release":
                return (Release(request_id),)
            case "torque_on":
                return (TorqueOn(request_id),)
            case "park":
                return (Park(request_id),)
            case "teach":
                return (Teach(request_id),)
            case "teach_end":
                return (TeachEnd(request_id),)
            case "pause":
                return (Pause(request_id),)
            case "resume":
                return (Resume(request_id),)
            case "set_rate":
                return (SetRate(request_id, float(rng.choice((0.0, 0.1, 0.5, 1.0, math.nan)))),)
            case "jog":
                speeds = rng.uniform(-1.0, 1.0, size=len(self._arm.joints)).tolist()
                return (Jog(request_id, tuple(speeds), begin=bool(rng.random() < 0.5)),)
        if q_now is None:
            return ()
        if word.what == "elsewhere":
            q_now = [q + float(rng.choice((-0.1, 0.1, -0.2, 0.2, 0.5))) for q in q_now]
        trajectory = self.draw(rng, np.array(q_now))
        if word.what == "nonsense" and rng.random() < 0.3:
            trajectory = JointTrajectory(PERIOD_S / 4.0, trajectory.positions_rad, label="too fast")
        elif word.what == "nonsense":
            bad = float(rng.choice((math.nan, math.inf, 5.0, -5.0)))
            rows = [list(row) for row in trajectory.positions_rad]
            rows[int(rng.integers(len(rows)))][int(rng.integers(len(q_now)))] = bad
            trajectory = JointTrajectory(PERIOD_S, tuple(map(tuple, rows)), label="nonsense")
        elif lowest_link_m(trajectory, self._robot) < self._arm.floor_m:
            return ()
        return (Run(request_id, trajectory),)


def postures(arm: ArmConfig, robot: Robot) -> Sequence[FloatArray]:
    """Some postures above the floor [rad], the same ones for every episode."""
    rng = np.random.default_rng(0)
    limits = np.array([joint.limits_rad for joint in arm.joints])
    found: list[FloatArray] = []
    while len(found) < POSTURES:
        q = limits[:, 0] + (limits[:, 1] - limits[:, 0]) * np.clip(rng.uniform(-0.1, 1.1, size=len(limits)), 0.0, 1.0)
        still = JointTrajectory(PERIOD_S, (tuple(q.tolist()), tuple(q.tolist())))
        if lowest_link_m(still, robot) > arm.floor_m + 0.02:
            found.append(q)
    return found


def _paced(rows: Sequence[FloatArray], arm: ArmConfig, robot: Robot, slow: float) -> JointTrajectory:
    """Smooth from one row to the next, at rest at each; `slow` below 1 is too fast for a joint or for the tool."""
    speeds = np.array([joint.speed_limit_rad_s for joint in arm.joints])
    accelerations = np.array([joint.acceleration_limit_rad_s2 for joint in arm.joints])
    points = [rows[0]]
    for begin, end in pairwise(rows):
        way = np.abs(end - begin)
        # The fastest of s = u^2 (3 - 2 u): 1.5 of the mean speed; its acceleration at the ends: 6 ways by time squared.
        least_s = max((1.5 * way / speeds).max(), np.sqrt(6.0 * way / accelerations).max(), 4.0 * PERIOD_S)
        tool = tool_position(robot.chain, np.linspace(begin, end, 40)[:, : robot.chain.n])
        least_s = max(
            least_s, 1.5 * 39.0 * np.linalg.norm(np.diff(tool, axis=0), axis=1).max() / arm.tool_speed_limit_m_s
        )
        count = math.ceil(slow * least_s / PERIOD_S)
        u = np.arange(1, count + 1)[:, None] / count
        points += list(begin + u * u * (3.0 - 2.0 * u) * (end - begin))
    return JointTrajectory(PERIOD_S, tuple(tuple(point.tolist()) for point in points), label="planned")
