"""One joint of a simulated arm: a motor that turns a link, in the servo's own direction (CCW positive).

Integrated at 1 kHz by semi-implicit Euler:

    output  = that of the position controller (`drive.py`) at the error between reference and sensed shaft
    motor   = stall_torque * output * voltage / 12 V - stall_torque / no_load_speed * velocity     (nothing when limp)
    torque  = motor + gravity + hand
    inertia * acceleration = torque - Coulomb friction; from rest only if the torque exceeds the stiction
    both frictions grow with what gravity lays on the gears, and fall as the motor gets warm

The shaft, which the position sensor sees and the link hangs on, follows the motor through a play: gravity and hand
push it to one flank; without them it is dragged along.

Two ideas save most of the time, and both give the same as computing every step:

- The error is counted in whole ticks. So the output stays until the reference or the shaft comes to another tick.
- Where stiction holds a joint nothing changes until its reference comes to another tick. So the steps up to there
  are skipped.
"""

import math
from collections import deque
from dataclasses import dataclass, field

from armctl.sim.drive import Drive, Ramp
from armctl.sim.geometry import Deviation
from armctl.sim.hand import hand_torque
from armctl.sim.potentiometer import sensed_range
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import ArmSpec

STEP_S = 1e-3
# The supply at which stall torque and no-load speed are stated.
RATED_V = 12.0


