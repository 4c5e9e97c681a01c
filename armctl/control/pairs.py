"""Two servos on one joint: one joint position out of two, and whether they agree.

Rules.
1. All that plans and follows a motion knows joints; all that talks to the bus knows servos. Here two readings become
   one joint, before anything else looks at it, and `Tick.send_goal` makes two goals of one.
2. A joint with a measured table is midway between where its servos have it; without one it is where the first servo
   has it, whose zero is the joint's. While one is not heard, it is where the other one has it. Each bears half of the
   load. The joint is as old, as hot and as low on voltage as the worse one.
3. Torque comes on with each servo's goal at its own place, and a relief puts each there: then none pulls at the other.
   With the next motion the second one comes to its place beside the first one, tick by tick.
4. Two that read farther apart than `APART_TICKS`, limp or not, or that push against each other with more than
   `AGAINST_RATIO` of their output while the joint stands, for `PAIR_S`, are a fault, PAIR_MISMATCH: a horn has slipped,
   or their table is wrong. Each tick that shows them so at rest relieves them. Not of a gripper, where each servo has a
   finger of its own.
"""

from collections.abc import Iterator, Sequence

from armctl.config import ArmConfig
from armctl.control.enforce import holds, stay
from armctl.control.relief import FRICTION_RATIO, stands
from armctl.control.tick import LED_OFF_TICKS, Tick
from armctl.dynamixel.ax12a import TICK_RAD, TORQUE_ENABLE
from armctl.messages import NS_PER_S, JointState, ServoReading
from armctl.pair import APART_TICKS

# What two servos of usual stiffness push against each other with where they are `APART_TICKS` apart.
AGAINST_RATIO = 0.2
PAIR_S = 2.0


def folded(each: Sequence[JointState], readings: Sequence[ServoReading], arm: ArmConfig) -> tuple[JointState, ...]:
    """Every joint, of what its servos say."""
    joints = list(each[: len(arm.joints)])
    for first, second in arm.pairs:
        a, b = each[first], each[second]
        if not (a.known and b.known):
            joints[first] = b if a.known else a
            continue
        measured = arm.servos[second].measured and readings[first].fresh == readings[second].fresh
        one = b if readings[second].fresh and not readings[first].fresh else a
        other = b if measured else one
        joints[first] = JointState(
            True,
            (one.position_rad + other.position_rad) / 2.0,
            (one.velocity_rad_s + other.velocity_rad_s) / 2.0,
            (a.load_ratio + b.load_ratio) / 2.0,
            min(a.voltage_V, b.voltage_V),
            max(a.temperature_degC, b.temperature_degC),
            a.torque_enabled and b.torque_enabled,
            max(a.age_s, b.age_s),
        )
    return tuple(joints)


def detect_mismatch(s: Tick) -> None:
    """Latch the pairs whose servos do not agree, and have none of them pull at the other."""
    pairs, now_ns, found = s.arm.rigid_pairs, s.inputs.now_ns, []
    before = s.state.pair_since_ns or (0,) * len(pairs)
    for since_ns, (first, second) in zip(before, pairs, strict=True):
        if not (s.heard(first) and s.heard(second)):
            found.append(since_ns)
            continue
        apart, against = apart_ticks(s, first, second), _against(s, first, second)
        since_ns = since_ns or now_ns if apart > APART_TICKS or against > AGAINST_RATIO else 0
        found.append(since_ns)
        if since_ns and now_ns - since_ns >= PAIR_S * NS_PER_S:
            other = f"servo {s.wire[second].servo_id}"
            how = f"reads {apart:.0f} ticks off {other} of the same joint (bound {APART_TICKS:g})"
            if apart <= APART_TICKS:
                both = f"it and {other} push against each other"
                how = f"{both} with {against:.0%} of their strength (bound {AGAINST_RATIO:.0%})"
            s.latch_servo("PAIR_MISMATCH", first, f"{how} for {PAIR_S:g} s")
            if against > FRICTION_RATIO:
                stay(s, first)
    s.state.pair_since_ns = tuple(found)


def let_go_blind(s: Tick, index: int) -> None:
    """Torque off for a servo far from its goal although it was relieved, if it is blind and its partner holds.

    The reading of a blind one jumps as their shaft cannot, for that of its partner does not.
    """
    went = [abs(a.position - b) for a, b in zip(s.servos, s.state.last_ticks, strict=False) if a]
    for first, second in s.arm.rigid_pairs:
        other = second if index == first else first
        jumps = index in (first, second) and bool(went) and went[index] > went[other] + LED_OFF_TICKS
        if jumps and holds(s, other) and apart_ticks(s, first, second) > LED_OFF_TICKS:
            s.write(s.wire[index].servo_id, TORQUE_ENABLE, 0)
            alone = f"it goes limp, and servo {s.wire[other].servo_id} holds the joint alone"
            s.latch_servo("PAIR_MISMATCH", index, f"works at full wherever it is told to be, as if blind: {alone}")


def apart_ticks(s: Tick, first: int, second: int) -> float:
    """How far apart two servos have their joint."""
    return abs(s.each[first].position_rad - s.each[second].position_rad) / TICK_RAD


def _against(s: Tick, first: int, second: int) -> float:
    """With how much of its output each servo of a joint that stands under torque pushes against the other: what the two
    do not share of their load.
    """
    held = stands(s, first, settling=True) and holds(s, second) is not None
    return abs(s.each[first].load_ratio - s.each[second].load_ratio) / 2.0 if held else 0.0


def mismatches(s: Tick) -> Iterator[str]:
    """Joints whose servos read apart just now, and by how much."""
    for first, second in s.arm.rigid_pairs:
        if (apart := apart_ticks(s, first, second)) > APART_TICKS:
            yield f"the servos of {s.wire[first].name} read {apart:.0f} ticks apart (bound {APART_TICKS:g})"
