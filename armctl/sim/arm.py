"""A simulated arm in time: what bytes, faults and a hand do to its servos and links.

One joint is in `joint.py`, what couples the joints in `body.py`. Every joint is integrated at 1 kHz.

What `advance` brings about does not depend on how it is called: steps and chunks begin at instants that the bytes and
the arm's own state decide, and faults begin and end on steps. At rest time costs nothing but temperatures. Source and
certainty of every figure: docs/simulator.md.
"""

import math
import sys

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, Packet
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.body import Body
from armctl.sim.build import build
from armctl.sim.faults import Faults, Planned
from armctl.sim.hand import Hand
from armctl.sim.joint import STEP_S, Joint
from armctl.sim.pair import SecondServo
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec

STEP_NS = 1_000_000
# So much before a step's instant counts as at it: what a sum of decimal seconds may be off.
FAULT_TOLERANCE_S = 1e-6


class SimulatedArm:
    """All servos of one arm and the body they move."""

    def __init__(
        self, arm: ArmConfig, *, seed: int = 0, spec: ArmSpec = DEFAULT_SPEC, faults: Faults | None = None
    ) -> None:
        """The arm in its rest pose, just powered up: torque off, RAM at the factory's values.

        Raises:
            ConfigError: no such robot or link length.
        """
        self.config, self.spec = arm, spec
        self.faults = Faults(seed=seed) if faults is None else faults
        # The true geometry, link length errors included.
        self.chain, self._joints, masses = build(arm, spec, seed)
        # As `PointMasses` has them.
        self.points_kg = masses.points_kg
        self._body = Body(self._joints, masses, spec)
        # In the order of the calibration's `servos`.
        self.servos = tuple(joint.servo for joint in self._joints)
        self._origin_ns: int | None = None
        # When a servo will be too hot if the arm stays at rest; None: not known yet.
        self._overheat_step: int | None = None
        # What each second writer (by its fault) tells each servo.
        self._writer_goals: dict[tuple[int, int], int] = {}
        self.hand = Hand(arm, self.chain, lambda: self.time_s, self.true_positions)
        # Whether time is held, see `Lockstep` in sim/pty.py.
        self.standing = False

    @property
    def eeprom_writes(self) -> int:
        """How often the EEPROM of some servo was written to."""
        return sum(servo.eeprom_writes for servo in self.servos)

    @property
    def time_s(self) -> float:
        """Time integrated since the first `advance` [s]."""
        return self._body.step * STEP_S

    def set_all(self, register: ax12a.Register, value: int) -> None:
        """Put a value into every servo's table, as the factory or a wizard's hand does."""
        for servo in self.servos:
            servo.set(register, value)

    def draw_noise(self) -> None:
        """One draw for every servo, by this moment of the take alone; it lasts until the next one."""
        seed, time_s = self.hand.moment(self.time_s)
        draws = np.random.default_rng((seed, round(time_s / STEP_S))).standard_normal(len(self.servos))
        for servo, draw in zip(self.servos, draws.tolist(), strict=True):
            servo.noise = draw

    def true_positions(self) -> FloatArray:
        """Joint positions of the output shafts [rad], shape (n,): no quantisation, noise or zero offset."""
        self._take_aim()
        self._body.catch_up()
        return np.array([joint.position_rad() for joint in self._joints[: len(self.config.joints)]])

    def true_tool_position(self) -> FloatArray:
        """Tool point of the true geometry [m], shape (3,)."""
        return self.tool_positions(self.true_positions())

    def tool_positions(self, positions_rad: FloatArray) -> FloatArray:
        """Tool points of the true geometry [m], shape (..., 3), of true positions [rad], shape (..., n)."""
        return tool_position(self.chain, positions_rad[..., : self.chain.n])

    def advance(self, now_ns: int, only: int | None = None) -> None:
        """Integrate up to the monotonic instant `now_ns`.

        The first call sets the origin of time; an instant before the last one does nothing, as does any while the
        world is `standing`.

        Args:
            only: Index of the one joint that will be looked at; within a chunk the others may then stay behind, and
                do not notice.
        """
        if self.standing:
            return
        if self._origin_ns is None:
            self._origin_ns = now_ns
        body, faults, end = self._body, self.faults, (now_ns - self._origin_ns) // STEP_NS
        while True:
            if faults.due_s <= body.step * STEP_S + FAULT_TOLERANCE_S:
                self._apply_faults()
            if end <= body.step:
                return
            until = end
            if faults.due_s < end * STEP_S:
                until = min(end, math.ceil((faults.due_s - FAULT_TOLERANCE_S / 2.0) / STEP_S))
            for joint in self._joints:
                if joint.servo.writes != joint.writes:
                    self._take_drive(joint)
            self._take_aim()
            if body.resting:
                self._rest(until)
                continue
            self._overheat_step = None
            if body.advance(until, only):
                return

    def _take_aim(self) -> None:
        """Let the joints know whether a hand pulls, and where to in the chunk they are in or about to begin."""
        body = self._body
        body.pulled = self.hand.holding
        if not body.pulled:
            return
        body.resting = False
        begin = body.chunk_begin if body.step < body.chunk_end else body.step
        for joint, aim_rad, speed_rad_s in zip(self._joints, *self.hand.aim(begin * STEP_S), strict=False):
            joint.take_aim(aim_rad, speed_rad_s)

    def _take_drive(self, joint: Joint) -> None:
        """Take note of what was written to a joint's servo; writes that change nothing do not wake an arm at rest."""
        if self._body.resting:
            joint.servo.protect()  # a limit may be another
        self._body.resting &= joint.take_drive()
        self._overheat_step = None

    def _rest(self, until_step: int) -> None:
        """Let time pass in which only temperatures change, up to the one that will trip a servo."""
        body = self._body
        if self._overheat_step is None:
            self._overheat_step = body.step + self._steps_to_overheat()
        body.rest(min(until_step, self._overheat_step))
        body.resting = body.step < self._overheat_step

    def _steps_to_overheat(self) -> int:
        """How long the arm may rest until some servo's temperature passes its limit."""
        least = math.inf
        for joint in self._joints:
            limit_degC = joint.servo.get(ax12a.TEMPERATURE_LIMIT) + 0.5
            settled_degC, now_degC = self._body.settled_degC(joint), joint.servo.temperature_degC
            if now_degC <= limit_degC < settled_degC:
                share = (settled_degC - now_degC) / (settled_degC - limit_degC)
                least = min(least, self.spec.heating_s * math.log(share) / STEP_S)
        return sys.maxsize if least == math.inf else int(least) + 1

    def _apply_faults(self) -> None:
        """Begin and end the faults that are due."""
        faults, body = self.faults, self._body
        due = faults.advance(self.time_s + FAULT_TOLERANCE_S)
        body.wake()
        for joint, servo_id in zip(self._joints, self.config.servo_ids, strict=True):
            servo = joint.servo
            for planned in due:
                if planned.fault.servo_id in (None, servo_id):
                    self._apply_occasion(planned, joint)
            if isinstance(joint, SecondServo):
                slip = faults.in_force("pair_mismatch", servo_id)
                joint.slip_tick = 0.0 if slip is None else slip.amount
            joint.dead_motor = faults.in_force("stuck_joint", servo_id) is not None
            # A shaft that is held stays where it is, and a sensor that is frozen goes on reading the same.
            joint.blocked_rad = servo.shaft_rad if faults.in_force("blocked_joint", servo_id) else None
            servo.frozen_tick = servo.sensed_tick() if faults.in_force("frozen_sensor", servo_id) else None
        sag = faults.in_force("brown_out")
        body.supply_V = self.spec.supply_V if sag is None else sag.amount
        body.update_voltage()

    def _apply_occasion(self, planned: Planned, joint: Joint) -> None:
        """What a fault does to a servo when it begins, or when the write of a second writer is due."""
        servo, kind = joint.servo, planned.fault.kind
        if kind not in ("brown_out", "trip", "hot", "second_writer") or not planned.happens():
            return
        if kind == "brown_out":
            servo.reboot()
            servo.booting, joint.boot_end_step = True, self._body.step + round(self.spec.boot_s / STEP_S)
        elif kind == "trip":
            servo.protect(overloaded=True)
        elif kind == "hot":
            servo.temperature_degC = planned.amount
        else:
            own = round(servo.position_tick + planned.amount)
            known = planned.id, self.servos.index(servo)
            goal = self._writer_goals.setdefault(known, min(max(own, 0), ax12a.TICK_MAX))
            data = bytes((ax12a.GOAL.address, 2, servo.servo_id)) + goal.to_bytes(2, "little")
            servo.handle(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, data))
