"""The fault matrix as far as a sample shows it: every row that holds latches."""

import math
from collections.abc import Sequence

from armctl.control.faults import KINDS, Cause
from armctl.control.machine import LATCHED, Phase, Trigger
from armctl.control.pairs import detect_mismatch, let_go_blind
from armctl.control.relief import PUSH_RATIO, keep_here, pushes, relieve
from armctl.control.stillness import STILL_TICKS
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import ErrorBit, Status
from armctl.messages import NS_PER_S, Event, Mode

# A servo unheard for this long is not just a lost reply.
PAUSE_AGE_S = 0.2
# A servo unheard for this long latches a fault.
SILENT_AGE_S = 0.5
BLOCKED_RAD = math.radians(8.0)
BLOCKED_S = 0.3
# One that is no farther from where it is wanted is not kept from there: its goal is far for what it bears.
ASTRAY_RAD = math.radians(1.5)
# One this near the goal that it shows is where it was told to be, by whoever told it: it may sag by so much.
THERE_RAD = math.radians(4.0)
LOAD_RATIO = 0.8
# Load above 80 % for this long: a servo's own trip is near.
LOAD_S = 2.0
# A dip of the supply, or one reading of a sensor, moves no arm.
HEAT_S = 2.0
SUPPLY_S = 0.5
# Time in which a `stop` calls the way to rest off.
REST_AHEAD_S = 3.0
# So much farther behind its ramp than it pushes for, for so many ticks, is no joint whose ramp goes on, however noisy
# its sensor or slow to react its servo.
BEHIND_TICKS, LAZY_TICKS = 12.0, 2
# A joint that is farther behind than that and two ticks of its way was not so by its ramps.
AT_ONCE_TICKS = 16.0
# What a joint goes in a tick, and is pushed for, that would be far behind by now if its ramps did not go on.
LEAST_TICKS = 1.0
# So long every servo has to have been heard, to have shown its goal and to have been near its ramp.
CLEAN_S = 0.5
# What is at its torque limit pushes no more for being farther off.
LIMIT_SHARE = 0.9
NOISE_S = 10.0
NOISE_SHARE = 0.1
# A standing joint pushes for so long before that is a fault.
PUSH_S = 2.0


def detect_faults(s: Tick) -> None:
    """Latch every fault of the sample, in every mode; what each does stands in `faults.FAULTS`."""
    if not s.inputs.sample.port_open:
        s.latch("PORT_GONE", "the serial port is gone (adapter unplugged?)")
        return
    connected = s.state.connected
    if not connected and s.state.mode in (Mode.STARTING, Mode.FAULTED):
        if s.state.mode is Mode.FAULTED:
            _detect_strain(s)  # they are heard, and whoever they are, this is before a servo's own trip
        return
    # A servo that has never been heard is a matter of what is found when connecting.
    silent = [i for i, servo in enumerate(s.each) if (connected or servo.known) and servo.age_s > SILENT_AGE_S]
    # The ages of a silent bus straddle the bound: its servos were not heard last in one instant.
    if silent and len(s.each) > 1 and all(servo.age_s > PAUSE_AGE_S for servo in s.each):
        s.latch("BUS_DEAD", "no servo has answered for 0.5 s")
        return
    for i in silent:
        s.latch_servo("SERVO_SILENT", i, "no reply for 0.5 s")
    state = s.state
    if state.powered is None and state.goal and state.phase is Phase.FAULTED and s.fresh:
        _see_what_came_on(s)
    if state.powered and s.fresh and not state.goal:
        s.find_goals()
    if state.powered and state.goal:
        _detect_power_faults(s)
        _detect_contact(s)
    elif state.powered is False:
        _detect_torque(s)
    elif state.phase is Phase.FAULTED and s.fresh and not state.goal:
        for i, servo in enumerate(s.servos):  # found stiff, and not taken over before `clear`: nobody is to be pushed
            if servo is not None and servo.torque_enabled:
                keep_here(s, i)
    if s.arm.pairs:
        detect_mismatch(s)
    _detect_strain(s)
    _detect_noise(s)
    _call_for_rest(s)


