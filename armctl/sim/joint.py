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

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.sim import steps
from armctl.sim.drive import Drive
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import ArmSpec
from armctl.sim.steps import STEP_S

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
    enabled, goal = drive.enabled, float(drive.goal_tick)
    low, high = (joint.low, joint.high) if joint.held is None else (joint.held, joint.held)
    stall = brake = 0.0
    if enabled and not joint.dead_motor:
        stall = joint.stall * (voltage_V / RATED_V)
        brake = joint.stall / spec.no_load_speed_rad_s
    if joint.drive is not drive or servo.reference_tick != joint.ramp_end_tick:
        joint.drive, joint.ramped_steps, joint.ramp_begin_tick = drive, 0, servo.reference_tick
    step, start, ramp = joint.ramped_steps, joint.ramp_begin_tick, drive.ramp_tick_s * STEP_S
    if drive.spin is not None:
        start = goal
    elif not enabled:
        goal = start
    arrival = 0
    """In which step, counted from 1 at the ramp's begin, the reference reaches the goal."""
    if start != goal:
        arrival = math.ceil(abs(goal - start) / ramp) if ramp else 1
        if goal < start:
            ramp = -ramp
    aim, aim_speed, pulled = (0.0, 0.0, 0) if pull is None else pull
    shaft, motor, omega, output = steps.integrate(
        joint.shaft,
        joint.motor,
        joint.omega,
        step,
        count,
        start,
        goal,
        ramp,
        arrival,
        joint.load,
        STEP_S / joint.inertia,
        joint.coulomb,
        joint.stiction,
        joint.half_play,
        low,
        high,
        stall,
        brake,
        spec.shaft_friction_Nm,
        spec.play_speed_rad_s * STEP_S,
        -1 if servo.frozen_tick is None else servo.frozen_tick,
        enabled,
        enabled and drive.spin is not None,
        drive.spin or 0.0,
        drive.output_limit,
        drive.punch,
        drive.cw_margin,
        drive.ccw_margin,
        drive.cw_gain,
        drive.ccw_gain,
        pull is not None,
        aim,
        aim_speed,
        pulled - step - 1,
    )
    end = step + count
    moved = step < arrival or omega != 0.0 or omega != joint.omega or shaft != joint.shaft
    joint.shaft, joint.motor, joint.omega = shaft, motor, omega
    servo.position_tick = shaft / TICK_RAD
    servo.velocity_rad_s, servo.output = omega, output
    servo.reference_tick = joint.ramp_end_tick = goal if end >= arrival else start + ramp * end
    joint.ramped_steps = end
    return moved
