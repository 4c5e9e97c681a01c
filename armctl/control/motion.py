"""A motion under way: its corrected goals one tick ahead, its pauses and stops on the path, the grip that may end it.

A goal is where a joint is wanted a tick ahead, by a trajectory or a jog, and its correction:
1. The lag that the arm's model foresees (`trajectory/lag.py`). The side from which each joint came, on which its
   friction pushes, is remembered from motion to motion.
2. A trim that grows slowly by what the encoders show, at the instants at which they were read; it begins anew with each
   motion. A joint that is far off is kept from where it is wanted, and not trimmed, nor is one whose goal has come to
   its limit. Nothing is trimmed in a motion that is being stopped, nor while a fault is latched.
   Friction holds a joint that is to stand, on a side that nobody knows, and lets it go with a jump of a tick or two.
   Within a tick of its place it is left alone; farther off its side is turned over, fast, and then trimmed as any.
3. What the motion before has left of a correction, which is blended out within `BLEND_S`.
4. Goals are whole ticks. Of those beside the exact ones of all joints together, they are those that keep the tool
   nearest to where exact ones would have it, and that turn no joint back.
A trajectory that is not corrected, and an arm whose file says `correction: false`, have neither lag nor trim, and the
nearest ticks.
"""

import math
from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from armctl.control.machine import LATCHED, TO_REST, Following, Motion
from armctl.control.settle import AWAY_RAD, FAR_RAD, MOST_RAD, STOOD_S, TRIM_RAD, settle
from armctl.control.tick import Tick
from armctl.dynamixel.ax12a import TICK_RAD
from armctl.kinematics.chain import jacobian
from armctl.messages import NS_PER_S, Event, Grip, JointTrajectory
from armctl.trajectory.lag import lags_rad, side_after

# No goal is sent farther ahead of a servo, which may not be at the last one: fast, loaded, or after a late tick.
# An arm goes on by at most this much when its program dies; noise and overshoot make it 10 deg.
LEAD_TICKS = math.radians(9.0) / TICK_RAD
# What rounding may add to the goal sent last and to a part of the way to the next one.
ROUNDING_TICKS = 1.0
# Time in which a stop brings the trajectory's rate from 1 to 0: gentle to the gears, and yet hardly any way on.
STOP_S = 0.2
# A load felt for less may be the servo setting off.
GRIP_S = 0.2
# A motion that lost replies make longer by this share, and by so much time, says so.
SLOWED_SHARE = 0.2
SLOWED_S = 0.5
BLEND_S = 0.8
# A correction changes no faster than this.
RATE_RAD_S = math.radians(4.0)
# Of the error, per second: what the trim grows by, and the side of the friction of a joint that is to stand.
TRIM_RATE, STAND_RATE = 0.5, 2.5
# A joint that is led by less than a tick a second is to stand. How far it may be off, averaged over how long.
STAND_RAD_S, STAND_RAD, STAND_S = TICK_RAD, 0.8 * TICK_RAD, 0.6
# What is farther off is held by more than its friction.
HELD_RAD = 3.5 * TICK_RAD
# What a joint's own rounding counts beside what it moves the tool: as if it had this lever.
ROUNDING_M = 0.03


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
        ends = bool(motion.stop_code) or trajectory.grip is not None or (s.fresh and not s.all_powered())
        ends |= s.state.phase in LATCHED | TO_REST  # where torque goes off no place is to be kept
        earlier_rad = sample_trajectory(trajectory, end_s - STOOD_S)
        if not ends and (motion.paused or _arrives(s, motion, end_s) or settle(s, motion, earlier_rad)):
            return None
        return s.finish_motion(motion.stop_code, "")
    # A goal would energise a servo that has just restarted: none goes out while one is unheard.
    wanted = 0.0 if motion.stop_code or motion.paused else motion.wanted_rate
    rate = _nearer(motion.rate, wanted if s.fresh else 0.0, s.period_s)
    if rate == 0.0 and motion.stop_code:
        return s.finish_motion(motion.stop_code, "")
    if s.fresh and not s.all_powered():
        return s.finish_motion(motion.stop_code or "LOST_TORQUE", "")
    stood, motion.rate, motion.free_rate = motion.rate == 0.0, rate, _nearer(motion.free_rate, wanted, s.period_s)
    if not motion.stop_code:
        _tell_slowness(s, motion, end_s)
    if not s.fresh or (motion.paused and stood and rate == 0.0):
        return None
    if not motion.stop_code and not motion.paused:
        trim(s)
    progress_s = min(motion.progress_s + rate * s.period_s, end_s)
    goal, following = _aimed_at(s, motion, progress_s)
    share = share_of_step(s, goal)
    if share < 1.0:
        progress_s = motion.progress_s + share * (progress_s - motion.progress_s)
        goal, following = _aimed_at(s, motion, progress_s)
        if share_of_step(s, goal) == 0.0:
            return None  # a joint is too far behind for its correction to lead it on
    motion.progress_s = progress_s
    s.send_goal(goal)
    s.state.following = following
    return None