def _see_what_came_on(s: Tick) -> None:
    """A fault has ended a torque-on half-way: what has torque by now is to keep it, at its goal, and is judged.

    A goal may have followed the shaft for as long as it was limp.
    """
    ours = s.state.goal
    if any(servo and servo.torque_enabled for servo in s.servos):
        s.take_over()
        pairs = zip(s.state.goal, ours, strict=True)
        s.state.goal = tuple([shown if abs(shown - sent) <= STILL_TICKS else sent for shown, sent in pairs])
    else:
        s.forget_goals()
        s.state.powered = False


def _call_for_rest(s: Tick) -> None:
    """Announce the way to rest while what would soon drop the arm lasts, if the arm can go, and nobody said no."""
    may = s.arm.rest_on_strain and not s.state.stays and s.state.powered and s.all_powered()
    kinds = [KINDS[code] for code in s.found]
    if not (s.state.phase is Phase.FAULTED and may and any(kind.to_rest for kind in kinds)):
        return
    if any(kind.motion == "ends" or kind.until is Cause.SILENCE for kind in kinds):
        return
    s.go(Trigger.STRAIN)
    text = f"the arm goes to its rest pose in {REST_AHEAD_S:g} s, and goes limp there; `armctl stop` keeps it here"
    s.events.append(Event("warning", "REST_AHEAD", text))


def _since(s: Tick, since_ns: tuple[int, ...], over: Sequence[bool]) -> tuple[int, ...]:
    """Since when each servo has been over its bound, brought up to date; one that was not heard keeps what it had."""
    now_ns = s.inputs.now_ns
    return tuple([
        before if not reading.fresh else before or now_ns if high else 0
        for before, reading, high in zip(since_ns or (0,) * len(over), s.inputs.sample.servos, over, strict=False)
    ])  # fmt: skip


def _detect_torque(s: Tick) -> None:
    """Torque of a servo that is meant to be limp and was seen so; it is to push against nothing."""
    stiff = s.state.letting_go.stiff if s.state.letting_go else ()
    for i in range(len(s.wire)):
        if i not in stiff and (servo := s.heard(i)) and servo.torque_enabled:
            s.latch_servo("NOT_LIMP", i, "torque is on although the arm is limp, and not from here")
            keep_here(s, i)


def _lasts(s: Tick, since_ns: int, seconds: float) -> bool:
    return since_ns > 0 and s.inputs.now_ns - since_ns >= seconds * NS_PER_S


def _detect_power_faults(s: Tick) -> None:
    """Lost torque, a trip, a second writer, a blocked joint: faults of an arm under torque."""
    state = s.state
    s.confirm_goals()
    # Of one that shows a goal from elsewhere: it is led, and not kept from where it is to be.
    wanted_rad = s.wanted_rad()
    errors_rad = [
        abs(servo.position - tick) * ax12a.TICK_RAD
        if servo
        and s.is_from_here(i)
        and abs(s.each[i].position_rad - wanted_rad[s.wire[i].of]) > ASTRAY_RAD
        and (servo.goal == tick or abs(servo.position - servo.goal) * ax12a.TICK_RAD > THERE_RAD)
        else 0.0
        for i, (servo, tick) in enumerate(zip(s.servos, state.goal, strict=True))
    ]
    state.error_since_ns = since_ns = _since(s, state.error_since_ns, [error > BLOCKED_RAD for error in errors_rad])
    if state.yielded:
        s.found.add("OVERRULED")
    for i in range(len(s.wire)):
        servo = s.heard(i)
        if servo is None or _overruled(s, i, servo) or state.yielded:
            continue
        if not s.is_from_here(i):
            found = f"goal {servo.goal} read back, {state.goal[i]} sent"
            s.latch_servo("OTHER_WRITER", i, f"{found}: another program writes to the bus")
        elif _lasts(s, since_ns[i], BLOCKED_S):
            found = f"{math.degrees(errors_rad[i]):.1f} deg away from its goal for 0.3 s (bound 8)"
            if s.latch_servo("BLOCKED", i, found):
                relieve(s, s.wire[i].of)
            elif s.state.phase in LATCHED:
                let_go_blind(s, i)


