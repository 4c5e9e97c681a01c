"""One joint of a simulated arm: a mass on a motor with friction, in the servo's own direction (CCW positive).

Integrated at 1 kHz by semi-implicit Euler:

    output  = 0 inside the margin, `punch` at its edge, then a ramp over the slope, capped by the torque limits;
              the error is counted in whole ticks between the reference and the quantised shaft
    motor   = stall_torque * (output * voltage / 12 V - velocity / no_load_speed)      (nothing at all when limp)
    inertia * acceleration = motor + gravity + hand - friction

The shaft, which the potentiometer sees and the link hangs on, follows the motor through a play: gravity and hand
push it to one flank; without them it is dragged along. The reference ramps to the goal at the moving speed.

Because the error is counted in whole ticks, the output stays until the reference or the shaft has come to another
tick: it is computed there and nowhere else. A joint that its friction holds is left alone until the reference gets
to another tick. Both give the same as computing every step.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

from armctl.dynamixel.ax12a import TICK_MAX, TICK_RAD
from armctl.sim.drive import Drive
from armctl.sim.hand import Hand
from armctl.sim.servo import SimulatedServo, sensed_tick
from armctl.sim.spec import ArmSpec

STEP_S = 1e-3
HIGHEST_RAD = TICK_MAX * TICK_RAD
RATED_V = 12.0
"""The supply at which stall torque and no-load speed are stated."""


@dataclass(slots=True)
class Joint:
    """Constants and state of one joint, in the servo's direction: angle = tick * TICK_RAD."""

    direction: int
    zero_rad: float
    """Shaft angle at joint position 0, the zero offset included."""
    coulomb: float
    stiction: float
    half_play: float
    low: float
    high: float
    shaft: float
    motor: float
    stall: float = 0.0
    """Torque at the rated supply."""
    omega: float = 0.0
    load: float = 0.0
    """Torque of gravity on the shaft."""
    inertia: float = 1.0
    weighed: float = math.inf
    """The shaft's angle that load and inertia belong to."""
    drive: Drive | None = None
    """What the reference ramps by, and since when: the same sum however time is cut."""
    ramped_steps: int = 0
    ramp_begin_tick: float = 0.0
    ramp_end_tick: float = 0.0
    """Where the ramp has left the reference; another value there is a new begin."""
    ahead: int = 0
    """Steps it has been integrated beyond the arm's time."""
    loaded_steps: int = 0
    dead_motor: bool = False
    held: float | None = None
    """Where something holds the shaft."""
    boot_step: int = 0
    """When its firmware runs again, while it is booting."""

    def position_rad(self) -> float:
        return self.direction * (self.shaft - self.zero_rad)


def turn(
    joint: Joint,
    servo: SimulatedServo,
    drive: Drive,
    spec: ArmSpec,
    voltage_V: float,
    count: int,
    pull: tuple[float, float, int] | None,
) -> bool:
    """Integrate `count` steps of a joint under its present load; whether anything about it changed.

    Args:
        pull: Where the hand wants the shaft [rad] and how fast [rad/s], so many steps ago; None: no hand.
    """
    enabled, spin, goal = drive.enabled, drive.spin, float(drive.goal_tick)
    rate = STEP_S / joint.inertia
    coulomb, stiction, half_play = joint.coulomb, joint.stiction, joint.half_play
    low, high = (joint.low, joint.high) if joint.held is None else (joint.held, joint.held)
    stall = brake = 0.0
    if enabled and not joint.dead_motor:
        stall = joint.stall * (voltage_V / RATED_V)
        brake = joint.stall / spec.no_load_speed_rad_s
    shaft, motor, omega = joint.shaft, joint.motor, joint.omega
    if joint.drive is not drive or servo.reference_tick != joint.ramp_end_tick:
        joint.drive, joint.ramped_steps, joint.ramp_begin_tick = drive, 0, servo.reference_tick
    step, start, ramp = joint.ramped_steps, joint.ramp_begin_tick, drive.ramp_tick_s * STEP_S
    if spin is not None:
        start = goal
    elif not enabled:
        goal = start
    arrival = 0
    """In which step, counted from 1 at the ramp's begin, the reference reaches the goal."""
    if start != goal:
        arrival = math.ceil(abs(goal - start) / ramp) if ramp else 1
        if goal < start:
            ramp = -ramp
    ramping, end = step < arrival, step + count
    pulled = 0 if pull is None else pull[2] - step - 1
    external = joint.load
    drift = _drift(external, spec)
    output = push = 0.0
    near, far, sensed = math.inf, -math.inf, 0
    held = False
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
                    sensed, near, far = _sense(servo, shaft, low, high)
                if enabled:
                    output = drive.output(whole - sensed) if spin is None else spin
                push = stall * output
            if pull is not None:
                behind, slower = pull[0] + pull[1] * ((pulled + now) * STEP_S) - shaft, pull[1] - omega
                external = joint.load + Hand.torque(behind, slower)
                drift = _drift(external, spec)
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
                held, before = True, (shaft, motor)
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
                if (shaft, motor) == before and pull is None:
                    break  # and so would every further step up to `last`
        step = last
    moved = ramping or omega != 0.0 or omega != joint.omega or shaft != joint.shaft
    joint.shaft, joint.motor, joint.omega = shaft, motor, omega
    servo.position_tick = shaft / TICK_RAD
    servo.velocity_rad_s, servo.output = omega, output
    servo.reference_tick = joint.ramp_end_tick = goal if end >= arrival else start + ramp * end
    joint.ramped_steps = end
    return moved


def _drift(external: float, spec: ArmSpec) -> float:
    """How far a torque pushes the shaft through its play in a step."""
    if -spec.shaft_friction_Nm <= external <= spec.shaft_friction_Nm:
        return 0.0
    return math.copysign(spec.play_speed_rad_s * STEP_S, external)


def _sense(servo: SimulatedServo, shaft: float, low: float, high: float) -> tuple[int, float, float]:
    """What the servo takes its shaft for [tick], and the angles from near to below far that it takes for the same."""
    if servo.frozen_tick is not None:
        return servo.frozen_tick, low, high
    if low < 0.0 or high > HIGHEST_RAD:
        return sensed_tick(shaft / TICK_RAD), math.inf, -math.inf
    sensed = math.floor(shaft / TICK_RAD + 0.5)
    near = (sensed - 0.5) * TICK_RAD
    far = near + TICK_RAD
    return sensed, near if near > low else low, far if far < high else high