def share_of_step(s: Tick, goal: list[int]) -> float:
    """How much of the way from the last goal to `goal` may be sent now: a servo that lags behind is waited for."""
    share = 1.0
    for servo, last, tick in zip(s.servos, s.state.goal, [*goal, *s.beside(goal)], strict=True):
        assert servo is not None
        ahead = abs(tick - servo.position)
        if ahead > LEAD_TICKS:
            behind = abs(last - servo.position)
            room = max(0.0, LEAD_TICKS - ROUNDING_TICKS - behind)
            share = min(share, room / (ahead - behind) if ahead > behind else 1.0)
    return share


def _arrives(s: Tick, motion: Motion, end_s: float) -> bool:
    """Go on with a correction that had too little time in a short motion; False: it is where it is to be."""
    if motion.settling is not None:
        return False
    last = s.state.following
    if s.fresh and last is not None:
        goal, following = aimed(s, sample_trajectory(motion.trajectory, end_s), (0.0,) * len(s.joints))
        if following.given_rad == last.given_rad or share_of_step(s, goal) == 0.0:
            return False
        s.send_goal(goal)
        s.state.following = following
    return True


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


# --------------------------------------------------------------------------------------------- correction


def set_off(s: Tick, *, corrected: bool = True) -> None:
    """A motion begins where the joints are wanted, with the correction that they have."""
    wanted, zeros, last = s.wanted_rad(), (0.0,) * len(s.joints), s.state.following
    seen = tuple([joint.position_rad for joint in s.joints])
    before = tuple([goal - q for goal, q in zip(s.goals_rad(), wanted, strict=True)])
    side = zeros if last is None else last.side
    s.state.following = Following(corrected and s.arm.correction, wanted, zeros, seen, side, zeros, before, before)


def trim(s: Tick) -> None:
    """Let the trim grow by what the encoders show, while the arm moves."""
    f, n = s.state.following, s.robot.chain.n
    if f is None or not f.corrected or not s.fresh or s.state.phase in LATCHED:
        return
    gain, share = s.period_s * min(1.0, f.age_s / BLEND_S), min(1.0, s.period_s / STAND_S)
    trims, sides, off, model = list(f.trim_rad), list(f.side), list(f.off_rad or (0.0,) * n), s.lag_model()
    may_stand = f.age_s > BLEND_S and s.state.jog is None
    for i in range(n):
        since_s = (s.inputs.sample.servos[i].stamp_ns - s.state.goal_ns) / NS_PER_S - s.period_s
        error = f.wanted_rad[i] + f.velocity_rad_s[i] * since_s - s.joints[i].position_rad
        stands = may_stand and abs(f.velocity_rad_s[i]) < STAND_RAD_S
        off[i] = off[i] + share * (error - off[i]) if stands else 0.0
        low, high = s.arm.joints[i].limits_rad
        if abs(error) > FAR_RAD or not low < f.wanted_rad[i] + f.given_rad[i] < high:
            continue
        if stands and abs(off[i]) < STAND_RAD:
            continue
        friction_rad, way = abs(model.rows[i][n]), math.copysign(1.0, off[i])
        if stands and abs(off[i]) < HELD_RAD and friction_rad and sides[i] != way:
            sides[i] = min(max(sides[i] + STAND_RATE * gain * off[i] / friction_rad, -1.0), 1.0)
        else:
            trims[i] = min(max(trims[i] + TRIM_RATE * gain * error, -TRIM_RAD), TRIM_RAD)
    s.state.following = replace(f, trim_rad=tuple(trims), side=tuple(sides), off_rad=tuple(off))


def aimed(s: Tick, wanted_rad: Sequence[float], velocity_rad_s: Sequence[float]) -> tuple[list[int], Following]:
    """Goals [tick] for where the joints are wanted a tick ahead, and what is to be remembered once they are sent."""
    f = s.state.following
    assert f is not None
    wanted = tuple(wanted_rad)
    side = tuple([side_after(h, b - a) for h, a, b in zip(f.side, f.wanted_rad, wanted, strict=True)])
    age_s = f.age_s + s.period_s
    lags = [0.0] * len(s.joints)
    if f.corrected:
        lags[: s.robot.chain.n] = lags_rad(s.lag_model(), s.robot.chain, wanted, side, velocity_rad_s)
    share = min(1.0, age_s / BLEND_S)
    share = share * share * (3.0 - 2.0 * share)
    given, most = list(f.given_rad), RATE_RAD_S * s.period_s
    for i, (lag, last) in enumerate(zip(lags, f.given_rad, strict=True)):
        correction = share * lag + (1.0 - share) * f.before_rad[i] + f.trim_rad[i]
        way, gone = velocity_rad_s[i] * s.period_s, s.joints[i].position_rad - f.seen_rad[i]
        # Behind is what is left when a joint has gone on for this tick as it did in the last one.
        off = wanted[i] - s.joints[i].position_rad - min(max(gone, min(way, 0.0)), max(way, 0.0))
        low, high = max(-MOST_RAD, min(0.0, -AWAY_RAD - off)), min(MOST_RAD, max(0.0, AWAY_RAD - off))
        given[i] = min(max(min(max(correction, low), high), last - most), last + most)
    after = replace(f, wanted_rad=wanted, velocity_rad_s=tuple(velocity_rad_s), side=side, given_rad=tuple(given))
    after = replace(after, seen_rad=tuple([joint.position_rad for joint in s.joints]), age_s=age_s)
    return _whole_ticks(s, f, after), after


