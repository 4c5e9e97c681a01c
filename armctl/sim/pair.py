"""Two simulated servos that turn one joint, each with a motor, a sensor and a controller of its own.

The first one's shaft is the joint's. The second one's follows it rigidly, by how the arm's file says that they read
against each other, and by an offset that the seed draws, as horns on splines have one. What the second motor gives acts
on the shaft from outside, beside gravity; friction is that of both. So two goals that do not belong together have the
motors push against each other, and the loads show it.
"""

import math
from dataclasses import dataclass, field, fields
from typing import Any

from armctl.dynamixel.ax12a import TICK_RAD
from armctl.pair import Linkage
from armctl.sim.joint import STEP_S, Joint


@dataclass(slots=True, eq=False)
class SecondServo(Joint):
    """The second servo's motor; it is integrated with the first one's."""

    linkage: Linkage = field(kw_only=True)
    # How far it is off that, and how far its horn has slipped besides.
    offset_tick: float = field(kw_only=True)
    slip_tick: float = 0.0
    first: "FirstServo" = field(init=False)

    def advance(self, until_step: int, aim_step: int | None) -> bool:
        return self.first.advance(until_step, aim_step)

    def position_rad(self) -> float:
        return self.first.position_rad()

    def follow(self) -> None:
        """Be where the first servo's shaft is, and as fast."""
        shaft = self.first.servo
        tick = self.linkage.second(shaft.shaft_rad / TICK_RAD) + self.offset_tick + self.slip_tick
        self.servo.shaft_rad = self.motor_rad = tick * TICK_RAD
        self.servo.velocity_rad_s = self.linkage.sense * shaft.velocity_rad_s

    def pull_Nm(self, reference_tick: int) -> float:
        """What it adds to the torque on the first servo's shaft."""
        stall, brake = self._motor_constants()
        self.servo.output, _, _ = self._output(reference_tick, self.servo.shaft_rad)
        return self.linkage.sense * (stall * self.servo.output - brake * self.servo.velocity_rad_s)


@dataclass(slots=True, eq=False)
class FirstServo(Joint):
    """A joint with a second servo on its shaft."""

    second: SecondServo = field(kw_only=True)

    def advance(self, until_step: int, aim_step: int | None) -> bool:
        changes = False
        while due := [it for it in (self, self.second) if it.late and it.late[0][0] <= until_step]:
            servo = min(due, key=lambda it: it.late[0][0])
            step, drive, restarts = servo.late.popleft()
            self._advance(step, aim_step)
            changes = not servo._follow(drive, restarts) or changes
        return self._advance(until_step, aim_step) or changes or bool(self.late or self.second.late)

    def _advance(self, until_step: int, aim_step: int | None) -> bool:
        count, both, servo = until_step - self.step, (self, self.second), self.servo
        if count <= 0:
            return False
        for it in both:
            if it.servo.reference_tick != it.reference_tick:
                it.ramp, it.ramp_steps = it.drive.ramp(it.servo.reference_tick, STEP_S), 0
        ramping = any(it.ramp_steps < it.ramp.arrival for it in both)
        shaft_rad, velocity_rad_s, weight_Nm = servo.shaft_rad, servo.velocity_rad_s, self.gravity_Nm
        if self.second.blocked_rad is not None:
            self.blocked_rad = servo.shaft_rad
        for k in range(count):
            self.second.follow()
            first_tick, second_tick = [math.floor(it.ramp.at(it.ramp_steps + k + 1) + 0.5) for it in both]
            self.gravity_Nm = weight_Nm + self.second.pull_Nm(second_tick)
            self._integrate(first_tick, 1, None if aim_step is None else self.step - aim_step + k)
        self.gravity_Nm = weight_Nm
        self.second.follow()
        for it in both:
            it.step, it.ramp_steps = until_step, it.ramp_steps + count
            it.reference_tick = it.servo.reference_tick = it.ramp.at(it.ramp_steps)
        waiting = [it._check_alarms(count) for it in both]
        moved = servo.velocity_rad_s != 0.0 or velocity_rad_s != 0.0 or servo.shaft_rad != shaft_rad
        return ramping or moved or any(waiting)


def paired(first: Joint, second: Joint, linkage: Linkage, offset_tick: float) -> tuple[FirstServo, SecondServo]:
    """Two joints as the two servos of the first one's, in the pose that this one has."""
    follower = SecondServo(**_parts(second), linkage=linkage, offset_tick=offset_tick)
    leader = FirstServo(**_parts(first), second=follower)
    follower.first = leader
    leader.coulomb_Nm += second.coulomb_Nm
    leader.stiction_Nm += second.stiction_Nm
    follower.follow()
    follower.servo.reference_tick = follower.servo.sensed_tick()
    return leader, follower


def _parts(joint: Joint) -> dict[str, Any]:
    return {part.name: getattr(joint, part.name) for part in fields(joint) if part.init}
