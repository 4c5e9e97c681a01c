"""Physics of a simulated arm: what the servos' registers do to the links, and gravity and a hand to both.

Every joint is integrated at 1 kHz, see `joint`; the numbers lie in `state`, and `steps` computes with them. Joints are
coupled by gravity and the diagonal inertia, renewed from the true configuration once it has changed by `WEIGHED_RAD`,
and by the supply, whose voltage falls with the current all motors draw; each motor's heat is first order. These are
looked at between chunks of 20 ms (2 ms while a joint is fast), within which every joint is on its own; that this is
often enough is a test, against looking every millisecond.

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
from armctl.sim import steps
from armctl.sim.faults import Faults, Planned
from armctl.sim.gravity import laid_out, links_of
from armctl.sim.hand import Hand
from armctl.sim.joint import Joint
from armctl.sim.servo import SimulatedServo
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec
from armctl.sim.state import State
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
        parts: list[dict[str, float]] = []
        stop = math.radians(spec.stop_deg)
        servo_rngs = rng.spawn(len(arm.joints))
        for joint in arm.joints:
            if spec.zero_offset_within_tick is None:
                zero_offset_tick = spec.zero_offset_tick * float(rng.standard_normal())
            else:
                zero_offset_tick = spec.zero_offset_within_tick * float(rng.uniform(-1.0, 1.0))
            zero = (joint.zero_tick + zero_offset_tick) * ax12a.TICK_RAD
            coulomb = float(rng.uniform(*spec.friction_Nm))
            ends = sorted(zero + joint.direction * limit for limit in joint.limits_rad)
            rest = zero + joint.direction * joint.rest_rad
            parts.append(
                {
                    "direction": joint.direction,
                    "zero_rad": zero,
                    "rest_rad": joint.rest_rad,
                    "coulomb": coulomb,
                    "stiction": coulomb * spec.stiction_ratio,
                    "half_play": math.radians(float(rng.uniform(*spec.play_deg))) / 2.0,
                    "low": ends[0] - stop,
                    "high": ends[1] + stop,
                    "shaft": rest,
                }
            )
        for part in parts:
            part["stall"] = spec.stall_torque_Nm * (1.0 + spec.stall_spread * float(rng.uniform(-1.0, 1.0)))
            part["brake"] = part["stall"] / spec.no_load_speed_rad_s
        servo_kg = spec.servo_kg + spec.bracket_kg
        servos_kg = [servo_kg * (1.0 + spec.mass_spread * float(rng.uniform(-1.0, 1.0))) for _ in arm.joints]
        self.points_kg = (*servos_kg[: self.chain.n], sum(servos_kg[self.chain.n :]), tool_kg)
        """As `gravity_loads` wants them: servos beyond the chain sit midway between its last axis and the tool."""
        self._state = State(len(parts), self.chain.n, laid_out(self._links, self.points_kg, self.chain.tool_m))
        self._state.set_spec(spec)
        self._state.set_pace((CHUNK_STEPS, FAST_CHUNK_STEPS), FAST_RAD_S, WEIGHED_RAD, spec.heating_s)
        self._servos = tuple(
            self._servo(i, servo_rng, part["shaft"])
            for i, (servo_rng, part) in enumerate(zip(servo_rngs, parts, strict=True))
        )
        self._joints = [Joint(servo, **part) for servo, part in zip(self._servos, parts, strict=True)]
        self._origin_ns: int | None = None
        self._step = 0
        """As in the state."""
        self._overheat_step: int | None = None
        """When a servo will be too hot if the arm stays at rest; None: not known yet."""
        self._writer_goals: dict[tuple[int, int], int] = {}
        """What each second writer (by its fault) tells each servo."""
        self._aims: tuple[list[float], list[float]] | None = None
        """What the joints know of the hand's aim."""
        self.hand = Hand(self)
        self.standing = False
        """Whether time is held, see `Lockstep` in sim/pty.py."""

    def _servo(self, i: int, rng: np.random.Generator, shaft_rad: float) -> SimulatedServo:
        joint, spec = self.config.joints[i], self.spec
        servo = SimulatedServo(
            joint.servo_id,
            rng,
            (self._state, i),
            position_tick=shaft_rad / ax12a.TICK_RAD,
            noise_tick=spec.noise_tick,
            variants=spec.variants,
        )
        servo.voltage_V, servo.temperature_degC = spec.supply_V, spec.idle_degC
        servo.set(ax12a.CW_LIMIT, joint.limits_tick[0])
        servo.set(ax12a.CCW_LIMIT, joint.limits_tick[1])
        return servo

    @property
    def servos(self) -> tuple[SimulatedServo, ...]:
        """In the order of the calibration's joints."""
        return self._servos

    @property
    def eeprom_writes(self) -> int:
        """How often the EEPROM of some servo was written to."""
        return self._state.counts[steps.EEPROM_WRITES]

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
        self._state.counts[steps.PULLS] = self.hand.holding
        for i, joint in enumerate(self._joints):
            if joint.ahead < latest:
                if self.hand.holding:
                    self._aim()
                self._state.turn(i, latest)
        if self._state.counts[steps.ASKING]:
            self._answer()
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
        joints, counts = self._joints, self._state.counts
        end = (now_ns - self._origin_ns) // STEP_NS
        while True:
            if self.faults.due_s <= self._step * STEP_S + FAULT_TOLERANCE_S:
                self._suffer()
            if end <= self._step:
                return
            until = end
            if self.faults.due_s < end * STEP_S:
                until = min(end, math.ceil((self.faults.due_s - FAULT_TOLERANCE_S / 2.0) / STEP_S))
            if counts[steps.TOLD]:
                counts[steps.TOLD] = 0
                for joint in joints:
                    if joint.servo.writes != joint.writes:
                        self._obey(joint)
            holding = self.hand.holding
            if counts[steps.RESTING] and not holding:
                # Time passes, and only temperatures change: up to the one that will trip a servo.
                if self._overheat_step is None:
                    self._overheat_step = self._step + self._steps_to_overheat()
                before, self._step = self._step, min(until, self._overheat_step)
                counts[steps.STEP] = self._step
                self._state.warm(math.exp((before - self._step) * STEP_S / self.spec.heating_s))
                counts[steps.RESTING] = self._step < self._overheat_step
                continue
            counts[steps.PULLS] = holding
            if holding:
                self._aim()
            enough = self._state.play(until, -1 if only is None else only)
            while holding and not enough and counts[steps.STEP] < until and not counts[steps.ASKING]:
                self._step = counts[steps.STEP]
                self._aim()
                enough = self._state.play(until, -1 if only is None else only)
            self._step, self._overheat_step = counts[steps.STEP], None
            if counts[steps.ASKING]:
                self._answer()
            if enough:
                return

    def _aim(self) -> None:
        """Let the joints know where a hand pulls to in the chunk they are in or about to begin."""
        counts = self._state.counts
        begin = counts[steps.CHUNK_STEP] if self._step < counts[steps.CHUNK_END] else self._step
        aims = self.hand.aim(begin * STEP_S)
        if aims is not self._aims:
            self._aims = aims
            for joint, aim_rad, speed_rad_s in zip(self._joints, *aims, strict=True):
                joint.pull(aim_rad, speed_rad_s)

    def _answer(self) -> None:
        """Let servos shut down whose joints ask for it, and close the chunk if that waited for them."""
        state = self._state
        state.counts[steps.ASKING] = 0
        for joint in self._joints:
            joint.ask()
        if self._step == state.counts[steps.CHUNK_END]:
            state.close_chunk()

    def _obey(self, joint: Joint) -> None:
        """Take note of what was written to a joint's servo; writes that change nothing do not wake an arm at rest."""
        counts = self._state.counts
        if counts[steps.RESTING]:
            joint.servo.protect()  # a limit may be another
        counts[steps.RESTING] &= joint.obey()
        self._overheat_step = None

    def _suffer(self) -> None:
        """Begin and end the faults that are due."""
        faults, spec = self.faults, self.spec
        due = faults.advance(self.time_s + FAULT_TOLERANCE_S)
        state = self._state
        state.counts[steps.RESTING] = state.counts[steps.WEIGHED] = 0
        for i, (joint, servo) in enumerate(zip(self._joints, self._servos, strict=True)):
            servo_id = self.config.servo_ids[i]
            for planned in due:
                if planned.fault.servo_id in (None, servo_id):
                    self._strike(planned, i)
            joint.dead_motor = faults.in_force("stuck_joint", servo_id) is not None
            if not faults.in_force("blocked_joint", servo_id):
                joint.hold(None)
            elif not joint.held:
                joint.hold(joint.shaft)
            if not faults.in_force("frozen_sensor", servo_id):
                servo.frozen_tick = None
            elif servo.frozen_tick is None:
                servo.freeze()
        sag = faults.in_force("brown_out")
        state.numbers[steps.SUPPLY_V] = spec.supply_V if sag is None else sag.amount
        state.drain()

    def _strike(self, planned: Planned, i: int) -> None:
        """Let a fault that begins, or a second writer whose write is due, strike servo i."""
        servo, kind = self._servos[i], planned.fault.kind
        if kind not in ("brown_out", "trip", "hot", "second_writer") or not planned.strikes():
            return
        if kind == "brown_out":
            servo.reboot()
            servo.booting, self._joints[i].boot_step = 1, self._step + round(self.spec.boot_s / STEP_S)
        elif kind == "trip":
            servo.protect(overloaded=True)
        elif kind == "hot":
            servo.temperature_degC = planned.amount
        else:
            own = round(servo.position_tick + planned.amount)
            goal = self._writer_goals.setdefault((planned.id, i), min(max(own, 0), ax12a.TICK_MAX))
            data = bytes((ax12a.GOAL.address, 2, servo.get(ax12a.ID))) + goal.to_bytes(2, "little")
            servo.handle(Packet(BROADCAST_ID, Instruction.SYNC_WRITE, data))

    def _steps_to_overheat(self) -> int:
        """How long the arm may rest until some servo's temperature passes its limit."""
        least = math.inf
        for joint in self._joints:
            servo, effort = joint.servo, joint.effort
            limit = servo.get(ax12a.TEMPERATURE_LIMIT) + 0.5
            settled = self.spec.idle_degC + self.spec.stall_heating_degC * effort * effort
            if servo.temperature_degC <= limit < settled:
                share = (settled - servo.temperature_degC) / (settled - limit)
                least = min(least, self.spec.heating_s * math.log(share) / STEP_S)
        return sys.maxsize if least == math.inf else int(least) + 1
