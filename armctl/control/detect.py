"""The fault matrix as far as a sample shows it: the first row that holds latches."""

import math
from collections.abc import Sequence

from armctl.control.machine import LATCHED, POWERED, Phase
from armctl.control.tick import Tick
from armctl.dynamixel import ax12a

# A servo unheard for this long is not just a lost reply.
PAUSE_AGE_S = 0.2
# A servo unheard for this long latches a fault.
SILENT_AGE_S = 0.5
BLOCKED_RAD = math.radians(8.0)
BLOCKED_NS = 300_000_000
LOAD_RATIO = 0.8
# Load above 80 % for this long: a servo's own trip is near.
LOAD_NS = 2_000_000_000
NOISE_S = 10.0
NOISE_SHARE = 0.1
# After this a servo that was switched off must show it.
TORQUE_OFF_S = 0.2


def detect_faults(s: Tick) -> None:
    """Latch the first fault of the sample; what each does stands in `faults.FAULTS`."""
    phase = s.state.phase
    if phase in LATCHED:
        return
    if not s.inputs.sample.port_open:
        s.latch("PORT_GONE", "the serial port is gone (adapter unplugged?)")
        return
    if not s.state.connected:
        return
    silent = [i for i, joint in enumerate(s.joints) if joint.age_s > SILENT_AGE_S]
    # The ages of a silent bus straddle the bound: its servos were not heard last in one instant.
    if silent and len(s.joints) > 1 and all(joint.age_s > PAUSE_AGE_S for joint in s.joints):
        s.latch("BUS_DEAD", "no servo has answered for 0.5 s")
    elif silent:
        s.latch_servo("SERVO_SILENT", silent[0], "no reply for 0.5 s")
    elif phase in POWERED:
        for detect in (_detect_power_faults, _detect_strain, _detect_noise):
            if s.state.fault is None:
                detect(s)
    elif phase is Phase.TEACHING or (phase is Phase.OFF and s.state.ticks > s.ticks_in(TORQUE_OFF_S)):
        for i, (servo, reading) in enumerate(zip(s.servos, s.inputs.sample.servos, strict=True)):
            if reading.fresh and servo is not None and servo.torque_enabled:
                s.latch_servo("NOT_LIMP", i, "torque is on although the arm is limp, and not from here")
                break


def _since(s: Tick, since_ns: tuple[int, ...], over: Sequence[bool]) -> tuple[int, ...]:
    """Since when each servo has been over its bound, brought up to date; one that was not heard keeps what it had."""
    now_ns = s.inputs.now_ns
    return tuple([
        before if not reading.fresh else before or now_ns if high else 0
        for before, reading, high in zip(since_ns or (0,) * len(over), s.inputs.sample.servos, over, strict=True)
    ])  # fmt: skip


def _detect_power_faults(s: Tick) -> None:
    """Lost torque, a trip, a second writer, a blocked joint: faults of an arm under torque."""
    state = s.state
    goal, settings, previous = state.goal, state.settings, state.previous_goal or state.goal
    errors_rad = [
        abs(servo.position - tick) * ax12a.TICK_RAD if servo else 0.0
        for servo, tick in zip(s.servos, goal, strict=True)
    ]
    since_ns = _since(s, state.error_since_ns, [error > BLOCKED_RAD for error in errors_rad])
    lost = False
    for i, (servo, reading) in enumerate(zip(s.servos, s.inputs.sample.servos, strict=True)):
        if servo is None or not reading.fresh:
            continue
        if servo.torque_limit == 0:
            return s.latch_servo("TRIPPED", i, "the servo shut itself down (torque limit 0)")
        if not servo.torque_enabled:
            return s.latch_servo("LOST_TORQUE", i, "torque is off, and not by a command from here")
        if servo.settings != settings[i]:
            if servo.settings == ax12a.POWER_ON_SETTINGS:
                return s.latch_servo("LOST_TORQUE", i, "its settings are those of a servo that has just restarted")
            return s.latch_servo("OTHER_WRITER", i, "its settings changed: another program writes to the bus")
        if servo.goal != goal[i]:
            if servo.goal != previous[i]:
                found = f"goal {servo.goal} read back, {goal[i]} sent"
                return s.latch_servo("OTHER_WRITER", i, f"{found}: another program writes to the bus")
            lost = True
        if since_ns[i] and s.inputs.now_ns - since_ns[i] >= BLOCKED_NS:
            found = f"{math.degrees(errors_rad[i]):.1f} deg away from its goal for 0.3 s (bound 8)"
            s.latch_servo("BLOCKED", i, found)
            # Once, so that the servo stops pushing; never again and again, or gravity walks the arm down.
            if s.fresh and s.all_powered():
                s.send_goal([servo.position for servo in s.servos if servo])
            return None
    state.error_since_ns = since_ns
    if lost and s.fresh:
        s.send_goal(goal)
    return None


def _detect_strain(s: Tick) -> None:
    """Heat, voltage and lasting load: what comes before a servo's own trip."""
    since_ns = _since(s, s.state.load_since_ns, [abs(joint.load_ratio) > LOAD_RATIO for joint in s.joints])
    low_V, high_V = s.arm.voltage_V
    limit_degC = s.arm.temperature_limit_degC
    for i, (joint, reading) in enumerate(zip(s.joints, s.inputs.sample.servos, strict=True)):
        if not reading.fresh:
            continue
        if joint.temperature_degC >= limit_degC or (reading.error and reading.error & ax12a.ErrorBit.OVERHEAT):
            return s.latch_servo("HOT", i, f"{joint.temperature_degC:g} degC (bound {limit_degC:g})")
        if not low_V <= joint.voltage_V <= high_V or (reading.error and reading.error & ax12a.ErrorBit.VOLTAGE):
            return s.latch_servo("VOLTAGE", i, f"{joint.voltage_V:.1f} V (bounds {low_V:g} to {high_V:g})")
        if since_ns[i] and s.inputs.now_ns - since_ns[i] >= LOAD_NS:
            return s.latch_servo("OVERLOAD", i, f"load {abs(joint.load_ratio):.0%} for 2 s (bound 80%)")
    s.state.load_since_ns = since_ns
    return None


def _detect_noise(s: Tick) -> None:
    """Too many damaged replies in a window that begins with the first of them, and ends when none is left in it."""
    noisy = sum([reading.problem == "BUS_NOISE" for reading in s.inputs.sample.servos])
    if not noisy and not s.state.noise:
        return
    length = round(NOISE_S / s.period_s)
    noise = (*s.state.noise[1 - length :], noisy)
    total = sum(noise)
    s.state.noise = noise if total else ()
    if total > NOISE_SHARE * length * len(s.joints):
        share = total / (len(noise) * len(s.joints))
        s.latch("BUS_NOISE", f"{share:.0%} of the replies came damaged in {len(noise) * s.period_s:.0f} s (bound 10%)")
