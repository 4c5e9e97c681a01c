"""The millisecond steps of one simulated joint, as functions of plain numbers; `joint.py` has the equations.

Nothing here knows of servos or registers, so that numba can make machine code of it: `compiled`, once in a process,
makes what takes the most time of a simulation about a hundred times faster, bit for bit the same. Without numba
(the extra `fast`) everything runs as it stands.
"""

from __future__ import annotations

import functools
import math

from armctl.dynamixel.ax12a import TICK_MAX, TICK_RAD

STEP_S = 1e-3
HIGHEST_RAD = TICK_MAX * TICK_RAD
TURN_TICK = 2.0 * math.pi / TICK_RAD
EDGE_TICK = 10.0
"""The resistive track ends this far beyond 0 and 1023: a guess."""
STIFFNESS_NM_RAD = 60.0
DAMPING_NM_S = 0.6
MAX_TORQUE_NM = 2.0
"""Of the hand that guides the arm."""


@functools.cache
def compiled() -> bool:
    """Let the functions below run as machine code from now on; whether they do: numba has to be there for it."""
    try:
        from numba import njit
    except ImportError:
        return False
    for name in ("sensed_tick", "output_at", "hand_torque", "play_drift", "integrate"):
        plain = globals()[name]
        try:
            globals()[name] = njit(cache=True)(plain)
        except RuntimeError:  # nowhere to keep machine code: it is made anew
            globals()[name] = njit(plain)
    return True


def sensed_tick(position_tick: float) -> int:
    """What the potentiometer reads at a shaft angle, the dead zone included."""
    tick = math.floor(position_tick + 0.5)
    if 0 <= tick <= TICK_MAX:
        return tick
    turned = position_tick % TURN_TICK
    if turned > TURN_TICK - EDGE_TICK:
        return 0
    if turned > TICK_MAX + EDGE_TICK:
        return int(turned * 64.0) * 0x9E3779B1 >> 12 & TICK_MAX  # erratic, yet the same at the same angle
    return min(math.floor(turned + 0.5), TICK_MAX)


def output_at(
    error_tick: int, limit: float, punch: float, cw_margin: int, ccw_margin: int, cw_gain: float, ccw_gain: float
) -> float:
    """Output at a distance from the goal [tick], CCW positive: 0 in the margin, then punch and slope."""
    if error_tick > ccw_margin:
        output = punch + (error_tick - ccw_margin) * ccw_gain
        return output if output < limit else limit
    if error_tick < -cw_margin:
        output = punch - (error_tick + cw_margin) * cw_gain
        return -output if output < limit else -limit
    return 0.0


def hand_torque(behind_rad: float, slower_rad_s: float) -> float:
    """Torque of the hand [N m] on a joint that is so far behind its aim and so much slower."""
    torque = STIFFNESS_NM_RAD * behind_rad + DAMPING_NM_S * slower_rad_s
    return min(max(torque, -MAX_TORQUE_NM), MAX_TORQUE_NM)


def play_drift(external_Nm: float, friction_Nm: float, slip_rad: float) -> float:
    """How far a torque pushes the shaft through its play in a step [rad]; its friction holds it against less."""
    if -friction_Nm <= external_Nm <= friction_Nm:
        return 0.0
    return slip_rad if external_Nm > 0.0 else -slip_rad


def integrate(
    shaft: float,
    motor: float,
    omega: float,
    step: int,
    count: int,
    start: float,
    goal: float,
    ramp: float,
    arrival: int,
    load: float,
    rate: float,
    coulomb: float,
    stiction: float,
    half_play: float,
    low: float,
    high: float,
    stall: float,
    brake: float,
    friction: float,
    slip: float,
    frozen_tick: int,
    enabled: bool,
    spins: bool,
    spin: float,
    limit: float,
    punch: float,
    cw_margin: int,
    ccw_margin: int,
    cw_gain: float,
    ccw_gain: float,
    pulls: bool,
    aim: float,
    aim_speed: float,
    pulled: int,
) -> tuple[float, float, float, float]:
    """Let `count` steps pass; shaft [rad], motor [rad], its velocity [rad/s] and its output afterwards.

    Args:
        step: Steps taken since the ramp's begin, at `start` [tick].
        ramp: Its way in a step [tick], with its sign.
        arrival: The step in which the reference gets to the goal.
        rate: Step over inertia.
        stall, brake: Torque of the motor at full output [N m], and against its velocity [N m s]; 0: no motor.
        frozen_tick: What a frozen sensor reads; -1: it works.
        spins: Whether in wheel mode, at the output `spin`.
        pulls: Whether a hand pulls the shaft to `aim` [rad], which moves at `aim_speed` [rad/s] since step `-pulled`.
    """
    end = step + count
    external = load
    drift = play_drift(external, friction, slip)
    output = push = 0.0
    near, far, sensed = math.inf, -math.inf, 0
    held = False
    held_shaft = held_motor = 0.0
    while step < end:
        step += 1
        whole = math.floor((goal if step >= arrival else start + ramp * step) + 0.5)
        last = end
        if step < arrival and whole != goal:  # the last step before the reference gets to another tick
            if ramp > 0.0:
                last = min(end, max(step, math.ceil((whole + 0.5 - start) / ramp) - 1))
            else:
                last = min(end, max(step, math.floor((whole - 0.5 - start) / ramp)))
        stale = True
        for now in range(step, last + 1):
            if stale:
                stale = False
                if not near <= shaft < far:
                    # What the servo takes its shaft for, and the angles from near to below far it takes for the same.
                    if frozen_tick >= 0:
                        sensed, near, far = frozen_tick, low, high
                    elif low < 0.0 or high > HIGHEST_RAD:
                        sensed = sensed_tick(shaft / TICK_RAD)
                    else:
                        sensed = math.floor(shaft / TICK_RAD + 0.5)
                        near = (sensed - 0.5) * TICK_RAD
                        far = near + TICK_RAD
                        near = max(near, low)
                        far = min(far, high)
                if spins:
                    output = spin
                elif enabled:
                    output = output_at(whole - sensed, limit, punch, cw_margin, ccw_margin, cw_gain, ccw_gain)
                push = stall * output
            if pulls:
                external = load + hand_torque(aim + aim_speed * ((pulled + now) * STEP_S) - shaft, aim_speed - omega)
                drift = play_drift(external, friction, slip)
            torque = push - brake * omega + external
            if omega > 0.0:
                omega += (torque - coulomb) * rate
                if omega < 0.0:
                    omega = 0.0
            elif omega < 0.0:
                omega += (torque + coulomb) * rate
                if omega > 0.0:
                    omega = 0.0
            elif torque > stiction:
                omega = (torque - coulomb) * rate
            elif torque < -stiction:
                omega = (torque + coulomb) * rate
            else:
                held, held_shaft, held_motor = True, shaft, motor
            motor += omega * STEP_S
            shaft += drift
            if shaft > motor + half_play:
                shaft = motor + half_play
            elif shaft < motor - half_play:
                shaft = motor - half_play
            if not near <= shaft < far:
                stale = True
                if shaft < low:
                    motor, shaft, omega = motor + low - shaft, low, max(omega, 0.0)
                elif shaft > high:
                    motor, shaft, omega = motor + high - shaft, high, min(omega, 0.0)
            if held:
                held = False
                if shaft == held_shaft and motor == held_motor and not pulls:
                    break  # and so would every further step up to `last`
        step = last
    return shaft, motor, omega, output
