"""Jogging: the arm moves as long as somebody says so.

Rules.
1. Each heartbeat says how fast; `HEARTBEAT_NS` after the last one the speed goes to zero within `STOP_S`, a tick of
   100 ms. Then the servos, which answer late, are called back to just behind where the joints are by now. A heartbeat
   that was only late starts the arm again, from rest; after `END_NS`, or a stop, the jog has ended and goes on only by
   a new beginning.
2. No joint turns faster than `SPEED_RAD_S` or its own limit, no tool faster than its own limit; a velocity that is too
   high is scaled as a whole, so that its direction stays.
3. A tool is led straight, or not at all: where the joints would lead it aside, they turn slower, until it stands. So it
   does where a joint could hardly lift the arm back.
4. A joint nears its limit no faster than it can still stop before it. A tool that is led along a line waits as a
   whole for the joint that has to. At the limit it stands, and the others lead the tool.
5. No link is led below the floor: the place where the arm would stop is looked at before every goal.
6. A servo that lags behind is waited for, by the whole arm, from rest.
"""

import math
from collections.abc import Sequence

import numpy as np

from armctl.config import ArmConfig
from armctl.control.machine import LATCHED, Jogging, Phase, Trigger
from armctl.control.motion import aimed, set_off, share_of_step, trim
from armctl.control.tick import Tick
from armctl.errors import IllegalTransition, RequestRefused
from armctl.kinematics.chain import jacobian, tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.messages import NS_PER_S, Event, Jog
from armctl.trajectory.collision import floor_clearance, link_points
from armctl.trajectory.lag import lags_rad

HEARTBEAT_NS = 80_000_000
STOP_S = 0.1
END_NS = 500_000_000
# So far behind a moving joint it is called back to [s of its way], within this part of a tick.
BEHIND_S, AT_ONCE = 0.03, 0.25
# For so many ticks after a goal joints may still be on the way to it.
UNDER_WAY = 1.5
SPEED_RAD_S = math.radians(20.0)
ACCELERATION_RAD_S2 = math.radians(200.0)
# Damping of the least squares that turn a tool velocity into joint velocities: (1 cm/rad)^2 keeps them finite.
DAMPING_M2 = 1e-4
# How a tool is led, by the first of these that leads it straight: damping, bend [rad] and share of the speed. Damping
# leads it aside where joints hardly move it along one direction: the arm is stretched, or the tool over the base. There
# is little of it then, and all joints count as bent a hair more, without which a stretched arm would bend no way.
LEADS = ((DAMPING_M2, 0.0, 1.0), *((1e-6, 1e-3, 0.5**halvings) for halvings in range(6)))
# The look ahead. Straight is what goes aside by no more than a share of the way ahead, or, on the way in from the edge
# of the reach, by what no servo resolves: there a tool sets off along its way from rest, so that the second half of the
# way ahead is up to three times the first; of one that is led on evenly both are alike. A speed below the last of
# these, or half of what is asked for, is none.
AHEAD_S, ASIDE, ASIDE_M, SETS_OFF, LEAST_M_S = 0.15, 0.1, 1e-4, 1.5, 3e-4
# How far a joint may stay behind its goal where it lifts the arm. More is beyond the largest correction, with what is
# trimmed and what speed takes: the tool would sink by centimetres on its way back.
HEAVIEST_RAD = math.radians(6.5)


def begin(s: Tick, command: Jog) -> None:
    """Begin a jog from where the arm is told to be."""
    s.state.target(Trigger.JOG)
    position = s.wanted_rad()
    _check(s, command, position)
    s.go(Trigger.JOG)
    set_off(s)
    s.state.jog = Jogging(position, (0.0,) * len(position), command.joints_rad_s, command.tool_m_s, s.inputs.now_ns)
    s.events.append(Event("info", "JOG_BEGIN", "a jog begins"))


def heartbeat(s: Tick, command: Jog) -> None:
    """Take one heartbeat of a jog under way."""
    jog = s.state.jog
    if s.state.phase is not Phase.JOGGING or jog is None or jog.stop_code:
        raise IllegalTransition("the jog has ended; begin another one")
    _check(s, command, jog.position_rad)
    jog.joints_rad_s, jog.tool_m_s = command.joints_rad_s, command.tool_m_s
    jog.heard_ns, jog.rate = s.inputs.now_ns, 1.0


