"""A trajectory under way: its goals one tick ahead, its pauses and stops on the path, and the grip that may end it."""

import math
from bisect import bisect_right

from armctl.control.machine import Motion
from armctl.control.tick import Tick
from armctl.messages import Event, Grip, JointTrajectory

# Time in which a stop brings the trajectory's rate from 1 to 0: gentle to the gears, and yet hardly any way on.
STOP_S = 0.2
# A load felt for less may be the servo setting off.
GRIP_S = 0.2
# A motion that lost replies make longer by this share, and by so much time, says so.
SLOWED_SHARE = 0.2
SLOWED_S = 0.5


def duration_s(trajectory: JointTrajectory) -> float:
    """What `JointTrajectory.duration_s` says; every tick asks for it several times."""
    times = trajectory.times_s
    return times[-1] if times else trajectory.period_s * (len(trajectory.positions_rad) - 1)


def sample_trajectory(trajectory: JointTrajectory, time_s: float) -> tuple[float, ...]:
    """Joint positions [rad] at `time_s`, linear between grid points."""
    points, times = trajectory.positions_rad, trajectory.times_s
    if times:
        index = min(max(bisect_right(times, time_s) - 1, 0), len(points) - 2)
        part = min(max((time_s - times[index]) / (times[index + 1] - times[index]), 0.0), 1.0)
    else:
        place = min(max(time_s / trajectory.period_s, 0.0), len(points) - 1.0)
        index = min(int(place), len(points) - 2)
        part = place - index
    return tuple([a + part * (b - a) for a, b in zip(points[index], points[index + 1], strict=True)])


def move(s: Tick, motion: Motion) -> None:
    """Send the trajectory's position one tick ahead, or end the motion."""
    trajectory, end_s = motion.trajectory, duration_s(motion.trajectory)
    _tell_marks(s, motion)
    if trajectory.grip is not None and s.fresh and not motion.stop_code:
        resisted = _resists(s, trajectory.grip)
        motion.resisted_ticks = motion.resisted_ticks + 1 if resisted else 0
        if motion.resisted_ticks >= s.ticks_in(GRIP_S):
            return _hold_gripped(s, motion, trajectory.grip)
        if resisted:
            return None  # no closer: the goal stays where its distance made the load
    if motion.progress_s >= end_s:
        return s.finish_motion(motion.stop_code, "")
    # A goal would energise a servo that has just restarted: none goes out while one is unheard.
    wanted = 0.0 if motion.stop_code or motion.paused else motion.wanted_rate
    rate = _nearer(motion.rate, wanted if s.fresh else 0.0, s.period_s)
    if rate == 0.0 and motion.stop_code:
        return s.finish_motion(motion.stop_code, "")
    if s.fresh and not s.all_powered():
        return s.finish_motion(motion.stop_code or "LOST_TORQUE", "")
    motion.rate, motion.free_rate = rate, _nearer(motion.free_rate, wanted, s.period_s)
    if not motion.stop_code:
        _tell_slowness(s, motion, end_s)
    if not s.fresh:
        return None
    progress_s = min(motion.progress_s + rate * s.period_s, end_s)
    goal = _goal_at(s, trajectory, progress_s)
    share = s.share_of_step(goal)
    if share < 1.0:
        progress_s = motion.progress_s + share * (progress_s - motion.progress_s)
        goal = _goal_at(s, trajectory, progress_s)
    motion.progress_s = progress_s
    s.send_goal(goal)
    return None


def _nearer(rate: float, wanted: float, period_s: float) -> float:
    """The next tick's rate on the way to the one that is wanted."""
    change = period_s / STOP_S
    return max(wanted, rate - change) if rate > wanted else min(wanted, rate + change)


def _tell_slowness(s: Tick, motion: Motion, end_s: float) -> None:
    """Say once that lost replies make the motion much longer; pauses and a lower rate are no loss."""
    motion.lost_s += (motion.free_rate - (motion.rate if s.fresh else 0.0)) * s.period_s
    motion.unheard_ticks += not s.fresh
    late_s = motion.lost_s / motion.wanted_rate
    if motion.slowness_told or motion.lost_s <= SLOWED_SHARE * end_s or late_s < SLOWED_S:
        return
    motion.slowness_told = True
    text = (
        f"replies were lost in {motion.unheard_ticks} of {s.state.ticks} ticks: late by {late_s:.1f} s so far, of a "
        f"motion of {end_s / motion.wanted_rate:.1f} s (bound {SLOWED_SHARE:.0%}); check the bus cable and its plugs"
    )
    s.events.append(Event("warning", "SLOWED", text))


def _tell_marks(s: Tick, motion: Motion) -> None:
    """Mark in the log where the plan proper begins and ends."""
    trajectory = motion.trajectory
    if not motion.begun and motion.progress_s >= trajectory.begin_s:
        motion.begun = True
        s.events.append(Event("info", "PLAN_BEGIN", trajectory.label))
    if not motion.ended and motion.progress_s >= trajectory.end_s > trajectory.begin_s:
        motion.ended = True
        s.events.append(Event("info", "PLAN_END", trajectory.label))


def _goal_at(s: Tick, trajectory: JointTrajectory, time_s: float) -> list[int]:
    q = sample_trajectory(trajectory, time_s)
    return s.whole_ticks(q)


def _resists(s: Tick, grip: Grip) -> bool:
    """Whether the gripper's load stands against its goal."""
    servo = s.status(grip.joint)
    behind = s.wire[grip.joint].direction * (s.state.goal[grip.joint] - servo.position)
    load_ratio = s.joints[grip.joint].load_ratio
    return abs(load_ratio) >= grip.load_ratio and load_ratio * behind > 0.0


def _hold_gripped(s: Tick, motion: Motion, grip: Grip) -> None:
    """End the motion with the goal so far inside what is gripped that the servo keeps the load asked for."""
    servo, joint = s.status(grip.joint), s.joints[grip.joint]
    load_ratio = abs(joint.load_ratio)
    # A servo's load grows with the distance to its goal.
    inside = (s.state.goal[grip.joint] - servo.position) * grip.load_ratio / load_ratio
    goal = list(s.state.goal)
    goal[grip.joint] = servo.position + round(inside)
    s.send_goal(goal)
    name, position_deg = s.arm.joints[grip.joint].name, math.degrees(joint.position_rad)
    found = f"{name} grips at {position_deg:.1f} deg, load {load_ratio:.0%}"
    s.events.append(Event("info", "GRIPPED", found))
    s.reply(motion.request_id, True, "GRIPPED", found)
    motion.request_id = None
    s.finish_motion("", "")
