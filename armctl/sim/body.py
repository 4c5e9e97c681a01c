"""What couples the joints of a simulated arm: gravity, inertia, and the supply; and how warm its motors get.

Within a *chunk* of time every joint is on its own. What couples them is renewed between chunks: of 20 ms, and of 2 ms
while a joint is fast. That this is often enough is a test, against chunks of one step.

Because joints do not feel each other within a chunk, one of them may be ahead of the others there. A servo that is
read needs its own joint only; the others follow later, in fewer and longer pieces.
"""

import math
from collections.abc import Sequence

from armctl.sim.gravity import PointMasses
from armctl.sim.joint import STEP_S, Joint
from armctl.sim.spec import ArmSpec

CHUNK_STEPS = 20
# Steps of a chunk while a joint turns faster than `FAST_RAD_S`, as those of a falling arm do.
FAST_CHUNK_STEPS = 2
FAST_RAD_S = 1.0
# Gravity and inertia stay those of a configuration until a joint is further from it than this, or all stand still.
GRAVITY_RAD = 0.004


class Body:
    """The joints of one arm, and their common time in steps."""

    def __init__(self, joints: Sequence[Joint], masses: PointMasses, spec: ArmSpec) -> None:
        self.joints, self.masses, self.spec = joints, masses, spec
        # How far all joints are integrated, at least.
        self.step = 0
        self.chunk_begin = self.chunk_end = 0
        # What the supply gives without load.
        self.supply_V = spec.supply_V
        # Under the present load.
        self.voltage_V = spec.supply_V
        # Whether a hand pulls the joints to their aims.
        self.pulled = False
        # Nothing but temperatures will change until something from outside does.
        self.resting = False
        # Whether gravity and inertia belong to the very configuration of now.
        self._gravity_is_current = False
        # Whether anything did in this chunk.
        self._changed = False
        # Whether nothing did in the chunk before.
        self._still = True

    def advance(self, until_step: int, only: int | None) -> bool:
        """Let time pass to a step, or to the end of the chunk if that comes first.

        Args:
            only: Index of the one joint that will be looked at; None: all.
        Returns:
            Whether only this joint was brought to `until_step`.
        """
        if self.step >= self.chunk_end:
            self._begin_chunk()
        if only is not None and until_step < self.chunk_end:
            self._advance_joint(self.joints[only], until_step)
            return True
        self.step = min(until_step, self.chunk_end)
        for joint in self.joints:
            self._advance_joint(joint, self.step)
        if self.step == self.chunk_end:
            self._end_chunk()
        return False

    def catch_up(self) -> None:
        """Bring all joints to where the one is that is ahead."""
        latest = max(joint.step for joint in self.joints)
        for joint in self.joints:
            self._advance_joint(joint, latest)

    def wake(self) -> None:
        """Something from outside changes the arm: look at everything again."""
        self.resting = self._gravity_is_current = False

    def rest(self, until_step: int) -> None:
        """Let time pass at rest."""
        self.update_temperatures(until_step - self.step)
        self.step = until_step
        for joint in self.joints:
            joint.step = until_step

    def _advance_joint(self, joint: Joint, until_step: int) -> None:
        if joint.advance(until_step, self.chunk_begin if self.pulled else None):
            self._changed, self._gravity_is_current = True, False

    def _begin_chunk(self) -> None:
        fast = any(not -FAST_RAD_S <= joint.servo.velocity_rad_s <= FAST_RAD_S for joint in self.joints)
        self.chunk_begin, self.chunk_end = self.step, self.step + (FAST_CHUNK_STEPS if fast else CHUNK_STEPS)
        if not self._gravity_is_current and (self._still or self._has_left_configuration()):
            self._update_gravity()

    def _end_chunk(self) -> None:
        for joint in self.joints:
            joint.settle(carried=self.pulled)
        self._changed |= self.update_voltage()
        self.update_temperatures(self.chunk_end - self.chunk_begin)
        self._still, self._changed = not self._changed, False
        self.resting = self._gravity_is_current and self._still and not self.pulled

    def _has_left_configuration(self) -> bool:
        """Whether a joint is too far from where gravity was computed."""
        return any(
            not -GRAVITY_RAD <= joint.servo.shaft_rad - joint.gravity_shaft_rad <= GRAVITY_RAD
            for joint in self.joints[: self.masses.n]
        )

    def _update_gravity(self) -> None:
        """Gravity torque and diagonal inertia of every joint, from the true configuration."""
        self._gravity_is_current = True
        support_rad, rotor_kg_m2 = math.radians(self.spec.rest_support_deg), self.spec.rotor_inertia_kg_m2
        q = [joint.position_rad() for joint in self.joints]
        supported = all(abs(at - joint.rest_rad) <= support_rad for at, joint in zip(q, self.joints, strict=True))
        for joint, (torque_Nm, inertia_kg_m2) in zip(self.joints, self.masses.loads(q), strict=False):
            joint.gravity_Nm = 0.0 if supported else joint.direction * torque_Nm
            joint.step_over_inertia = STEP_S / (rotor_kg_m2 + inertia_kg_m2)
            joint.gravity_shaft_rad = joint.servo.shaft_rad
        for joint in self.joints[self.masses.n :]:  # they turn no link of the chain
            joint.step_over_inertia = STEP_S / rotor_kg_m2

    def update_voltage(self) -> bool:
        """Renew the voltage under the present load; whether it is another than before."""
        onward_A, currents_A = 0.0, []
        for joint in self.joints:
            currents_A.append(max(0.0, joint.servo.output * joint.effort) * self.spec.stall_current_A)
            onward_A += currents_A[-1]
        voltage_V = max(0.0, self.supply_V - self.spec.supply_ohm * onward_A)
        if voltage_V == self.voltage_V:
            return False
        self.voltage_V = voltage_V
        # From servo to servo; the cable to each one carries what it and those beyond it take.
        for joint, current_A in zip(self.joints, currents_A, strict=True):
            voltage_V = max(0.0, voltage_V - self.spec.cable_ohm * onward_A)
            joint.servo.voltage_V = voltage_V
            onward_A -= current_A
        return True

    def update_temperatures(self, steps: int) -> None:
        """Bring the temperatures nearer to where the present efforts lead, exponentially."""
        spec, passed_s = self.spec, steps * STEP_S
        left = math.exp(-passed_s / spec.heating_s)
        for joint in self.joints:
            servo, settled_degC = joint.servo, self.settled_degC(joint)
            servo.temperature_degC = settled_degC + (servo.temperature_degC - settled_degC) * left
            if spec.friction_per_degC:
                joint.warmth = math.exp(spec.friction_per_degC * (spec.idle_degC - servo.temperature_degC))
            if servo.variants.led_lingers_s:
                servo.calm_s = 0.0 if servo.alarms() else servo.calm_s + passed_s

    def settled_degC(self, joint: Joint) -> float:
        """Where the temperature of a motor leads at its present effort."""
        return self.spec.idle_degC + self.spec.stall_heating_degC * joint.effort * joint.effort
