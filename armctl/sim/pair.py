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
from armctl.sim.joint import Joint


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

    def _follow_ramps(self, count: int, aim_age: int | None) -> None:
        """Let both references go on, step by step."""
        weight_Nm = self.gravity_Nm
        if self.second.blocked_rad is not None:
            self.blocked_rad = self.servo.shaft_rad
        for k in range(count):
            self.second.follow()
            first_tick, second_tick = [math.floor(it.ramp.at(it.ramp_steps + k + 1) + 0.5) for it in self.motors]
            self.gravity_Nm = weight_Nm + self.second.pull_Nm(second_tick)
            self._integrate(first_tick, 1, None if aim_age is None else aim_age + k)
        self.gravity_Nm = weight_Nm
        self.second.follow()


def paired(first: Joint, second: Joint, linkage: Linkage, offset_tick: float) -> tuple[FirstServo, SecondServo]:
    """Two joints as the two servos of the first one's, in the pose that this one has."""
    follower = SecondServo(**_parts(second), linkage=linkage, offset_tick=offset_tick)
    leader = FirstServo(**_parts(first), second=follower)
    follower.first, leader.motors = leader, (leader, follower)
    leader.coulomb_Nm += second.coulomb_Nm
    leader.stiction_Nm += second.stiction_Nm
    follower.follow()
    follower.servo.reference_tick = follower.servo.sensed_tick()
    return leader, follower


def _parts(joint: Joint) -> dict[str, Any]:
    return {part.name: getattr(joint, part.name) for part in fields(joint) if part.init}
