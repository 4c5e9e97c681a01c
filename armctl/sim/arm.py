"""Physics of a simulated arm: what the servos' registers do to the links, and gravity and a hand to both.

Every joint is one mass on a motor with friction, integrated at 1 kHz by semi-implicit Euler in the servo's own
direction (CCW positive):

    output  = 0 inside the margin, `punch` at its edge, then a ramp over the slope, capped by the torque limits;
              the error is counted in whole ticks between the reference and the quantised shaft
    motor   = stall_torque * (output * voltage / 12 V - velocity / no_load_speed)      (nothing at all when limp)
    inertia * acceleration = motor + gravity + hand - friction

The shaft, which the potentiometer sees and the link hangs on, follows the motor through a play: gravity and hand
push it to one flank; without them it is dragged along. The reference ramps to the goal at the moving speed.
Joints are coupled by gravity and the diagonal inertia, both renewed from the true configuration every 4 ms, and by
the supply, whose voltage falls with the current all motors draw; each motor's heat is first order. Time advances on
a fixed grid, so the result does not depend on how `advance` is called, and faults begin and end on it. Plain floats:
for six joints they are several times faster than arrays. Source and certainty of every figure: docs/simulator.md.
"""

from __future__ import annotations

import math
import sys
from dataclasses import dataclass, field

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, Packet
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain, tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.faults import Faults, Planned
from armctl.sim.hand import Hand
from armctl.sim.servo import Drive, ServoVariants, SimulatedServo, sensed_tick

STEP_NS = 1_000_000
STEP_S = 1e-3
FAULT_TOLERANCE_S = 1e-6
"""So much before a step's instant counts as at it: what a sum of decimal seconds may be off."""
CHUNK_STEPS = 4
"""Steps between two evaluations of gravity, inertia and the hand's aim."""
GRAVITY_M_S2 = 9.81
RATED_V = 12.0
"""The supply at which stall torque and no-load speed are stated."""


@dataclass(frozen=True)
class ArmSpec:
    """Every physical number of a simulated arm.

    A pair is a range from which each joint (or the tool) draws by the seed. docs/simulator.md says of each figure
    whether it is ROBOTIS', a study's or a guess, and what is not modelled.
    """

    servo_kg: float = 0.0546
    bracket_kg: float = 0.020
    tool_kg: tuple[float, float] = (0.060, 0.100)
    stall_torque_Nm: float = ax12a.STALL_TORQUE_NM
    no_load_speed_rad_s: float = ax12a.NO_LOAD_SPEED_RAD_S
    friction_Nm: tuple[float, float] = (0.08, 0.16)
    """Coulomb friction at the output shaft."""
    stiction_ratio: float = 1.2
    """Break-away torque over Coulomb friction."""
    rotor_inertia_kg_m2: float = 0.002
    """Of motor and gears, seen from the output shaft."""
    play_deg: tuple[float, float] = (0.25, 0.5)
    """Whole width of the play between motor and shaft."""
    play_speed_rad_s: float = 0.2
    """How fast a pushed shaft crosses its play."""
    shaft_friction_Nm: float = 0.01
    """Less than this on the shaft does not move it within its play."""
    zero_offset_tick: float = 0.5
    """Standard deviation of the error of each zero_tick; no register shows it."""
    length_error_m: float = 0.0
    """Standard deviation of the error of each link length."""
    noise_tick: float = 0.5
    """Standard deviation of a reported position."""
    stop_deg: float = 2.0
    """The mechanical stops lie this far beyond the calibration's limits."""
    rest_support_deg: float = 4.0
    """With every joint this near its rest pose the arm leans on something that carries its weight."""
    overload_output: float = 0.8
    overload_s: float = 4.0
    """A servo whose output stays over `overload_output` for this long reports an overload."""
    supply_V: float = 12.0
    """At the servos while no motor works."""
    supply_ohm: float = 0.15
    """Of supply and cables together."""
    stall_current_A: float = 1.5
    idle_degC: float = 30.0
    """Where a servo's temperature settles while its motor rests."""
    stall_heating_degC: float = 120.0
    """How far above that it would settle at stall torque; as the square of the torque below."""
    heating_s: float = 400.0
    """Time constant of heating and cooling."""
    boot_s: float = 0.3
    """A servo is deaf for this long after its firmware restarts."""
    variants: ServoVariants = field(default_factory=ServoVariants)


DEFAULT_SPEC = ArmSpec()