def _check(s: Tick, command: Jog, q: Sequence[float]) -> None:
    joints, tool, n = command.joints_rad_s, command.tool_m_s, len(s.arm.joints)
    if not all(map(math.isfinite, (*joints, *tool))):
        raise RequestRefused("LIMIT", "a jog needs finite velocities")
    if (len(joints), len(tool)) not in ((n, 0), (0, 3)):
        raise RequestRefused("LIMIT", f"a jog needs the velocity of each of the {n} joints, or of the tool (x, y, z)")
    if any(tool) and (why := _way(s, q, command)[1]):
        x, y, z = tool_position(s.robot.chain, np.array(q[: s.robot.chain.n])).tolist()
        no_way = f"from ({x:.3f}, {y:.3f}, {z:.3f}) m the tool can go no farther that way without going aside"
        raise RequestRefused("UNREACHABLE", f"{why}: {no_way}; jog another way, or turn a joint first")


def _way(s: Tick, q: Sequence[float], asked: Jog | Jogging) -> tuple[list[float], str]:
    """Joint velocities [rad/s] of a jog, and why it goes no farther; empty: it does."""
    velocity = led(s.arm, s.robot, q, asked)
    if not any(velocity):
        turning = zip(s.arm.joints, q[: s.robot.chain.n], strict=False)
        ends = [(joint.name, math.degrees(at)) for joint, at in turning if at in joint.limits_rad]
        stand = [f"{name} stands at its limit, {at_deg:.1f} deg" for name, at_deg in ends]
        return velocity, " and ".join(stand) or "the arm is stretched out, or its tool over its base"
    if asked.tool_m_s and s.arm.correction and (heavy := _too_heavy(s, q, velocity)):
        return [0.0] * len(velocity), heavy
    return velocity, ""


def _too_heavy(s: Tick, q: Sequence[float], velocity: Sequence[float]) -> str:
    """On which joint the arm weighs too much where this leads; empty: on none, or on none more than here."""
    model, still = s.lag_model(), (0.0,) * len(q)
    trims = still if s.state.following is None else s.state.following.trim_rad  # what the model does not know of
    ahead = [a + AHEAD_S * v for a, v in zip(q, velocity, strict=True)]
    now, then = (lags_rad(model, s.robot.chain, at, still, still) for at in (q, ahead))
    for joint, row, trim_rad, before, after in zip(s.arm.joints, model.rows, trims, now, then, strict=False):
        behind_rad = abs(after + trim_rad) + abs(row[-3])  # friction adds to what a joint lifts
        if behind_rad > HEAVIEST_RAD and abs(after) > abs(before):
            most_deg = math.degrees(HEAVIEST_RAD)
            return f"{joint.name} would lift the arm more than {most_deg:.1f} deg behind its goal: the tool would sink"
    return ""


