"""One joint of a simulated arm: a mass on a motor with friction, in the servo's own direction (CCW positive).

Integrated at 1 kHz by semi-implicit Euler, in `steps.py`:

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

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.sim import steps
from armctl.sim.drive import Drive
from armctl.sim.servo import SimulatedServo
from armctl.sim.state import State
from armctl.sim.steps import STEP_S


class _Number:
    """A number of a joint that lies in the arm's state."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, joint: Joint, _: type[Joint]) -> float:
        return joint.state.numbers[joint.at + self._place]

    def __set__(self, joint: Joint, value: float) -> None:
        joint.state.numbers[joint.at + self._place] = value


class _Count:
    """A whole number of a joint that lies in the arm's state."""

    def __init__(self, place: int) -> None:
        self._place = place

    def __get__(self, joint: Joint, _: type[Joint]) -> int:
        return joint.state.counts[joint.of + self._place]

    def __set__(self, joint: Joint, value: int) -> None:
        joint.state.counts[joint.of + self._place] = value


class Joint:
    """One joint of the arm's state, and its servo: angles are the servo's, angle = tick * TICK_RAD."""

    shaft, motor, omega = _Number(steps.SHAFT), _Number(steps.MOTOR), _Number(steps.OMEGA)
    output, effort = _Number(steps.OUTPUT), _Number(steps.EFFORT)
    direction, zero_rad = _Number(steps.DIRECTION), _Number(steps.ZERO)
    coulomb, stiction, half_play = _Number(steps.COULOMB), _Number(steps.STICTION), _Number(steps.HALF_PLAY)
    stall, brake = _Number(steps.STALL), _Number(steps.BRAKE)
    load, rate = _Number(steps.LOAD), _Number(steps.RATE)
    ahead, dead_motor = _Count(steps.AHEAD), _Count(steps.DEAD)
    booting, boot_step = _Count(steps.BOOTING), _Count(steps.BOOT_STEP)

    def __init__(
        self,
        state: State,
        i: int,
        servo: SimulatedServo,
        *,
        direction: float,
        zero_rad: float,
        rest_rad: float,
        coulomb: float,
        stiction: float,
        half_play: float,
        low: float,
        high: float,
        stall: float,
        brake: float,
        shaft: float,
    ) -> None:
        """Joint i of a state, standing still.

        Args:
            zero_rad: Shaft angle at joint position 0, the zero offset included.
            rest_rad: The joint position in the rest pose.
            stall: Torque at the rated supply [N m].
            brake: What the motor loses by turning [N m s].
            shaft: Where it is [rad].
        """
        self.state, self.servo = state, servo
        self.at, self.of = steps.ARM_NUMBERS + i * steps.JOINT_NUMBERS, steps.ARM_COUNTS + i * steps.JOINT_COUNTS
        constants = (direction, zero_rad, rest_rad, coulomb, stiction, half_play, low, high, stall, brake)
        for place, value in enumerate(constants, self.at + steps.DIRECTION):
            state.numbers[place] = value
        self._ends = low, high
        self.shaft = self.motor = shaft
        self.rate = STEP_S
        state.numbers[self.at + steps.WEIGHED_AT] = float("inf")
        self.freeze(None)
        self.writes, self.drive = servo.writes, servo.drive
        self._alarms = servo.alarm_registers
        self.drive_by(self.drive)
        self._load_alarms()

    def position_rad(self) -> float:
        return self.direction * (self.shaft - self.zero_rad)

    @property
    def held(self) -> bool:
        """Whether something holds the shaft where it is."""
        numbers, at = self.state.numbers, self.at
        return numbers[at + steps.LOW] == numbers[at + steps.HIGH]

    def hold(self, at_rad: float | None) -> None:
        """Let the shaft go no further than an angle both ways; None: its own ends."""
        low, high = self._ends if at_rad is None else (at_rad, at_rad)
        self.state.numbers[self.at + steps.LOW], self.state.numbers[self.at + steps.HIGH] = low, high

    def freeze(self, tick: int | None) -> None:
        """Let the servo read the same for ever; None: its sensor works."""
        self.state.counts[self.of + steps.FROZEN] = -1 if tick is None else tick

    def pull(self, aim_rad: float, speed_rad_s: float) -> None:
        """Take note of where a hand wants the joint, and how fast."""
        numbers, at = self.state.numbers, self.at
        direction = numbers[at + steps.DIRECTION]
        numbers[at + steps.AIM] = numbers[at + steps.ZERO] + direction * aim_rad
        numbers[at + steps.AIM_SPEED] = direction * speed_rad_s

    def obey(self) -> bool:
        """Take note of what was written to the servo; whether the arm may go on resting."""
        servo, drive = self.servo, self.servo.drive
        self.writes, same = servo.writes, drive is self.drive
        if not same:
            same, self.drive = drive == self.drive, drive
            self.drive_by(drive)
        alarms = servo.alarm_registers
        if alarms != self._alarms:
            self._alarms = alarms
            self._load_alarms()
        return same and (not drive.enabled or drive.spin is not None or servo.reference_tick == drive.goal_tick)

    def drive_by(self, drive: Drive) -> None:
        """Let another drive rule the motor; its ramp begins where the reference is."""
        numbers, counts, at, of = self.state.numbers, self.state.counts, self.at, self.of
        numbers[at + steps.GOAL] = drive.goal_tick
        numbers[at + steps.RAMP] = drive.ramp_tick_s * STEP_S
        numbers[at + steps.LIMIT] = drive.output_limit
        numbers[at + steps.PUNCH] = drive.punch
        numbers[at + steps.CW_GAIN] = drive.cw_gain
        numbers[at + steps.CCW_GAIN] = drive.ccw_gain
        numbers[at + steps.SPIN] = drive.spin or 0.0
        counts[of + steps.FRESH] = 1
        counts[of + steps.ENABLED] = drive.enabled
        counts[of + steps.SPINS] = drive.spin is not None
        counts[of + steps.CW_MARGIN] = drive.cw_margin
        counts[of + steps.CCW_MARGIN] = drive.ccw_margin

    def _load_alarms(self) -> None:
        for place, register in enumerate(self._alarms, self.of + steps.MAX_DEGC):
            self.state.counts[place] = register

    def look(self) -> None:
        """Take note of what the servo itself may have changed, or somebody else."""
        servo, numbers, at = self.servo, self.state.numbers, self.at
        if servo.reference_tick != numbers[at + steps.REFERENCE]:
            numbers[at + steps.REFERENCE] = servo.reference_tick
            self.state.counts[self.of + steps.FRESH] = 1
        numbers[at + steps.OUTPUT] = servo.output
        numbers[at + steps.DEGC] = servo.temperature_degC
        numbers[at + steps.SERVO_V] = servo.voltage_V
        self.state.counts[self.of + steps.OVERLOADED] = servo.overloaded

    def show(self) -> None:
        """Let the servo have what the physics made of it."""
        servo, at = self.servo, self.at
        (
            shaft,
            servo.velocity_rad_s,
            servo.output,
            servo.reference_tick,
            servo.temperature_degC,
            servo.voltage_V,
        ) = self.state.numbers[at : at + 6]
        servo.position_tick = shaft / TICK_RAD

    def ask(self, overload_s: float) -> None:
        """If the joint asks for it, let the servo shut down or go on booting."""
        counts, of = self.state.counts, self.of
        if counts[of + steps.ASKS]:
            counts[of + steps.ASKS] = 0
            self.servo.protect(overloaded=counts[of + steps.LOADED] * STEP_S > overload_s)
            self.servo.booting = counts[of + steps.BOOTING] != 0
