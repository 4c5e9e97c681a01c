"""A joint that stands and pushes against something: how it is told from one that bears a weight, and relieved.

Rules.
1. Gravity explains, in the pose the arm has, any output between none (it leans on something) and what holds the
   lightest or heaviest arm that may be built of the robot's chain: an AX-12A with its brackets on every axis
   (`SERVO_KG`), and a tool with all it may carry (`TOOL_KG`). A gripper may grip besides. The servo's own slope and
   margin make a distance from the goal of an output.
2. After a stop or a fault, once the arm stands, a joint whose goal lies over `PUSH_RAD` farther off than that is
   relieved: its goal becomes where it is. One that stands, while others move or not, and to one goal gives
   `PUSH_RATIO` more output than the middle of what gravity explains, and `FRICTION_RATIO` more than all of it, for
   2 s, is a fault, CONTACT (see detect.py), and relieved too.
3. What comes back after a relief is a weight, such as a load in the gripper, unless the joint was led on since: from
   then on gravity explains that as well, for as long as it is felt. So no joint is relieved twice for it, and gravity
   walks no arm down. What a standing joint feels no more was no weight, or is put down: a hand pulls like one.
4. A servo of a limp arm to which another program gave torque keeps its torque, but not a goal that it pushes towards,
   which becomes where it is, again and again.
"""

import math
from collections.abc import Sequence

from armctl.control.enforce import holds, stay
from armctl.control.machine import Look
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a
from armctl.dynamixel.servos import MODELS
from armctl.kinematics.chain import frames_of_one

PUSH_RAD = math.radians(3.0)
PUSH_RATIO = 0.3
# What a joint's own friction may keep its motor working.
FRICTION_RATIO = 0.1
# A joint that has been slower than this for so long stands.
STAND_RAD_S = math.radians(5.0)
STAND_NS = 300_000_000
# Lightest and heaviest: bare, and with brackets, screws and cables; none, and with all that is carried.
SERVO_KG = (0.05, 0.09)
TOOL_KG = (0.0, 0.15)
# Of its stall torque: what a weak one has.
STRENGTH_SHARE = 0.8
GRAVITY_M_S2 = 9.81
RATED_V = 12.0
# A gripper holds with at most this.
GRIP_RATIO = 0.5


def look_for_push(s: Tick) -> None:
    """Relieve what was to be looked at once it stands, and learn what it bears where that was in vain.

    One that is not heard keeps what was seen of it: on a bad line no joint is heard for long at a stretch.
    """
    looks, s.state.looks, now_ns, moves = s.state.looks, (), s.inputs.now_ns, _is_asked(s)
    if s.state.borne_ratio:
        _put_down(s)
    for look in looks:
        i = look.joint
        if not s.inputs.sample.servos[i].fresh:
            s.state.looks += (look,)
            continue
        there = stands(s, i) and s.status(i).goal == s.state.goal[i]
        if not there or now_ns - (look.since_ns or now_ns) < STAND_NS:
            relieved = look.relieved and not moves  # once it is led on it may push anew
            s.state.looks += (Look(i, since_ns=there and (look.since_ns or now_ns), relieved=relieved),)
        elif look.relieved:
            borne = s.state.borne_ratio or (0.0,) * len(s.joints)
            s.state.borne_ratio = (*borne[:i], borne[i] + _beyond(s)[i], *borne[i + 1 :])
        elif _is_too_far(s, i):
            relieve(s, i)


def _put_down(s: Tick) -> None:
    """Of what a standing joint bore, keep what it still feels."""
    borne, s.state.borne_ratio = s.state.borne_ratio, ()
    felt = tuple([
        (max(0.0, min(before, now)) if before > 0.0 else min(0.0, max(before, now))) if stands(s, i) else before
        for i, (before, now) in enumerate(zip(borne, _beyond(s), strict=True))
    ])  # fmt: skip
    s.state.borne_ratio = felt if any(felt) else ()


def _beyond(s: Tick) -> list[float]:
    """Output of every joint beyond what is explained, with its sign."""
    rows = zip(s.joints, explained_ratio(s), strict=True)
    return [joint.load_ratio - min(max(joint.load_ratio, low), high) for joint, (low, high) in rows]


def _is_too_far(s: Tick, index: int) -> bool:
    """Whether a servo is farther from its goal than gravity explains."""
    servo, (low, high) = s.status(index), explained_ratio(s)[s.wire[index].of]
    ahead_rad = _ahead_rad(s, index)
    return not -ax12a.distance_rad(servo, -low) - PUSH_RAD <= ahead_rad <= ax12a.distance_rad(servo, high) + PUSH_RAD


def _ahead_rad(s: Tick, index: int) -> float:
    """By how much a servo's goal is ahead of it, the way its joint counts."""
    servo = s.status(index)
    return s.wire[index].direction * (servo.goal - servo.position) * ax12a.TICK_RAD


def relieve(s: Tick, index: int) -> None:
    """Let a joint's goal be where it is, and look at it again once it stands.

    A servo that is far from its goal and does not push is not the joint's own: another one answers in its name. Of two
    that push against each other both push, whatever their joint bears.
    """
    own = [i for i, servo in enumerate(s.servos) if servo is not None and s.wire[i].of == index]
    loads = [s.each[i].load_ratio for i in own if s.each[i].load_ratio * _ahead_rad(s, i) >= 0.0]
    if max(map(abs, loads), default=0.0) >= FRICTION_RATIO:
        stay(s, index)
        s.state.looks = (*(look for look in s.state.looks if look.joint != index), Look(index, relieved=True))