@dataclass(slots=True)
class _Joint:
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
    omega: float = 0.0
    load: float = 0.0
    inertia: float = 1.0
    loaded_steps: int = 0
    dead_motor: bool = False
    held: float | None = None
    """Where something holds the shaft."""
    boot_step: int = 0
    """When its firmware runs again, while it is booting."""

    def position_rad(self) -> float:
        return self.direction * (self.shaft - self.zero_rad)


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
        self._links = _links(self.chain)
        self._points_kg = _point_masses(len(arm.joints), self.chain.n, spec, float(rng.uniform(*spec.tool_kg)))
        self._joints: list[_Joint] = []
        servos = []
        stop = math.radians(spec.stop_deg)
        for joint, servo_rng in zip(arm.joints, rng.spawn(len(arm.joints)), strict=True):
            zero = (joint.zero_tick + spec.zero_offset_tick * float(rng.standard_normal())) * ax12a.TICK_RAD
            coulomb = float(rng.uniform(*spec.friction_Nm))
            ends = sorted(zero + joint.direction * limit for limit in joint.limits_rad)
            rest = zero + joint.direction * joint.rest_rad
            self._joints.append(
                _Joint(
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
        self._servos = tuple(servos)
        self._drives = [servo.drive for servo in servos]
        self._writes = [servo.writes for servo in servos]
        self._origin_ns: int | None = None
        self._step = 0
        self._weighed = False
        """Whether gravity and inertia belong to the present configuration."""
        self._resting = False
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
        return np.array([joint.position_rad() for joint in self._joints])

    def true_tool_position(self) -> FloatArray:
        """Tool point of the true geometry [m], shape (3,)."""
        return self.tool_positions(self.true_positions())

    def tool_positions(self, positions_rad: FloatArray) -> FloatArray:
        """Tool points of the true geometry [m], shape (..., 3), of true positions [rad], shape (..., n)."""
        return tool_position(self.chain, positions_rad[..., : self.chain.n])

    def advance(self, now_ns: int) -> None:
        """Integrate up to the monotonic instant `now_ns`.

        The first call sets the origin of time; an instant before the last one does nothing, as does any while the
        world is `standing`.
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
                    self._drives[i], self._writes[i] = servo.drive, servo.writes
                    self._resting = False
            if self._resting and not self.hand.holding:
                # Time passes, and only temperatures change: up to the one that will trip a servo.
                overheat = self._steps_to_overheat()
                self._step += min(due, overheat)
                self._warm()
                self._resting = due < overheat
                continue
            count = min(due, CHUNK_STEPS - self._step % CHUNK_STEPS)
            moved = self._integrate(count)
            self._step += count
            if self._step % CHUNK_STEPS == 0:
                moved |= self._drain_supply()
                self._warm()
                # At rest nothing changes until an input does, if gravity is the one of this very configuration.
                self._resting = self._weighed and not moved and not self.hand.holding
                self._weighed &= not moved
            else:
                self._weighed &= not moved

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
        for servo in self._servos:
            if servo.output:
                current_A += max(0.0, servo.output * self._effort(servo)) * spec.stall_current_A
        voltage_V = max(0.0, self._supply_V - spec.supply_ohm * current_A)
        if voltage_V == self._voltage_V:
            return False
        self._voltage_V = voltage_V
        for servo in self._servos:
            servo.voltage_V = voltage_V
        return True

    def _effort(self, servo: SimulatedServo) -> float:
        """Motor current as a fraction of the stall current."""
        return servo.output - servo.velocity_rad_s / self.spec.no_load_speed_rad_s if servo.output else 0.0

    def _settled_degC(self, servo: SimulatedServo) -> float:
        """Where the servo's temperature tends at its present effort."""
        return self.spec.idle_degC + self.spec.stall_heating_degC * self._effort(servo) ** 2

    def _warm(self) -> None:
        """Bring the temperatures up to date."""
        steps = self._step - self._warm_step
        self._warm_step = self._step
        decay = self._decay if steps == CHUNK_STEPS else math.exp(-steps * STEP_S / self.spec.heating_s)
        for servo in self._servos:
            settled = self._settled_degC(servo)
            servo.temperature_degC = settled + (servo.temperature_degC - settled) * decay

    def _steps_to_overheat(self) -> int:
        """How long the arm may rest until some servo's temperature passes its limit."""
        least = math.inf
        for servo in self._servos:
            limit = servo.get(ax12a.TEMPERATURE_LIMIT) + 0.5
            settled = self._settled_degC(servo)
            if servo.temperature_degC <= limit < settled:
                share = (settled - servo.temperature_degC) / (settled - limit)
                least = min(least, self.spec.heating_s * math.log(share) / STEP_S)
        return sys.maxsize if least == math.inf else int(least) + 1

    def _integrate(self, count: int) -> bool:
        """`count` steps of every joint, at most to the end of the chunk; whether anything moved."""
        if self._step % CHUNK_STEPS == 0 and not self._weighed:
            self._weigh()
        chunk_s = (self._step - self._step % CHUNK_STEPS) * STEP_S
        aim = self.hand.aim(chunk_s) if self.hand.holding else None
        moved = False
        for i, (joint, servo, drive) in enumerate(zip(self._joints, self._servos, self._drives, strict=True)):
            if aim is None:
                moved |= self._move(joint, servo, drive, count, None, 0.0)
            else:
                pull = joint.zero_rad + joint.direction * aim[0][i]
                moved |= self._move(joint, servo, drive, count, pull, joint.direction * aim[1][i])
            if drive.enabled and abs(self._effort(servo)) > self.spec.overload_output:
                joint.loaded_steps += count
                moved = True
            else:
                joint.loaded_steps = 0
            servo.protect(overloaded=joint.loaded_steps * STEP_S > self.spec.overload_s)
            if servo.booting:
                servo.booting = self._step + count < joint.boot_step
                moved = True
        return moved

    def _move(
        self, joint: _Joint, servo: SimulatedServo, drive: Drive, count: int, pull: float | None, pull_speed: float
    ) -> bool:
        """Integrate one joint; whether anything about it changed. `pull` is the hand's aim at the chunk's begin."""
        spec, hand = self.spec, self.hand
        tick_rad, floor = ax12a.TICK_RAD, math.floor
        gravity, rate = joint.load, STEP_S / joint.inertia
        coulomb, stiction, half_play = joint.coulomb, joint.stiction, joint.half_play
        low, high = (joint.low, joint.high) if joint.held is None else (joint.held, joint.held)
        frozen, spin = servo.frozen_tick, drive.spin
        sound = frozen is None and low >= 0.0 and high <= ax12a.TICK_MAX * tick_rad
        shaft_friction, play_step = spec.shaft_friction_Nm, spec.play_speed_rad_s * STEP_S
        enabled, goal = drive.enabled, drive.goal_tick
        stall = spec.stall_torque_Nm * (self._voltage_V / RATED_V)
        brake = spec.stall_torque_Nm / spec.no_load_speed_rad_s
        if joint.dead_motor:
            stall = brake = 0.0
        ramp = drive.ramp_tick_s * STEP_S
        cw_margin, ccw_margin, limit = -drive.cw_margin, drive.ccw_margin, drive.output_limit
        shaft, motor, omega, reference = joint.shaft, joint.motor, joint.omega, servo.reference_tick
        if spin is not None:
            reference = goal
        output = torque = 0.0
        moved = False
        first = self._step % CHUNK_STEPS
        for step in range(first, first + count):
            if enabled:
                if reference != goal:
                    moved = True
                    way = goal - reference
                    if ramp == 0.0 or -ramp <= way <= ramp:
                        reference = goal
                    else:
                        reference += ramp if way > 0.0 else -ramp
                if sound:
                    sensed = floor(shaft / tick_rad + 0.5)
                else:
                    sensed = sensed_tick(shaft / tick_rad) if frozen is None else frozen
                error = floor(reference + 0.5) - sensed
                if spin is not None:
                    output = spin
                elif error > ccw_margin:
                    output = min(limit, drive.punch + (error - ccw_margin) * drive.ccw_gain)
                elif error < cw_margin:
                    output = -min(limit, drive.punch + (cw_margin - error) * drive.cw_gain)
                else:
                    output = 0.0
                torque = stall * output - brake * omega
            else:
                torque = 0.0
            external = gravity
            if pull is not None:
                external += hand.torque(pull + pull_speed * (step * STEP_S) - shaft, pull_speed - omega)
            torque += external
            if omega == 0.0:
                if -stiction <= torque <= stiction:
                    faster = 0.0
                else:
                    faster = (torque - (coulomb if torque > 0.0 else -coulomb)) * rate
            else:
                faster = omega + (torque - (coulomb if omega > 0.0 else -coulomb)) * rate
                if faster * omega < 0.0:
                    faster = 0.0
            omega = faster
            before = shaft
            motor += omega * STEP_S
            if external > shaft_friction:
                shaft += play_step
            elif external < -shaft_friction:
                shaft -= play_step
            if shaft > motor + half_play:
                shaft = motor + half_play
            elif shaft < motor - half_play:
                shaft = motor - half_play
            if shaft < low:
                motor, shaft, omega = motor + low - shaft, low, max(omega, 0.0)
            elif shaft > high:
                motor, shaft, omega = motor + high - shaft, high, min(omega, 0.0)
            if omega == 0.0 and shaft == before:
                if pull is None and (not enabled or reference == goal):
                    break  # and so would every further step of this chunk be
            else:
                moved = True
        joint.shaft, joint.motor, joint.omega = shaft, motor, omega
        servo.position_tick = shaft / tick_rad
        servo.velocity_rad_s, servo.output, servo.reference_tick = omega, output, reference
        return moved

    def _weigh(self) -> None:
        """Gravity torque and diagonal inertia of every joint, from the true configuration."""
        self._weighed = True
        joints = self._joints
        q = [joint.position_rad() for joint in joints]
        support = math.radians(self.spec.rest_support_deg)
        supported = all(abs(x - joint.rest_rad) <= support for x, joint in zip(q, self.config.joints, strict=True))
        loads = gravity_loads(self._links, self._points_kg, q)
        for joint, (torque, inertia) in zip(joints, loads, strict=False):
            joint.load = 0.0 if supported else joint.direction * torque
            joint.inertia = self.spec.rotor_inertia_kg_m2 + inertia
        for joint in joints[len(loads) :]:
            joint.load, joint.inertia = 0.0, self.spec.rotor_inertia_kg_m2


Link = tuple[bool, float, float, float, float, float]
"""Of a chain's row: whether its convention is modified, cos alpha, sin alpha, a, d, offset."""


def _links(chain: SerialChain) -> tuple[Link, ...]:
    modified = chain.convention == "modified"
    return tuple((modified, math.cos(r.alpha), math.sin(r.alpha), r.a, r.d, r.offset) for r in chain.rows)


def _point_masses(joints: int, n: int, spec: ArmSpec, tool_kg: float) -> tuple[float, ...]:
    """Masses [kg] on the axes of the chain's n joints, midway between the last axis and the tool point, and there."""
    servo_kg = spec.servo_kg + spec.bracket_kg
    return (*(servo_kg,) * n, servo_kg * (joints - n), tool_kg)


def gravity_loads(links: tuple[Link, ...], points_kg: tuple[float, ...], q: list[float]) -> list[tuple[float, float]]:
    """Gravity torque [N m] and inertia [kg m^2] about every axis of a chain that carries point masses.

    Gravity points along -z of the base. For the axis z_i through o_i and masses m_k at p_k beyond it, with
    v_k = z_i x (p_k - o_i): torque_i = -g sum(m_k v_k,z), inertia_i = sum(m_k |v_k|^2).

    Args:
        points_kg: Masses on each of the n axes (where a servo sits), midway between the last axis and the tool
            point, and at the tool point; shape (n + 2,).
        q: Joint positions [rad]; those beyond the chain's n are ignored.
    """
    ox = oy = oz = 0.0
    xx, xy, xz, yx, yy, yz, zx, zy, zz = 1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0
    axes = []
    for (modified, ca, sa, a, d, offset), angle in zip(links, q, strict=False):
        if modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            yx, yy, yz, zx, zy, zz = (
                ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
            )  # fmt: skip
        axes.append((ox, oy, oz, zx, zy, zz))
        c, s = math.cos(angle + offset), math.sin(angle + offset)
        ox, oy, oz = ox + d * zx, oy + d * zy, oz + d * zz
        xx, xy, xz, yx, yy, yz = (
            c * xx + s * yx, c * xy + s * yy, c * xz + s * yz,
            c * yx - s * xx, c * yy - s * xy, c * yz - s * xz,
        )  # fmt: skip
        if not modified:
            ox, oy, oz = ox + a * xx, oy + a * xy, oz + a * xz
            yx, yy, yz, zx, zy, zz = (
                ca * yx + sa * zx, ca * yy + sa * zy, ca * yz + sa * zz,
                ca * zx - sa * yx, ca * zy - sa * yy, ca * zz - sa * yz,
            )  # fmt: skip
    points = [axis[:3] for axis in axes]
    lx, ly, lz = points[-1]
    points += [((lx + ox) / 2.0, (ly + oy) / 2.0, (lz + oz) / 2.0), (ox, oy, oz)]
    loads = []
    for i, (px, py, pz, ux, uy, uz) in enumerate(axes):
        torque = inertia = 0.0
        for (x, y, z), kg in zip(points[i + 1 :], points_kg[i + 1 :], strict=True):
            rx, ry, rz = x - px, y - py, z - pz
            vx, vy, vz = uy * rz - uz * ry, uz * rx - ux * rz, ux * ry - uy * rx
            torque -= kg * vz
            inertia += kg * (vx * vx + vy * vy + vz * vz)
        loads.append((GRAVITY_M_S2 * torque, inertia))
    return loads
