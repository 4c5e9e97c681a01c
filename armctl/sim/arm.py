"""Physics of a simulated arm: what the servos' registers do to the links, and gravity and a hand to both.

Every joint is integrated at 1 kHz, see `joint`. Joints are coupled by gravity and the diagonal inertia, renewed from
the true configuration once it has changed by `WEIGHED_RAD`, and by the supply, whose voltage falls with the current all
motors draw; each motor's heat is first order. These are looked at between chunks of 20 ms (2 ms while a joint is
fast), within which every joint is on its own; that this is often enough is a test, against looking every millisecond.

What `advance` brings about does not depend on how it is called: steps and chunks begin at instants that the bytes and
the arm's own state decide, and faults begin and end on steps. At rest time costs nothing but temperatures. Source and
certainty of every figure: docs/simulator.md.
"""

from __future__ import annotations

import math
import sys

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, Packet
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.faults import Faults, Planned
from armctl.sim.gravity import gravity_loads, links_of
from armctl.sim.hand import Hand
from armctl.sim.joint import Joint, turn
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec
from armctl.sim.steps import STEP_S

STEP_NS = 1_000_000
FAULT_TOLERANCE_S = 1e-6
"""So much before a step's instant counts as at it: what a sum of decimal seconds may be off."""
CHUNK_STEPS = 20
"""Steps between two looks at gravity, inertia, the hand's aim, supply and heat."""
FAST_CHUNK_STEPS = 2
"""The same while a joint turns faster than `FAST_RAD_S`, as those of a falling arm do."""
FAST_RAD_S = 1.0
WEIGHED_RAD = 0.004
"""Gravity and inertia stay those of a configuration until a joint is further from it than this, or all stand still."""


