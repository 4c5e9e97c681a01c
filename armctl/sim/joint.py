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

from armctl.sim import steps
from armctl.sim.drive import Drive
from armctl.sim.servo import SimulatedServo
from armctl.sim.state import Count, Number, Seat
from armctl.sim.steps import STEP_S


class Joint(Seat):
    """One joint of the arm's state, and its servo: angles are the servo's, angle = tick * TICK_RAD."""

    shaft, motor, omega = Number(steps.SHAFT), Number(steps.MOTOR), Number(steps.OMEGA)
    effort = Number(steps.EFFORT)
    direction, zero_rad = Number(steps.DIRECTION), Number(steps.ZERO)
    coulomb, stiction, half_play = Number(steps.COULOMB), Number(steps.STICTION), Number(steps.HALF_PLAY)
    stall, brake = Number(steps.STALL), Number(steps.BRAKE)
    load, rate = Number(steps.LOAD), Number(steps.RATE)
    ahead, dead_motor = Count(steps.AHEAD), Count(steps.DEAD)
    boot_step = Count(steps.BOOT_STEP)

    def __init__(
        self,
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
        """The joint in the seat of its servo, standing still.

        Args:
            zero_rad: Shaft angle at joint position 0, the zero offset included.
            rest_rad: The joint position in the rest pose.
            stall: Torque at the rated supply [N m].
            brake: What the motor loses by turning [N m s].
            shaft: Where it is [rad].
        """
        super().__init__(servo.state, servo.i)
        self.servo = servo
        constants = (direction, zero_rad, rest_rad, coulomb, stiction, half_play, low, high, stall, brake)
        for place, value in enumerate(constants, self.at + steps.DIRECTION):
            self.numbers[place] = value
        self._ends = low, high
        self.shaft = self.motor = shaft
        self.rate = STEP_S
        self.numbers[self.at + steps.WEIGHED_AT] = float("inf")
        self.writes, self.drive = servo.writes, servo.drive
        self.drive_by(self.drive)

    def position_rad(self) -> float:
        return self.direction * (self.shaft - self.zero_rad)

    @property
    def held(self) -> bool:
        """Whether something holds the shaft where it is."""
        numbers, at = self.numbers, self.at
        return numbers[at + steps.LOW] == numbers[at + steps.HIGH]

    def hold(self, at_rad: float | None) -> None:
        """Let the shaft go no further than an angle both ways; None: its own ends."""
        low, high = self._ends if at_rad is None else (at_rad, at_rad)
        self.numbers[self.at + steps.LOW], self.numbers[self.at + steps.HIGH] = low, high

    def pull(self, aim_rad: float, speed_rad_s: float) -> None:
        """Take note of where a hand wants the joint, and how fast."""
        numbers, at = self.numbers, self.at
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
        return same and (not drive.enabled or drive.spin is not None or servo.reference_tick == drive.goal_tick)

    def drive_by(self, drive: Drive) -> None:
        """Let another drive rule the motor; its ramp begins where the reference is."""
        numbers, counts, at, of = self.numbers, self.counts, self.at, self.of
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

    def ask(self) -> None:
        """If the joint asks for it, let the servo shut down."""
        counts, of = self.counts, self.of
        if counts[of + steps.ASKS]:
            counts[of + steps.ASKS] = 0
            self.servo.protect()