@dataclass(slots=True, eq=False)
class Joint:
    """One joint and its servo: angles are the servo's, angle = tick * TICK_RAD."""

    # Knows the shaft: its angle, velocity and all else that a register reports.
    servo: SimulatedServo
    spec: ArmSpec
    # 1.0 or -1.0: the joint position grows with the shaft angle, or falls.
    direction: float
    # Shaft angle at joint position 0, the zero offset included.
    zero_rad: float
    # The joint position in the rest pose.
    rest_rad: float
    coulomb_Nm: float
    stiction_Nm: float
    half_play_rad: float
    stops_rad: tuple[float, float]
    # Torque at the rated supply.
    stall_Nm: float
    # What friction grows by, as a share of the torque that the gears carry.
    load_friction: float = 0.0
    # From a write until the controller follows it.
    dead_steps: int = 0

    # The motor's angle behind its gears; the shaft's differs by the play.
    motor_rad: float = field(init=False)
    gravity_Nm: float = 0.0
    # How much velocity a torque gives in a step [rad/s per N m].
    step_over_inertia: float = STEP_S
    # The shaft angle for which gravity and inertia were computed.
    gravity_shaft_rad: float = math.inf
    # Motor current, as a fraction of the stall current.
    effort: float = 0.0
    # How far it is integrated: steps since the arm's begin.
    step: int = 0
    drive: Drive = field(init=False)
    # The servo's count of writes when its drive was taken over.
    writes: int = field(init=False)
    # Drives that the controller does not follow yet: from which step on, and whether the ramp begins at the shaft.
    late: deque[tuple[int, Drive, bool]] = field(default_factory=deque)
    # What heat leaves of friction.
    warmth: float = 1.0
    ramp: Ramp = field(init=False)
    # Steps since the ramp's begin.
    ramp_steps: int = 0
    # Where the ramp left the servo's reference. If the servo says otherwise, a new ramp begins.
    reference_tick: float = math.nan
    # For how long the effort has been too high.
    overload_steps: int = 0
    # When the firmware will have started.
    boot_end_step: int = 0
    dead_motor: bool = False
    # Where something holds the shaft.
    blocked_rad: float | None = None
    # Where a hand wanted the shaft when the chunk began.
    aim_rad: float = 0.0
    aim_rad_s: float = 0.0
    # Of the link from the shaft; None: the link is where the sensor shows the shaft.
    deviation: Deviation | None = None
    # What turns the shaft: this one, and the second servo of a pair.
    motors: tuple["Joint", ...] = field(init=False)

    def __post_init__(self) -> None:
        self.motors = (self,)
        self.motor_rad = self.servo.shaft_rad
        self.drive, self.writes = self.servo.drive, self.servo.writes

    def position_rad(self) -> float:
        """Of the link: what the kinematics calls the joint position."""
        shaft_rad = self.servo.shaft_rad
        if self.deviation is not None:
            shaft_rad += self.deviation.at(shaft_rad)
        return self.direction * (shaft_rad - self.zero_rad)

    def settle(self, *, carried: bool) -> None:
        """Let the link come to where its load has it.

        Args:
            carried: A hand carries the link, so that its weight does not go through the shaft.
        """
        if self.deviation is not None:
            self.deviation.settle(self.servo.shaft_rad, 0.0 if carried else self.gravity_Nm)

    def take_aim(self, position_rad: float, velocity_rad_s: float) -> None:
        """Note where a hand wants the joint, and how fast."""
        self.aim_rad = self.zero_rad + self.direction * position_rad
        if self.deviation is not None:
            self.aim_rad -= self.deviation.settled_rad
        self.aim_rad_s = self.direction * velocity_rad_s

    def take_drive(self) -> bool:
        """Take over what was written to the servo, now or after its dead time; whether nothing has to move for it."""
        servo, drive = self.servo, self.servo.drive
        restarts, servo.ramp_restarts = servo.ramp_restarts, False
        self.writes = servo.writes
        if self.dead_steps and drive.enabled and self.drive.enabled:
            if drive != (self.late[-1][1] if self.late else self.drive) or restarts:
                self.late.append((self.step + self.dead_steps, drive, restarts))
            return not self.late and servo.reference_tick == drive.goal_tick
        self.late.clear()
        same = self._follow(drive, restarts)
        return same and (not drive.enabled or drive.spin is not None or servo.reference_tick == drive.goal_tick)

    def _follow(self, drive: Drive, restarts: bool) -> bool:
        """Have the controller work by a drive from now on; whether it did before."""
        same = drive == self.drive and not restarts
        if restarts:
            self.servo.reference_tick = self.servo.sensed_tick()
        if not same:
            self.drive, self.reference_tick = drive, math.nan  # its ramp begins where the reference is
        return same

    def advance(self, until_step: int, aim_step: int | None) -> bool:
        """Let time pass; whether anything about the joint changes.

        Args:
            until_step: The step to come to.
            aim_step: The step to which the hand's aim belongs; None: no hand pulls.
        """
        changes = any(motor.late for motor in self.motors)
        while due := [motor for motor in self.motors if motor.late and motor.late[0][0] <= until_step]:
            motor = min(due, key=lambda it: it.late[0][0])
            step, drive, restarts = motor.late.popleft()
            self._advance(step, aim_step)
            motor._follow(drive, restarts)
        return self._advance(until_step, aim_step) or changes

    def _advance(self, until_step: int, aim_step: int | None) -> bool:
        """The same with one drive of each motor."""
        count = until_step - self.step
        if count <= 0:
            return False
        servo, ramping = self.servo, False
        for motor in self.motors:
            if motor.servo.reference_tick != motor.reference_tick:
                motor.ramp, motor.ramp_steps = motor.drive.ramp(motor.servo.reference_tick, STEP_S), 0
            ramping |= motor.ramp_steps < motor.ramp.arrival
        shaft_rad, velocity_rad_s = servo.shaft_rad, servo.velocity_rad_s
        self._follow_ramps(count, None if aim_step is None else self.step - aim_step)
        for motor in self.motors:
            motor.step, motor.ramp_steps = until_step, motor.ramp_steps + count
            motor.reference_tick = motor.servo.reference_tick = motor.ramp.at(motor.ramp_steps)
        waiting = [motor._check_alarms(count) for motor in self.motors]
        moved = servo.velocity_rad_s != 0.0 or velocity_rad_s != 0.0 or servo.shaft_rad != shaft_rad
        return ramping or moved or any(waiting)

    def _follow_ramps(self, count: int, aim_age: int | None) -> None:
        """Let the reference go on, and integrate from each of its whole ticks to the next."""
        ramp, step = self.ramp, self.ramp_steps
        end = step + count
        while step < end:
            whole_tick = math.floor(ramp.at(step + 1) + 0.5)
            last = ramp.last_step_at(whole_tick, step + 1, end)
            self._integrate(whole_tick, last - step, aim_age)
            if aim_age is not None:
                aim_age += last - step
            step = last

    def _integrate(self, reference_tick: int, count: int, aim_age: int | None) -> None:
        """Integrate `count` steps with one reference.

        Args:
            aim_age: Steps since the hand's aim was taken; None: no hand pulls.
        """
        servo, rate, half_play = self.servo, self.step_over_inertia, self.half_play_rad
        friction = self.warmth
        if self.load_friction:
            friction += self.load_friction * abs(self.gravity_Nm) / self.coulomb_Nm
        coulomb, stiction = self.coulomb_Nm * friction, self.stiction_Nm * friction
        shaft, motor, velocity = servo.shaft_rad, self.motor_rad, servo.velocity_rad_s
        low, high = self.stops_rad if self.blocked_rad is None else (self.blocked_rad, self.blocked_rad)
        stall, brake = self._motor_constants()
        external = self.gravity_Nm
        drift = self._drift_through_play(external)
        begin, end = math.inf, -math.inf  # of the shaft angles that give the same output; none yet
        output = motor_torque = 0.0
        for age in range(aim_age or 0, (aim_age or 0) + count):
            # The controller, and the torque of its motor.
            if not begin <= shaft < end:
                output, begin, end = self._output(reference_tick, shaft)
                motor_torque = stall * output
            # What acts from outside.
            if aim_age is not None:
                behind = self.aim_rad + self.aim_rad_s * (age * STEP_S) - shaft
                external = self.gravity_Nm + hand_torque(behind, self.aim_rad_s - velocity)
                drift = self._drift_through_play(external)
            # Friction takes its part; stiction holds what stands.
            torque = motor_torque - brake * velocity + external
            stuck_at = None
            if velocity == 0.0 and -stiction <= torque <= stiction:
                stuck_at = shaft, motor
            else:
                velocity = sliding_velocity(velocity, torque, coulomb, rate)
            motor += velocity * STEP_S
            # The shaft is anywhere within the play around the motor.
            shaft += drift
            if shaft > motor + half_play:
                shaft = motor + half_play
            elif shaft < motor - half_play:
                shaft = motor - half_play
            # A stop holds shaft and motor back, and takes the velocity towards it.
            if shaft < low:
                motor, shaft, velocity = motor + low - shaft, low, max(velocity, 0.0)
            elif shaft > high:
                motor, shaft, velocity = motor + high - shaft, high, min(velocity, 0.0)
            if stuck_at == (shaft, motor) and aim_age is None:
                break  # every further step would give the same
        servo.shaft_rad, self.motor_rad, servo.velocity_rad_s, servo.output = shaft, motor, velocity, output

    def _motor_constants(self) -> tuple[float, float]:
        """Torque at full output [N m], and against the velocity by back EMF [N m s]; a limp or dead motor has none."""
        if not self.drive.enabled or self.dead_motor:
            return 0.0, 0.0
        return self.stall_Nm * (self.servo.voltage_V / RATED_V), self.stall_Nm / self.spec.no_load_speed_rad_s

    def _output(self, reference_tick: int, shaft_rad: float) -> tuple[float, float, float]:
        """Output of the controller, and the shaft angles between which it stays: from the first to below the second."""
        drive, frozen_tick = self.drive, self.servo.frozen_tick
        sensed, begin, end = sensed_range(shaft_rad) if frozen_tick is None else (frozen_tick, -math.inf, math.inf)
        if not drive.enabled:
            return 0.0, begin, end
        return drive.output(reference_tick - sensed) if drive.spin is None else drive.spin, begin, end

    def _drift_through_play(self, external_Nm: float) -> float:
        """How far a torque pushes the shaft through its play in a step [rad]; friction holds it against less."""
        friction_Nm = self.spec.shaft_friction_Nm
        if -friction_Nm <= external_Nm <= friction_Nm:
            return 0.0
        slip_rad = self.spec.play_speed_rad_s * STEP_S
        return slip_rad if external_Nm > 0.0 else -slip_rad

    def _check_alarms(self, count: int) -> bool:
        """Look for overload, heat, voltage and the end of a start; whether some of it only waits for time to pass."""
        servo, spec, enabled = self.servo, self.spec, self.drive.enabled
        # The current follows the voltage that the turning motor does not bring up itself.
        self.effort = servo.output - servo.velocity_rad_s / spec.no_load_speed_rad_s if servo.output != 0.0 else 0.0
        straining = enabled and not -spec.overload_output <= self.effort <= spec.overload_output
        self.overload_steps = self.overload_steps + count if straining else 0
        if self.overload_steps * STEP_S > spec.overload_s:
            servo.overloaded = True
        booting = servo.booting
        servo.booting = booting and self.step < self.boot_end_step
        if enabled or booting != servo.booting:
            servo.protect()
        return straining or booting


def sliding_velocity(velocity: float, torque_Nm: float, coulomb_Nm: float, step_over_inertia: float) -> float:
    """Velocity [rad/s] a step later of a shaft that slides or breaks away.

    Coulomb friction works against the motion. It may stop the shaft, but never turns it round.
    """
    if velocity > 0.0 or (velocity == 0.0 and torque_Nm > 0.0):
        return max(velocity + (torque_Nm - coulomb_Nm) * step_over_inertia, 0.0)
    return min(velocity + (torque_Nm + coulomb_Nm) * step_over_inertia, 0.0)