class SimulatedArm:
    """All servos of one arm and the body they move."""

    def __init__(
        self, arm: ArmConfig, *, seed: int = 0, spec: ArmSpec = DEFAULT_SPEC, faults: Faults | None = None
    ) -> None:
        """The arm in its rest pose, just powered up: torque off, RAM at the factory's values.

        The servos' EEPROM is set up as the calibration asks: ids and angle limits; the rest is the factory's.

        Raises:
            ConfigError: no such robot or link length.
        """
        self.config = arm
        self.spec = spec
        self.faults = Faults(seed=seed) if faults is None else faults
        rng = np.random.default_rng(seed)
        robot = robots.get(arm.robot, arm.lengths_m)
        lengths_m = {
            name: length + spec.length_error_m * float(rng.standard_normal())
            for name, length in robot.lengths_m.items()
        }
        self.chain: SerialChain = robot.with_lengths(lengths_m).chain
        """The true geometry, link length errors included."""
        self._links = links_of(self.chain)
        tool_kg = float(rng.uniform(*spec.tool_kg))
        self._joints: list[Joint] = []
        servos = []
        stop = math.radians(spec.stop_deg)
        for joint, servo_rng in zip(arm.joints, rng.spawn(len(arm.joints)), strict=True):
            if spec.zero_offset_within_tick is None:
                zero_offset_tick = spec.zero_offset_tick * float(rng.standard_normal())
            else:
                zero_offset_tick = spec.zero_offset_within_tick * float(rng.uniform(-1.0, 1.0))
            zero = (joint.zero_tick + zero_offset_tick) * ax12a.TICK_RAD
            coulomb = float(rng.uniform(*spec.friction_Nm))
            ends = sorted(zero + joint.direction * limit for limit in joint.limits_rad)
            rest = zero + joint.direction * joint.rest_rad
            self._joints.append(
                Joint(
                    direction=joint.direction,
                    zero_rad=zero,
                    coulomb=coulomb,
                    stiction=coulomb * spec.stiction_ratio,
                    half_play=math.radians(float(rng.uniform(*spec.play_deg))) / 2.0,
                    low=ends[0] - stop,
                    high=ends[1] + stop,
                    shaft=rest,
                    motor=rest,
                )
            )
            servo = SimulatedServo(
                joint.servo_id,
                servo_rng,
                position_tick=rest / ax12a.TICK_RAD,
                noise_tick=spec.noise_tick,
                variants=spec.variants,
            )
            servo.voltage_V, servo.temperature_degC = spec.supply_V, spec.idle_degC
            servo.set(ax12a.CW_LIMIT, joint.limits_tick[0])
            servo.set(ax12a.CCW_LIMIT, joint.limits_tick[1])
            servos.append(servo)
        for simulated in self._joints:
            simulated.stall = spec.stall_torque_Nm * (1.0 + spec.stall_spread * float(rng.uniform(-1.0, 1.0)))
        servo_kg = spec.servo_kg + spec.bracket_kg
        servos_kg = [servo_kg * (1.0 + spec.mass_spread * float(rng.uniform(-1.0, 1.0))) for _ in servos]
        self.points_kg = (*servos_kg[: self.chain.n], sum(servos_kg[self.chain.n :]), tool_kg)
        """As `gravity_loads` wants them: servos beyond the chain sit midway between its last axis and the tool."""
        self._servos = tuple(servos)
        self._drives = [servo.drive for servo in servos]
        self._writes = [servo.writes for servo in servos]
        self._origin_ns: int | None = None
        self._step = 0
        self._weighed = False
        """Whether gravity and inertia belong to the present configuration."""
        self._indices = range(len(servos))
        self._chunk_step = self._chunk_end = 0
        """The steps at which the present chunk begins and ends."""
        self._stirred = False
        """Whether anything changed in this chunk."""
        self._still = True
        """Whether nothing did in the one before."""
        self._resting = False
        self._overheat_step: int | None = None
        """When a servo will be too hot if the arm stays at rest; None: not known yet."""
        self._efforts = [0.0] * len(servos)
        """Of each motor: its current as a fraction of the stall current."""
        self._supply_V = self._voltage_V = spec.supply_V
        """The supply's own voltage, and the servos' under load."""
        self._warm_step = 0
        """When the temperatures were brought up to date."""
        self._decay = math.exp(-CHUNK_STEPS * STEP_S / spec.heating_s)
        self._writer_goals: dict[tuple[int, int], int] = {}
        """What each second writer (by its fault) tells each servo."""
        self.hand = Hand(self)
        self.standing = False
        """Whether time is held, see `Lockstep` in sim/pty.py."""

    @property
    def servos(self) -> tuple[SimulatedServo, ...]:
        """In the order of the calibration's joints."""
        return self._servos

    @property
    def time_s(self) -> float:
        """Time integrated since the first `advance` [s]."""
        return self._step * STEP_S

    def draw_noise(self) -> None:
        """One draw for every servo, by this moment of the take alone; it lasts until the next one."""
        seed, time_s = self.hand.moment(self.time_s)
        draws = np.random.default_rng((seed, round(time_s / STEP_S))).standard_normal(len(self._servos))
        for servo, draw in zip(self._servos, draws.tolist(), strict=True):
            servo.noise = draw

    def true_positions(self) -> FloatArray:
        """Joint positions of the output shafts [rad], shape (n,): no quantisation, noise or zero offset."""
        latest = max(joint.ahead for joint in self._joints)
        for i in self._indices:
            self._integrate(i, latest)
        return np.array([joint.position_rad() for joint in self._joints])

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
        end = (now_ns - self._origin_ns) // STEP_NS
        while True:
            if self.faults.due_s <= self.time_s + FAULT_TOLERANCE_S:
                self._suffer()
            due = end - self._step
            if due <= 0:
                return
            if self.faults.due_s < end * STEP_S:
                due = min(due, math.ceil((self.faults.due_s - FAULT_TOLERANCE_S / 2.0) / STEP_S) - self._step)
            for i, servo in enumerate(self._servos):
                if servo.writes != self._writes[i]:
                    self._obey(i, servo)
            if self._resting and not self.hand.holding:
                # Time passes, and only temperatures change: up to the one that will trip a servo.
                if self._overheat_step is None:
                    self._overheat_step = self._step + self._steps_to_overheat()
                self._step = min(self._step + due, self._overheat_step)
                self._warm()
                self._resting = self._step < self._overheat_step
                continue
            if self._step >= self._chunk_end:
                self._begin_chunk()
            left = self._chunk_end - self._step
            if only is not None and due < left:
                self._integrate(only, due)
                return
            count = min(due, left)
            for i in self._indices:
                self._integrate(i, count)
            self._step += count
            for joint in self._joints:
                joint.ahead -= count
            if count == left:
                self._stirred |= self._drain_supply()
                self._warm()
                self._still, self._stirred = not self._stirred, False
                # At rest nothing changes until an input does, if gravity is the one of this very configuration.
                self._resting = self._weighed and self._still and not self.hand.holding
                self._overheat_step = None

    def _obey(self, i: int, servo: SimulatedServo) -> None:
        """Take note of what was written to servo i; writes that change nothing do not wake an arm at rest."""
        if self._resting:
            servo.protect()  # a limit may be another
        drive, before = servo.drive, self._drives[i]
        self._drives[i], self._writes[i] = drive, servo.writes
        at_goal = not drive.enabled or drive.spin is not None or servo.reference_tick == drive.goal_tick
        self._resting &= drive == before and at_goal
        self._overheat_step = None

    def _suffer(self) -> None:
        """Begin and end the faults that are due."""
        faults, spec = self.faults, self.spec
        due = faults.advance(self.time_s + FAULT_TOLERANCE_S)
        self._resting = self._weighed = False
        for i, (joint, servo) in enumerate(zip(self._joints, self._servos, strict=True)):
            servo_id = self.config.servo_ids[i]
            for planned in due:
                if planned.fault.servo_id in (None, servo_id):
                    self._strike(planned, i)
            joint.dead_motor = faults.in_force("stuck_joint", servo_id) is not None
            if not faults.in_force("blocked_joint", servo_id):
                joint.held = None
            elif joint.held is None:
                joint.held = joint.shaft
            if not faults.in_force("frozen_sensor", servo_id):
                servo.frozen_tick = None
            elif servo.frozen_tick is None:
                servo.freeze()
        sag = faults.in_force("brown_out")
        self._supply_V = spec.supply_V if sag is None else sag.amount
        self._drain_supply()

    def _strike(self, planned: Planned, i: int) -> None:
        """Let a fault that begins, or a second writer whose write is due, strike servo i."""
        servo, kind = self._servos[i], planned.fault.kind
        if kind not in ("brown_out", "trip", "hot", "second_writer") or not planned.strikes():
            return
        if kind == "brown_out":
            servo.reboot()
            servo.booting = True
            self._joints[i].boot_step = self._step + round(self.spec.boot_s / STEP_S)
        elif kind == "trip":
            servo.protect(overloaded=True)
        elif kind == "hot":
            servo.temperature_degC = planned.amount
        else:
            own = round(servo.position_tick + planned.amount)
            goal = self._writer_goals.setdefault((planned.id, i), min(max(own, 0), ax12a.TICK_MAX))
            data = bytes((ax12a.GOAL.address, 2, servo.get(ax12a.ID))) + goal.to_bytes(2, "little")
            servo.handle(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, data))

    def _drain_supply(self) -> bool:
        """The voltage under the present load; whether it is another than before."""
        spec, current_A = self.spec, 0.0
        for servo, effort in zip(self._servos, self._efforts, strict=True):
            if servo.output:
                current_A += max(0.0, servo.output * effort) * spec.stall_current_A
        voltage_V = max(0.0, self._supply_V - spec.supply_ohm * current_A)
        if voltage_V == self._voltage_V:
            return False
        self._voltage_V = voltage_V
        for servo in self._servos:
            servo.voltage_V = voltage_V
        return True

    def _warm(self) -> None:
        """Bring the temperatures up to date."""
        steps = self._step - self._warm_step
        self._warm_step = self._step
        decay = self._decay if steps == CHUNK_STEPS else math.exp(-steps * STEP_S / self.spec.heating_s)
        idle, heating = self.spec.idle_degC, self.spec.stall_heating_degC
        for servo, effort in zip(self._servos, self._efforts, strict=True):
            settled = idle + heating * effort * effort
            servo.temperature_degC = settled + (servo.temperature_degC - settled) * decay

    def _steps_to_overheat(self) -> int:
        """How long the arm may rest until some servo's temperature passes its limit."""
        least = math.inf
        for servo, effort in zip(self._servos, self._efforts, strict=True):
            limit = servo.get(ax12a.TEMPERATURE_LIMIT) + 0.5
            settled = self.spec.idle_degC + self.spec.stall_heating_degC * effort * effort
            if servo.temperature_degC <= limit < settled:
                share = (settled - servo.temperature_degC) / (settled - limit)
                least = min(least, self.spec.heating_s * math.log(share) / STEP_S)
        return sys.maxsize if least == math.inf else int(least) + 1

    def _begin_chunk(self) -> None:
        fast = any(not -FAST_RAD_S <= joint.omega <= FAST_RAD_S for joint in self._joints)
        self._chunk_step = self._step
        self._chunk_end = self._step + (FAST_CHUNK_STEPS if fast else CHUNK_STEPS)
        if not self._weighed and (self._still or self._far()):
            self._weigh()

    def _integrate(self, i: int, count: int) -> None:
        """Let joint i come to `count` steps, at most to the end of the chunk, beyond where all joints are."""
        joint, servo, drive, spec = self._joints[i], self._servos[i], self._drives[i], self.spec
        begin, joint.ahead = joint.ahead, max(joint.ahead, count)
        steps = joint.ahead - begin
        if not steps:
            return
        pull = None
        if self.hand.holding:
            aim_rad, speed_rad_s = (joint.direction * each[i] for each in self.hand.aim(self._chunk_step * STEP_S))
            pull = joint.zero_rad + aim_rad, speed_rad_s, self._step + begin - self._chunk_step
        moved = turn(joint, servo, drive, spec, self._voltage_V, steps, pull)
        effort = servo.output - servo.velocity_rad_s / spec.no_load_speed_rad_s if servo.output else 0.0
        self._efforts[i] = effort
        if drive.enabled and not -spec.overload_output <= effort <= spec.overload_output:
            joint.loaded_steps += steps
            moved = True
        else:
            joint.loaded_steps = 0
        servo.protect(overloaded=joint.loaded_steps * STEP_S > spec.overload_s)
        if servo.booting:
            servo.booting = self._step + joint.ahead < joint.boot_step
            moved = True
        if moved:
            self._weighed, self._stirred = False, True

    def _far(self) -> bool:
        """Whether a joint has come so far that gravity is to be weighed again."""
        joints = self._joints[: self.chain.n]
        return any(not -WEIGHED_RAD <= joint.shaft - joint.weighed <= WEIGHED_RAD for joint in joints)

    def _weigh(self) -> None:
        """Gravity torque and diagonal inertia of every joint, from the true configuration."""
        self._weighed = True
        joints = self._joints
        q = [joint.position_rad() for joint in joints]
        support = math.radians(self.spec.rest_support_deg)
        supported = all(abs(x - joint.rest_rad) <= support for x, joint in zip(q, self.config.joints, strict=True))
        loads = gravity_loads(self._links, self.points_kg, q, self.chain.tool_m)
        for joint, (torque, inertia) in zip(joints, loads, strict=False):
            joint.load = 0.0 if supported else joint.direction * torque
            joint.inertia = self.spec.rotor_inertia_kg_m2 + inertia
            joint.weighed = joint.shaft
        for joint in joints[len(loads) :]:
            joint.load, joint.inertia = 0.0, self.spec.rotor_inertia_kg_m2