def _overruled(s: Tick, i: int, servo: Status) -> bool:
    """Whether a servo has lost its torque or its settings, which is latched."""
    if servo.torque_limit == 0:
        s.latch_servo("TRIPPED", i, "the servo shut itself down (torque limit 0)")
    elif not servo.torque_enabled:
        s.latch_servo("LOST_TORQUE", i, "torque is off although the arm is to hold")
    elif servo.settings == s.state.settings[i]:
        return False
    elif servo.settings == ax12a.POWER_ON_SETTINGS:
        s.latch_servo("LOST_TORQUE", i, "its settings are those of a servo that has just restarted")
    else:
        s.latch_servo("OTHER_WRITER", i, "its settings changed: another program writes to the bus")
    return True


def _detect_strain(s: Tick) -> None:
    """Lasting heat, voltage and load: what comes before a servo's own trip."""
    state, joints, readings = s.state, s.each, s.inputs.sample.servos
    low_V, high_V = s.arm.voltage_V
    limit_degC = s.arm.temperature_limit_degC
    both = [*zip(joints, readings, strict=True)]
    hot = [now.temperature_degC >= limit_degC or bool(reading.error & ErrorBit.OVERHEAT) for now, reading in both]
    wrong = [not low_V <= now.voltage_V <= high_V or bool(reading.error & ErrorBit.VOLTAGE) for now, reading in both]
    state.heat_since_ns = _since(s, state.heat_since_ns, hot)
    state.supply_since_ns = _since(s, state.supply_since_ns, wrong)
    state.load_since_ns = _since(s, state.load_since_ns, [abs(joint.load_ratio) > LOAD_RATIO for joint in joints])
    latched = {fault.code for fault in state.faults}

    def lasts(code: str, i: int, since_ns: int, seconds: float) -> bool:
        return _lasts(s, since_ns, seconds) and (readings[i].fresh or code in latched)

    for i, joint in enumerate(joints):
        if lasts("HOT", i, state.heat_since_ns[i], HEAT_S):
            s.latch_servo("HOT", i, f"{joint.temperature_degC:g} degC for {HEAT_S:g} s (bound {limit_degC:g})")
        since_ns = state.supply_since_ns[i]
        # What has made a joint weak is told with what came of it.
        at_once = "BLOCKED" in s.found and 0 < since_ns < s.inputs.now_ns
        if lasts("VOLTAGE", i, since_ns, 0.0 if at_once else SUPPLY_S):
            lasted = f"{(s.inputs.now_ns - since_ns) / NS_PER_S:.1f} s (bounds {low_V:g} to {high_V:g})"
            s.latch_servo("VOLTAGE", i, f"{joint.voltage_V:.1f} V for {lasted}")
        if lasts("OVERLOAD", i, state.load_since_ns[i], LOAD_S):
            s.latch_servo("OVERLOAD", i, f"load {abs(joint.load_ratio):.0%} for {LOAD_S:g} s (bound 80%)")


