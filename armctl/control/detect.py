"""The fault matrix as far as a sample shows it: the first row that holds latches."""

from __future__ import annotations

import math

from armctl.control.machine import replace
from armctl.control.tick import POWER_ON, Tick, all_powered, latch, latch_servo, send_goal
from armctl.dynamixel import ax12a
from armctl.messages import Mode

PAUSE_AGE_S = 0.2
"""A servo unheard for this long is not just a lost reply."""
SILENT_AGE_S = 0.5
"""A servo unheard for this long latches a fault."""
BLOCKED_RAD = math.radians(8.0)
BLOCKED_NS = 300_000_000
LOAD_RATIO = 0.8
LOAD_NS = 2_000_000_000
"""Load above 80 % for this long: a servo's own trip is near."""
NOISE_S = 10.0
NOISE_SHARE = 0.1
TORQUE_OFF_TICKS = 2
"""After so many ticks a servo that was switched off must show it."""
POWERED = frozenset({Mode.HOLDING, Mode.MOVING, Mode.JOGGING, Mode.PARKING})


def detect_faults(s: Tick) -> None:
    """Latch the first fault of the sample; each test names the row of the fault matrix it implements."""
    if s.state.mode is Mode.FAULTED:
        return
    if not s.inputs.sample.port_open:
        latch(s, "PORT_GONE", "the serial port is gone (adapter unplugged?)")
        return
    if not s.state.connected:
        return
    silent = [i for i, joint in enumerate(s.joints) if joint.age_s > SILENT_AGE_S]
    # The ages of a silent bus straddle the bound: its servos were not heard last in one instant.
    if silent and len(s.joints) > 1 and all(joint.age_s > PAUSE_AGE_S for joint in s.joints):
        latch(s, "BUS_DEAD", "no servo has answered for 0.5 s")
    elif silent:
        latch_servo(s, "SERVO_SILENT", silent[0], "no reply for 0.5 s")
    elif s.state.mode in POWERED:
        _detect_power_faults(s)
        if s.state.fault is None:
            _detect_strain(s)
        if s.state.fault is None:
            _detect_noise(s)
    elif s.state.adopted and _should_be_limp(s):
        powered = [
            i
            for i, (r, reading) in enumerate(zip(s.registers, s.inputs.sample.servos, strict=True))
            if reading.fresh and r is not None and r.torque_enabled
        ]
        if powered:
            latch_servo(s, "NOT_LIMP", powered[0], "torque is on although the arm is limp, and not from here")


def _should_be_limp(s: Tick) -> bool:
    if s.state.mode is Mode.TEACHING:
        return s.state.request_id is None
    return s.state.mode is Mode.OFF and s.state.phase > TORQUE_OFF_TICKS


def _detect_power_faults(s: Tick) -> None:
    """Lost torque, a trip, a second writer, a blocked joint: faults of an arm under torque."""
    goal, settings = s.state.goal, s.state.settings
    assert goal is not None
    previous = s.state.previous_goal or goal
    since = s.state.error_since_ns or (0,) * len(s.joints)
    known_since = since
    lost = False
    for i, (registers, reading) in enumerate(zip(s.registers, s.inputs.sample.servos, strict=True)):
        if registers is None or not reading.fresh:
            continue
        if registers.torque_limit == 0:
            return latch_servo(s, "TRIPPED", i, "the servo shut itself down (torque limit 0)")
        if not registers.torque_enabled:
            return latch_servo(s, "LOST_TORQUE", i, "torque is off, and not by a command from here")
        if registers.settings != settings[i]:
            if registers.settings == POWER_ON:
                return latch_servo(s, "LOST_TORQUE", i, "its settings are those of a servo that has just restarted")
            return latch_servo(s, "OTHER_WRITER", i, "its settings changed: another program writes to the bus")
        if registers.goal != goal[i]:
            if registers.goal != previous[i]:
                found = f"goal {registers.goal} read back, {goal[i]} sent"
                return latch_servo(s, "OTHER_WRITER", i, f"{found}: another program writes to the bus")
            lost = True
        error_rad = abs(registers.position - goal[i]) * ax12a.TICK_RAD
        if error_rad <= BLOCKED_RAD:
            if since[i]:
                since = (*since[:i], 0, *since[i + 1 :])
            continue
        if not since[i]:
            since = (*since[:i], s.inputs.now_ns, *since[i + 1 :])
        if s.inputs.now_ns - since[i] >= BLOCKED_NS:
            latch_servo(s, "BLOCKED", i, f"{math.degrees(error_rad):.1f} deg away from its goal for 0.3 s (bound 8)")
            # Once, so that the servo stops pushing; never again and again, or gravity walks the arm down.
            if s.fresh and all_powered(s):
                send_goal(s, [r.position if r else g for r, g in zip(s.registers, goal, strict=True)])
            return None
    if since is not known_since or not s.state.error_since_ns:
        s.state = replace(s.state, error_since_ns=since)
    if lost and s.fresh:
        send_goal(s, goal)
    return None


def _detect_strain(s: Tick) -> None:
    """Heat, voltage and lasting load: what comes before a servo's own trip."""
    since = s.state.load_since_ns or (0,) * len(s.joints)
    known_since = since
    low_V, high_V = s.arm.voltage_V
    limit_degC = s.arm.temperature_limit_degC
    for i, (joint, reading) in enumerate(zip(s.joints, s.inputs.sample.servos, strict=True)):
        if not reading.fresh:
            continue
        if joint.temperature_degC >= limit_degC or (reading.error and reading.error & ax12a.ErrorBit.OVERHEAT):
            return latch_servo(s, "HOT", i, f"{joint.temperature_degC:g} degC (bound {limit_degC:g})")
        if not low_V <= joint.voltage_V <= high_V or (reading.error and reading.error & ax12a.ErrorBit.VOLTAGE):
            return latch_servo(s, "VOLTAGE", i, f"{joint.voltage_V:.1f} V (bounds {low_V:g} to {high_V:g})")
        if abs(joint.load_ratio) <= LOAD_RATIO:
            if since[i]:
                since = (*since[:i], 0, *since[i + 1 :])
            continue
        if not since[i]:
            since = (*since[:i], s.inputs.now_ns, *since[i + 1 :])
        if s.inputs.now_ns - since[i] >= LOAD_NS:
            return latch_servo(s, "OVERLOAD", i, f"load {abs(joint.load_ratio):.0%} for 2 s (bound 80%)")
    if since is not known_since:
        s.state = replace(s.state, load_since_ns=since)
    return None


def _detect_noise(s: Tick) -> None:
    noisy = sum(reading.problem == "BUS_NOISE" for reading in s.inputs.sample.servos)
    if not noisy and not s.state.noise:
        return
    # The window begins with the first damaged reply, and ends when none is left in it.
    length = round(NOISE_S / s.period_s)
    noise = (*s.state.noise[1 - length :], noisy)
    total = sum(noise)
    s.state = replace(s.state, noise=noise if total else ())
    if total > NOISE_SHARE * length * len(s.joints):
        share = total / (len(noise) * len(s.joints))
        latch(s, "BUS_NOISE", f"{share:.0%} of the replies came damaged in {len(noise) * s.period_s:.0f} s (bound 10%)")