def stands(s: Tick, index: int, *, settling: bool = False) -> bool:
    """Whether a joint that is heard and has torque does not move, and no motion is asked of the arm.

    Args:
        settling: Whether one that is over, but for bringing the tool to its place, counts as none.
    """
    over = settling and s.state.motion is not None and s.state.motion.settling is not None
    return (over or not _is_asked(s)) and _is_still(s, index)


def _is_asked(s: Tick) -> bool:
    return s.state.jog is not None or (s.state.motion is not None and not s.state.motion.paused)


def _is_still(s: Tick, index: int) -> bool:
    slow = abs(s.joints[index].velocity_rad_s) <= STAND_RAD_S
    return slow and bool(s.state.goal) and holds(s, index) is not None


def pushes(s: Tick) -> list[float]:
    """By how much every joint's output is beyond what may be, as a share of its strength; not above 0: it is not, or
    the joint moves, is limp or unheard.
    """
    return [beyond if _is_still(s, i) else 0.0 for i, beyond in enumerate(_beyond_bound(s))]


def _beyond_bound(s: Tick) -> list[float]:
    """By how much every joint's output is beyond what may be; below 0: it is not."""
    beyond = []
    for i, (joint, (low, high)) in enumerate(zip(s.joints, explained_ratio(s), strict=True)):
        # Where the supply is low a motor is weaker, and friction is what it was.
        friction = FRICTION_RATIO * max(1.0, RATED_V / max(joint.voltage_V, 1.0))
        more = max(low - joint.load_ratio, joint.load_ratio - high)
        own = [s.each[k].torque_enabled for k, servo in enumerate(s.wire) if servo.of == i]
        works = max(sum(own), 1) / len(own)  # a pair of which one is limp pushes with half of its strength at most
        beyond.append(more - max(PUSH_RATIO * works - (high - low) / 2.0, friction * works))
    return beyond


def keep_here(s: Tick, index: int) -> None:
    """Let a servo that has torque, on an arm that is limp, be where it is, unless it only bears its weight."""
    if _is_too_far(s, index) or _beyond_bound(s)[s.wire[index].of] > 0.0:
        s.write(s.wire[index].servo_id, ax12a.MOVING_SPEED, s.wire[index].speed_limit_units)
        s.write(s.wire[index].servo_id, ax12a.GOAL, s.here(index))


def explained_ratio(s: Tick) -> list[tuple[float, float]]:
    """Lowest and highest output of every joint that gravity, a grip or a weight found before explains."""
    borne, servos = s.state.borne_ratio or (0.0,) * len(s.joints), [joint.servo_count for joint in s.arm.joints]
    gripper = s.arm.gripper.joint if s.arm.gripper else ""
    found = []
    rows = zip(s.arm.joints, s.joints, _holding_Nm(s, servos), borne, servos, strict=True)
    for joint, now, (low_Nm, high_Nm), weight, count in rows:
        strength_Nm = STRENGTH_SHARE * MODELS[joint.model].stall_torque_Nm * max(now.voltage_V, 1.0) / RATED_V * count
        grip = GRIP_RATIO if joint.name == gripper else 0.0
        low, high = low_Nm / strength_Nm - grip, high_Nm / strength_Nm + grip
        found.append((low + min(weight, 0.0), high + max(weight, 0.0)))
    return found


def _holding_Nm(s: Tick, servos: Sequence[int]) -> list[tuple[float, float]]:
    """Lowest and highest torque of every joint that holds the arm in its present pose, or leaves it leaning.

    g sum(m z x r) along z of the base, each m as light or heavy as it may be.
    """
    chain = s.robot.chain
    frames = frames_of_one(chain, [joint.position_rad for joint in s.joints[: chain.n]])
    turning, (*_, tool) = chain.turning(frames), frames[-1]
    least_kg, most_kg = SERVO_KG
    points = [(*P[:2], count * least_kg, count * most_kg) for (_, _, _, P), count in zip(turning, servos, strict=False)]
    # Servos of a wrist roll or a gripper sit anywhere from the last axis to the tool.
    beyond_kg = sum(servos[chain.n :]) * most_kg
    points.append((*points[-1][:2], 0.0, beyond_kg))
    points.append((*tool[:2], TOOL_KG[0], TOOL_KG[1] + beyond_kg))
    found = []
    for i, (_, _, z, P) in enumerate(turning):
        low = high = 0.0
        for x, y, light_kg, heavy_kg in points[i + 1 :]:
            Nm_kg = GRAVITY_M_S2 * (z[0] * (y - P[1]) - z[1] * (x - P[0]))
            low += Nm_kg * (light_kg if Nm_kg > 0.0 else heavy_kg)
            high += Nm_kg * (heavy_kg if Nm_kg > 0.0 else light_kg)
        found.append((min(low, 0.0), max(high, 0.0)))
    return found + [(0.0, 0.0)] * (len(s.joints) - chain.n)