def _detect_contact(s: Tick) -> None:
    """A joint that stands and pushes, beyond what gravity explains; of an arm that is left to another program, none."""
    state = s.state
    if state.yielded or not any(abs(joint.load_ratio) > PUSH_RATIO for joint in s.joints):
        state.push_since_ns = ()
        return
    push_ratio = pushes(s)
    state.push_since_ns = _since(s, state.push_since_ns, [push > 0.0 for push in push_ratio])
    for i, since_ns in enumerate(state.push_since_ns):
        if _lasts(s, since_ns, PUSH_S) and s.inputs.sample.servos[i].fresh:
            found = f"pushes with {abs(s.joints[i].load_ratio):.0%} of its strength"
            bound = abs(s.joints[i].load_ratio) - push_ratio[i]
            if s.latch_servo("CONTACT", i, f"{found} for {PUSH_S:g} s (bound {bound:.0%}, for what it may bear here)"):
                relieve(s, i)


def _detect_noise(s: Tick) -> None:
    """Too many damaged replies in a window that begins with the first of them, and ends when none is left in it."""
    noisy = sum([reading.problem == "BUS_NOISE" for reading in s.inputs.sample.servos])
    if not noisy and not s.state.noise:
        return
    length = round(NOISE_S / s.period_s)
    noise = (*s.state.noise[1 - length :], noisy)
    total = sum(noise)
    s.state.noise = noise if total else ()
    if total > NOISE_SHARE * length * len(s.wire):
        share = total / (len(noise) * len(s.wire))
        s.latch("BUS_NOISE", f"{share:.0%} of the replies came damaged in {len(noise) * s.period_s:.0f} s (bound 10%)")


def look_at_ramps(s: Tick) -> None:
    """Notice that the servos begin their speed ramp to each new goal at the shaft: no document says what they do.

    Such a ramp takes back with each goal what a loaded joint lags behind. So the joint falls ever farther behind goals
    that come tick by tick, and yet does not push as one does that is so far from its goal. What is that far off at once
    was led off, or is read wrongly; and where a goal was lost, a ramp is behind for that. A joint that pushes on its
    way and is behind by no more than that shows that ramps go on, and that another joint is led by somebody else.
    """
    state = s.state
    if s.arm.ramp_from_reference is not None or state.ramp_restarts:
        return
    if state.motion is None and state.jog is None:
        state.lazy_ticks = min(0, state.lazy_ticks + 1)
        return
    if not (s.fresh and s.all_powered()) or state.faults or s.found or state.sent:
        state.lazy_ticks = -s.ticks_in(CLEAN_S)
        return
    speeds = (0.0,) * len(s.joints) if state.following is None else state.following.velocity_rad_s
    begun = state.following is None or state.following.age_s < CLEAN_S
    lazy, at_once, goes_on = False, False, False
    for wire, servo, joint, goal, ramp in zip(s.wire, s.servos, s.each, state.goal, s.ramps(), strict=True):
        way = abs(speeds[wire.of]) * s.period_s / ax12a.TICK_RAD
        if servo is None or servo.goal != goal:
            continue
        behind = abs(ramp - servo.position) - 0.5 * way
        pushes = ax12a.distance_rad(servo, abs(servo.load_ratio)) / ax12a.TICK_RAD
        bears = joint.load_ratio * speeds[wire.of] > 0.0 and min(way, pushes) > LEAST_TICKS
        goes_on |= bears and not begun and behind <= pushes + LEAST_TICKS
        if behind <= BEHIND_TICKS:
            continue
        full = abs(servo.load_ratio) >= LIMIT_SHARE * servo.torque_limit / ax12a.LOAD_MAX
        lazy |= behind - pushes > BEHIND_TICKS and not full
        at_once |= behind > AT_ONCE_TICKS + 2.0 * way
    lazy &= not goes_on
    if state.lazy_ticks < 0 or (at_once and not state.lazy_ticks):
        state.lazy_ticks = -s.ticks_in(CLEAN_S) if lazy or at_once else state.lazy_ticks + 1
    else:
        state.lazy_ticks = state.lazy_ticks + 1 if lazy else 0
    if state.lazy_ticks == LAZY_TICKS:
        state.ramp_restarts = True
        text = "the servos begin their speed ramp anew at the shaft; goals get more speed from now on"
        s.events.append(Event("info", "RAMP_RESTARTS", text))