def _exact(s: Tick, f: Following) -> list[float]:
    """The corrected goals [tick], before they are made whole."""
    joints = zip(s.wire, f.wanted_rad, f.given_rad, strict=False)
    return [joint.zero_tick + joint.direction * (q + given) / TICK_RAD for joint, q, given in joints]


def _whole_ticks(s: Tick, f: Following, after: Following) -> list[int]:
    """The goals beside the exact ones [tick] that keep the tool where it is to be (rule 4).

    No goal goes farther from the last one than the exact one does, by more than the tick that rounding may add.
    """
    exact, before, n = _exact(s, after), _exact(s, f), s.robot.chain.n
    goals = [round(tick) for tick in exact]
    if not f.corrected:
        return goals
    slopes_m: list[list[float]] = jacobian(s.robot.chain, np.array(after.wanted_rad[:n]))[:3].T.tolist()
    # Cost, how far the tool is off by then [m], and the goals of the joints so far: all that are possible.
    found: list[tuple[float, float, float, float, tuple[int, ...]]] = [(0.0, 0.0, 0.0, 0.0, ())]
    for i, (x_m, y_m, z_m) in enumerate(slopes_m):
        way, last = s.wire[i].direction * (after.wanted_rad[i] - f.wanted_rad[i]), s.state.goal[i]
        most = abs(exact[i] - before[i]) + 1.0
        beside = (math.floor(exact[i]), math.ceil(exact[i])) if way else (goals[i],)
        ticks = [tick for tick in beside if (tick - last) * way >= 0.0 and abs(tick - last) <= most]
        ticks = ticks or [min(beside, key=lambda tick: abs(tick - last))]
        off = [(tick, s.wire[i].direction * (tick - exact[i]) * TICK_RAD) for tick in ticks]
        found = [
            (cost + (ROUNDING_M * e) ** 2, x + x_m * e, y + y_m * e, z + z_m * e, (*chosen, tick))
            for cost, x, y, z, chosen in found
            for tick, e in off
        ]
    *_, nearest = min(found, key=lambda one: one[0] + one[1] * one[1] + one[2] * one[2] + one[3] * one[3])
    return [*nearest, *goals[n:]]


def _aimed_at(s: Tick, motion: Motion, time_s: float) -> tuple[list[int], Following]:
    """Goals for a place along the trajectory; the velocity is that around it."""
    way_s = max(motion.rate * s.period_s, 1e-6)
    before, q, after = [sample_trajectory(motion.trajectory, time_s + d) for d in (-way_s, 0.0, way_s)]
    span = 2.0 * s.period_s if motion.rate else math.inf
    return aimed(s, q, [(b - a) / span for a, b in zip(before, after, strict=True)])


# --------------------------------------------------------------------------------------------------- grip


def _resists(s: Tick, grip: Grip) -> bool:
    """Whether the gripper's load stands against its goal."""
    behind = s.wire[grip.joint].direction * (s.state.goal[grip.joint] - s.status(grip.joint).position)
    load_ratio = s.joints[grip.joint].load_ratio
    return abs(load_ratio) >= grip.load_ratio and load_ratio * behind > 0.0


def _hold_gripped(s: Tick, motion: Motion, grip: Grip) -> None:
    """End the motion with the goal so far inside what is gripped that the servo keeps the load asked for."""
    servo, joint = s.status(grip.joint), s.joints[grip.joint]
    load_ratio = abs(joint.load_ratio)
    # A servo's load grows with the distance to its goal.
    inside = (s.state.goal[grip.joint] - servo.position) * grip.load_ratio / load_ratio
    goal = list(s.state.goal[: len(s.joints)])
    goal[grip.joint] = servo.position + round(inside)
    s.send_goal(goal)
    name, position_deg = s.arm.joints[grip.joint].name, math.degrees(joint.position_rad)
    found = f"{name} grips at {position_deg:.1f} deg, load {load_ratio:.0%}"
    s.events.append(Event("info", "GRIPPED", found))
    s.reply(motion.request_id, True, "GRIPPED", found)
    motion.request_id = None
    s.finish_motion("", "")