def advance_jog(s: Tick, jog: Jogging) -> None:
    """The next goal of a jog, or its end."""
    silent_ns = s.inputs.now_ns - jog.heard_ns
    if jog.stop_code or silent_ns > HEARTBEAT_NS:
        jog.rate = max(0.0, jog.rate - s.period_s / STOP_S)
    rests = jog.rate < 1e-9
    if rests or not s.fresh:
        # While one is unheard, a goal would energise a servo that has just restarted. The arm waits, at rest.
        if rests and s.fresh:
            _call_back(s, jog)
        jog.velocity_rad_s = (0.0,) * len(jog.position_rad)
        if rests and (jog.stop_code or silent_ns > END_NS):
            s.finish_jog(jog.stop_code or "NO_HEARTBEAT")
        return
    velocity, _ = _way(s, jog.position_rad, jog)
    # All joints change speed in the same proportion, which keeps a tool on its line from the start.
    changes = [b - a for a, b in zip(jog.velocity_rad_s, velocity, strict=True)]
    most = max(map(abs, changes))
    share = min(1.0, ACCELERATION_RAD_S2 * s.period_s / most) if most else 1.0
    velocity = [a + share * change for a, change in zip(jog.velocity_rad_s, changes, strict=True)]
    velocity = [jog.rate * v for v in _within_limits(s, jog, velocity)]
    while any(velocity) and _sinks_below_floor(s, jog.position_rad, velocity):
        velocity = [0.5 * v for v in velocity] if max(map(abs, velocity)) > 1e-3 else [0.0] * len(velocity)
    position = tuple(
        min(max(q + v * s.period_s, joint.limits_rad[0]), joint.limits_rad[1]) if v else q
        for q, v, joint in zip(jog.position_rad, velocity, s.arm.joints, strict=True)
    )
    trim(s)
    goal, following = aimed(s, position, velocity)
    share = share_of_step(s, goal)
    if share < 1.0:  # a joint lags behind: it is waited for
        velocity = [share * v for v in velocity]
        position = tuple(a + share * (b - a) for a, b in zip(jog.position_rad, position, strict=True))
        goal, following = aimed(s, position, velocity)
    if share < 1.0 and share_of_step(s, goal) == 0.0:
        jog.velocity_rad_s = (0.0,) * len(velocity)
        return
    jog.position_rad, jog.velocity_rad_s = position, tuple(velocity)
    s.send_goal(goal)
    s.state.following = following


def _call_back(s: Tick, jog: Jogging) -> None:
    """End the way to the last goal, which is a tick ahead of joints that move."""
    since_s = (s.inputs.now_ns - s.state.goal_ns) / NS_PER_S
    if not any(jog.velocity_rad_s) or since_s > UNDER_WAY * s.period_s or s.state.phase in LATCHED:
        return
    behind = tuple([q - BEHIND_S * v for q, v in zip(jog.position_rad, jog.velocity_rad_s, strict=True)])
    goal, following = aimed(s, behind, (0.0,) * len(behind))
    if share_of_step(s, goal) < 1.0:  # a joint was thrown ahead of its goals
        return
    jog.position_rad, s.state.following = behind, following
    s.send_goal(goal, AT_ONCE)


def led(arm: ArmConfig, robot: Robot, q: Sequence[float], asked: Jog | Jogging) -> list[float]:
    """Joint velocities [rad/s] that do what is asked as fast as joints and tool may; all 0: none lead a tool straight.

    Args:
        q: Where the joints are [rad], shape (joints,).
    """
    for damping_m2, bend_rad, share in LEADS:
        # Rows x, y, z of the tool point's velocity for each joint of the chain [m/rad].
        J: list[list[float]] = jacobian(robot.chain, np.array(q[: robot.chain.n]) + bend_rad)[:3].tolist()
        wanted = asked.joints_rad_s or _joint_velocities(arm, J, q, asked.tool_m_s, damping_m2)
        velocity = [share * v for v in _slower(arm, J, wanted)]
        if asked.joints_rad_s or _leads_straight(robot, q, velocity, asked.tool_m_s):
            return velocity
    return [0.0] * len(q)


def _leads_straight(robot: Robot, q: Sequence[float], velocity: Sequence[float], tool_m_s: Sequence[float]) -> bool:
    """Whether the tool goes the way that was asked for, as places ahead show."""
    rows = np.array([[a + share * AHEAD_S * v for a, v in zip(q, velocity, strict=True)] for share in (0.0, 0.5, 1.0)])
    places_m = tool_position(robot.chain, rows[:, : robot.chain.n]).tolist()
    speed_m_s = math.sqrt(_dot(tool_m_s, tool_m_s)) or 1.0
    begin_m, middle_m, end_m = (_dot(place, tool_m_s) / speed_m_s for place in places_m)
    along_m, way_m = end_m - begin_m, [b - a for a, b in zip(places_m[0], places_m[2], strict=True)]
    aside_m = math.sqrt(max(0.0, _dot(way_m, way_m) - along_m * along_m))
    sets_off = end_m - middle_m > SETS_OFF * (middle_m - begin_m)
    most_m = max(ASIDE * along_m, ASIDE_M if sets_off else 0.0)
    return aside_m <= most_m and along_m >= AHEAD_S * min(LEAST_M_S, 0.5 * speed_m_s)


def _joint_velocities(
    arm: ArmConfig, J: list[list[float]], q: Sequence[float], tool_m_s: Sequence[float], damping_m2: float
) -> list[float]:
    """Joint velocities that move the tool point so; a joint stands at a limit past which it would turn."""
    while True:
        velocity = _least_squares(J, tool_m_s, damping_m2)
        limits_rad = [joint.limits_rad[int(v > 0.0)] for joint, v in zip(arm.joints, velocity, strict=False)]
        past = [v * (to - at) <= 0.0 != v for v, to, at in zip(velocity, limits_rad, q, strict=False)]
        if not any(past):
            return velocity + [0.0] * (len(q) - len(velocity))
        J = [[0.0 if stands else way for way, stands in zip(row, past, strict=True)] for row in J]


def _least_squares(J: list[list[float]], tool_m_s: Sequence[float], damping_m2: float) -> list[float]:
    """Joint velocities that move the tool point so: damped least squares, J^T (J J^T + d I)^-1 v.

    Written out, because a linear algebra library may round differently on another machine, and logs are replayed there.
    """
    (a, b, c), (_, d, e), (_, _, f) = ([_dot(row, column) for column in J] for row in J)
    a, d, f = a + damping_m2, d + damping_m2, f + damping_m2
    # The inverse of a symmetric 3x3 matrix by its cofactors.
    A, B, C = d * f - e * e, c * e - b * f, b * e - c * d
    D, E, F = a * f - c * c, b * c - a * e, a * d - b * b
    determinant = a * A + b * B + c * C
    x, y, z = tool_m_s
    force = (A * x + B * y + C * z, B * x + D * y + E * z, C * x + E * y + F * z)
    return [(x * force[0] + y * force[1] + z * force[2]) / determinant for x, y, z in zip(*J, strict=True)]


def _dot(a: Sequence[float], b: Sequence[float]) -> float:
    """Scalar product of what both have; Python's own sum of floats rounds differently from 3.12 on."""
    total = 0.0
    for x, y in zip(a, b, strict=False):
        total += x * y
    return total


def _slower(arm: ArmConfig, J: list[list[float]], velocity: Sequence[float]) -> list[float]:
    """The velocity scaled down as a whole to what joints and tool may do."""
    fastest = [min(SPEED_RAD_S, joint.speed_limit_rad_s) for joint in arm.joints]
    ratio = max(abs(v) / most for v, most in zip(velocity, fastest, strict=True))
    tool = [_dot(row, velocity) for row in J]
    ratio = max(1.0, ratio, math.sqrt(_dot(tool, tool)) / arm.tool_speed_limit_m_s)
    return [v / ratio for v in velocity]


def _within_limits(s: Tick, jog: Jogging, velocity: Sequence[float]) -> list[float]:
    """The velocity from which every joint can still stop before its limit."""
    shares, period_s = [], s.period_s
    for q, v, joint in zip(jog.position_rad, velocity, s.arm.joints, strict=True):
        left = max(0.0, joint.limits_rad[1] - q if v > 0.0 else q - joint.limits_rad[0])
        # v T + v^2 / (2 a) = left, where T is the tick that is spent at v before it can change.
        most = ACCELERATION_RAD_S2 * (math.sqrt(period_s * period_s + 2.0 * left / ACCELERATION_RAD_S2) - period_s)
        shares.append(min(1.0, most / abs(v)) if v else 1.0)
    if jog.tool_m_s:
        shares = [min(shares)] * len(shares)
    return [share * v for share, v in zip(shares, velocity, strict=True)]


def _sinks_below_floor(s: Tick, q: Sequence[float], velocity: Sequence[float]) -> bool:
    """Whether a link goes down, and would be below the floor where the arm comes to rest."""
    chain, n = s.robot.chain, s.robot.chain.n
    stop_s = s.period_s + max(map(abs, velocity)) / (2.0 * ACCELERATION_RAD_S2)
    both = np.array([q[:n], [a + v * stop_s for a, v in zip(q[:n], velocity, strict=False)]])
    now_m, then_m = floor_clearance(link_points(chain, both), s.arm.floor_m, s.arm.link_radius_m).min(axis=-1)
    return bool(then_m < 0.0 and then_m < now_m)
