"""One episode of the soak: the control process's own code on simulated servos and a virtual clock, and its user.

Rules:

1. The loop, the bus, the SDK and the simulator are the real ones; only the clock and the port's far end are virtual.
   Nothing in control is asked or changed: commands go in by `ControlLoop.run`'s inbox, records come out of its outbox.
2. The judge sees the servos' side; the user (`clerk.py`) sees what `armctl status` would show.
3. Everything follows from the story: the same one gives the same bytes on the wire.
4. Every tick's inputs go through the step once more, which must say the same: what a replay of its log would show.
"""

from __future__ import annotations

import hashlib
import math
import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.control.machine import State
from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction
from armctl.errors import BusError
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import Command, Connected, HostLost, Mode, TickRecord, to_json
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault, Faults
from armctl.sim.loopback import LoopbackPort
from armctl.sim.servo import ServoVariants
from armctl.sim.spec import DEFAULT_SPEC
from armctl.sim.virtual_arm import VirtualArm
from proving.clerk import Clerk
from proving.duties import Sent, Servo
from proving.invariants import Judge
from proving.requests import PERIOD_S, postures
from proving.shafts import Violation
from proving.story import HostGone, Kill, Late, Story, Strike, Tamper

ARM = "ax12-line"
# Bytes of a good reply to a READ of 24..49.
STATUS_REPLY = 32
# Places in such a reply behind its header.
TORQUE_AT = 3 + ax12a.TORQUE_ENABLE.address - ax12a.STATUS_BEGIN
GOAL_AT = 3 + ax12a.GOAL.address - ax12a.STATUS_BEGIN
POSITION_AT = 3 + ax12a.PRESENT_POSITION.address - ax12a.STATUS_BEGIN
WATCHED = (ax12a.TORQUE_LIMIT, ax12a.GOAL, ax12a.MOVING_SPEED)
# As plain numbers: every packet is looked at.
READ, PING = int(Instruction.READ), int(Instruction.PING)
# A fault is planned so long before it begins: the next tick comes earlier, however late.
NEAR_S = 2.0
# A control process that could not open the port is started again so much later.
RESTART_S = 1.0


class Killed(BaseException):
    """SIGKILL, as far as code can tell: nothing catches it."""


class Over(BaseException):
    """The episode is over, whatever the control process was about to do."""


class LateClock(VirtualClock):
    """A virtual clock whose next sleep may last too long."""

    late_ns = 0

    def sleep_until_ns(self, deadline_ns: int) -> None:
        if self.late_ns:
            deadline_ns, self.late_ns = max(deadline_ns, self._now_ns) + self.late_ns, 0
        if deadline_ns > self._now_ns:
            self._now_ns = deadline_ns


class WatchedPort(LoopbackPort):
    """A port that shows the judge what passes."""

    def __init__(self, bus: SimulatedBus, clock: VirtualClock, watch: Watch) -> None:
        super().__init__(bus, clock)
        self._watch = watch

    def _check(self) -> None:
        # To ask whether the adapter is plugged in moves the whole arm first; most of the time nothing can unplug it.
        if self._watch.unpluggable or not self.is_open:
            super()._check()

    def readPort(self, length: int) -> bytes:
        data = super().readPort(length)
        self._watch.received += data
        return data

    def _send(self, packet: bytes) -> int:
        watch = self._watch
        watch.before(packet, self.clock.now_ns())
        sent = super()._send(packet)
        watch.after(self.clock.now_ns())
        return sent


class Watch:
    """The servos of an arm, seen from outside: before and after each packet, and once a tick."""

    def __init__(self, arm: ArmConfig, body: SimulatedArm, judge: Judge) -> None:
        self.received = bytearray()
        # Everything the host ever said.
        self.wire = hashlib.blake2b(digest_size=16)
        self.packets = 0
        # Raises `Killed` once so many packets are sent.
        self.kill_at = -1
        # Whether the adapter may be out of the host.
        self.unpluggable = False
        # When it surely will not be.
        self._plugged_ns = -1
        self._body, self._judge = body, judge
        self._index = {servo_id: i for i, servo_id in enumerate(arm.servo_ids)}
        self._heads = {servo_id: bytes((0xFF, 0xFF, servo_id, STATUS_REPLY - 4)) for servo_id in arm.servo_ids}
        self._pending: int | None = None
        self._writes = [-1] * len(body.servos)
        self._servos = [Servo(False, 0, 0, 0, 0.0, 0) for _ in body.servos]
        # Whether this tick's readings are not a sample's alone.
        self._identifying = False
        # How often each servo was asked for its status in this tick.
        self._asked: dict[int, int] = {}
        # Which of them were heard.
        self._heard: set[int] = set()
        self._sent: list[Sent] = []
        self._before: list[Servo] = []

    def now_s(self, now_ns: int) -> float:
        """The judge's time: the clock's."""
        return now_ns / NS_PER_S - 1.0

    def unplugged(self, until_s: float) -> None:
        """The adapter will be out of the host, and back at that time."""
        self.unpluggable = True
        self._plugged_ns = max(self._plugged_ns, round((until_s + 1.1) * NS_PER_S))

    def before(self, packet: bytes, now_ns: int) -> None:
        """A packet is about to leave the host."""
        if self.packets == self.kill_at:  # before the first of a tick
            raise Killed
        self.packets += 1
        self.wire.update(packet)
        self.hear(now_ns)
        self._sent = []
        if packet[4] == READ:
            if packet[5] == ax12a.STATUS_BEGIN:
                self._pending = packet[2]
                index = self._index[packet[2]]
                self._asked[index] = self._asked.get(index, 0) + 1
            else:
                self._identifying = True
            return
        if packet[4] == PING:
            return
        self._sent = list(_writes(packet, self._index))
        # The servos act on a packet's last byte; where the arm is by then does not depend on who asks first.
        self._body.advance(now_ns + len(packet) * 10_000)
        self._before = [_copy(servo) for servo in self.servos()]

    def after(self, now_ns: int) -> None:
        """It has arrived."""
        if self._sent:
            self._judge.wrote(self.now_s(now_ns), self._sent, self._before, self.servos())
            self._sent = []
        if self.packets == self.kill_at:
            raise Killed

    def hear(self, now_ns: int) -> None:
        """Whatever has come from the servo asked last is all that came."""
        pending, received = self._pending, self.received
        if pending is not None and len(received) >= STATUS_REPLY:
            at = received.find(self._heads[pending])
            reply = received[at + 2 : at + STATUS_REPLY]
            if at >= 0 and len(reply) == STATUS_REPLY - 2 and sum(reply) & 0xFF == 0xFF:
                index = self._index[pending]
                torque, goal = reply[TORQUE_AT], reply[GOAL_AT] | reply[GOAL_AT + 1] << 8
                position = reply[POSITION_AT] | reply[POSITION_AT + 1] << 8
                self._judge.heard(self.now_s(now_ns), index, position, goal if torque else None)
                self._heard.add(index)
        self._pending = None
        received.clear()

    def end_tick(self, now_ns: int, complete: bool) -> None:
        """The control process has done what it does in a tick; `complete`: and its port is there."""
        self.hear(now_ns)
        self.unpluggable &= now_ns <= self._plugged_ns
        faults = self._body.faults
        # A reply that comes while the line is being drained is heard here, and rightly not there.
        late = faults.in_force("late") or faults.in_force("latency")
        sampled = complete and not self._identifying and not late
        asked = self._asked if sampled else {}
        unheard = [(index, often) for index, often in asked.items() if index not in self._heard]
        self._judge.polled(self.now_s(now_ns), unheard, len(self._heard) if sampled else 0, sum(asked.values()))
        self._asked.clear()
        self._heard.clear()
        self._identifying = False

    def servos(self) -> Sequence[Servo]:
        """Every servo now; the list is the same one each time."""
        for i, (servo, known) in enumerate(zip(self._body.servos, self._servos, strict=True)):
            known.shaft_tick = servo.position_tick
            frozen = servo.frozen_tick
            known.sensed_tick = math.floor(servo.position_tick + 0.5) if frozen is None else frozen
            if servo.writes != self._writes[i]:
                self._writes[i] = servo.writes
                known.limit, known.goal, known.speed = servo.values(*WATCHED)
                known.torque = servo.torque_enabled and known.limit > 0
        return self._servos


def _copy(servo: Servo) -> Servo:
    return Servo(servo.torque, servo.goal, servo.speed, servo.limit, servo.shaft_tick, servo.sensed_tick)


def _writes(packet: bytes, index: dict[int, int]) -> list[Sent]:
    """What a packet of the host tells each servo."""
    parameters = packet[5:-1]
    match packet[4]:
        case Instruction.WRITE | Instruction.REG_WRITE:
            asked = index.values() if packet[2] == BROADCAST_ID else (index[packet[2]],)
            return [Sent(i, parameters[0], parameters[1:]) for i in asked]
        case Instruction.SYNC_WRITE:
            size = parameters[1] + 1
            rows = [parameters[at : at + size] for at in range(2, len(parameters), size)]
            return [Sent(index[row[0]], parameters[0], row[1:]) for row in rows]
        case _:  # RESET and whatever else changes the table
            return [Sent(i, 0, b"\0") for i in index.values()]


@dataclass(frozen=True)
class Stage:
    """What every episode of a process shares."""

    arm: ArmConfig
    robot: Robot
    # Some that the arm can take [rad].
    postures: Sequence[FloatArray]


def stage(arm_name: str = ARM) -> Stage:
    """The stage for an arm given by name or path."""
    arm = load_arm(arm_name)
    robot = robots.get(arm.robot, arm.lengths_m)
    return Stage(arm, robot, postures(arm, robot))


@dataclass
class Outcome:
    """What came of an episode."""

    violations: list[Violation]
    rows: Counter[str]
    virtual_s: float
    # Fingerprint of every byte the host sent.
    wire: str
    # The course of it in plain words, with its times.
    told: list[tuple[float, str]] = field(default_factory=list)


def variants(seed: int) -> ServoVariants:
    """What is unconfirmed of real servos, drawn for every other arm; the rest surprise in every way they may.

    Not drawn: servos whose speed ramp begins anew from the shaft at every goal. Streamed goals do not carry a loaded
    joint of such a servo, which falls behind until it counts as blocked.
    """
    if seed % 2:
        return ServoVariants()
    return ServoVariants(*(np.random.default_rng((seed, 4)).random(3) < 0.5).tolist())


class Episode:
    """A story being played."""

    def __init__(self, story: Story, stage: Stage, *, log: Callable[[TickRecord], None] | None = None) -> None:
        """Before its begin.

        Args:
            log: Takes every record of the control process.
        """
        arm = stage.arm
        self._story, self._arm, self._robot = story, arm, stage.robot
        self.postures = stage.postures
        self._clock = LateClock()
        self._faults = [line.fault for line in story.lines if isinstance(line, Strike)]
        spec = replace(DEFAULT_SPEC, variants=variants(story.seed))
        self.body = SimulatedArm(arm, seed=story.seed, spec=spec, faults=Faults(seed=story.seed))
        self.body.advance(self._clock.now_ns())
        limits = [(servo.get(ax12a.CW_LIMIT), servo.get(ax12a.CCW_LIMIT)) for servo in self.body.servos]
        self.judge = Judge(arm, PERIOD_S, limits)
        self.watch = Watch(arm, self.body, self.judge)
        self._virtual = VirtualArm(
            self.body, PERIOD_S, clock=self._clock, make_port=lambda wire, clock: WatchedPort(wire, clock, self.watch)
        )
        self.rows: Counter[str] = Counter()
        self.told: list[tuple[float, str]] = [(line.at_s, str(line)) for line in story.lines]
        self.clerk = Clerk(story, arm, stage.robot, self)
        for line in story.lines:
            if isinstance(line, Tamper):
                index = arm.servo_ids.index(line.servo_id)
                self.body.servos[index].set(ax12a.CW_LIMIT, 0)
                self.body.servos[index].set(ax12a.CCW_LIMIT, 0)
                self.judge.tampered(index)
        self._acts = [line for line in story.lines if isinstance(line, Late | Kill | HostGone)]
        self._kill: Kill | None = None
        self._gone: HostGone | None = None
        self._noisy: set[str] = set()
        self._code, self._mode = "", ""
        self._log = log
        # The step's memory, run again on the records alone.
        self._again = State()
        self._eeprom = [limits]

    @property
    def now_s(self) -> float:
        return self.watch.now_s(self._clock.now_ns())

    def fault(self, fault: Fault) -> None:
        """Plan a fault; not before it is near, for a simulator that expects one is slower."""
        begin_s = fault.begin_s - self.body.time_s
        self.body.faults.begin(fault.model_copy(update={"begin_s": max(0.0, begin_s)}), self.body.time_s)
        self.judge.plan(fault)
        if fault.kind == "unplug":
            assert fault.duration_s is not None
            self.watch.unplugged(fault.begin_s + fault.duration_s)

    def note(self, text: str) -> None:
        """A line of the course of events."""
        self.told.append((self.now_s, text))

    def play(self) -> Outcome:
        """Run it to its end, or to its first violation's tick."""
        restarted = False
        self._approach(0.0)
        while not self._over():
            loop = self._start(restarted)
            if loop is None:
                self._idle(RESTART_S)
                continue
            try:
                loop.run(self._inbox, self._outbox, self._leave)
            except Over:
                break
            except Killed:
                assert self._kill is not None
                self.watch.kill_at = -1
                back_s, self._kill = self._kill.back_s, None
                self.rows["SIGKILL"] += 1
                self.body.advance(self._clock.now_ns())
                self.judge.died(self.now_s, self.watch.servos())
                self.clerk.lost()
                self._idle(back_s)
                restarted = True
            except Exception as error:
                # Whatever it is, the real process would end here, with the arm at its last goal.
                self.note("".join(traceback.format_exception(error)[-4:]))
                self.judge.found(self.now_s, "crash", f"{type(error).__name__}: {error}")
            else:
                assert self._gone is not None
                back_s, self._gone = self._gone.back_s, None
                self.rows["SIGTERM"] += 1
                self.judge.died(self.now_s, self.watch.servos())
                self.clerk.lost()
                self._idle(back_s)
                restarted = False
        told = sorted(self.told, key=lambda one: one[0])
        return Outcome(self.judge.violations, self.rows, self.now_s, self.watch.wire.hexdigest(), told)

    def _over(self) -> bool:
        return bool(self.judge.violations) or self.now_s >= self._story.duration_s

    def _start(self, restarted: bool) -> ControlLoop | None:
        """A new control process, if the port lets itself be opened."""
        try:
            self._virtual.restart(restarted=restarted)
        except BusError as error:
            self.rows[f"{error.code} at the start"] += 1
            return None
        self.judge.back()
        return self._virtual.loop

    def _idle(self, duration_s: float) -> None:
        """Time passes without a control process."""
        while duration_s > 0.0:
            self._approach(self.now_s)
            self._clock.advance_ns(round(min(duration_s, PERIOD_S) * NS_PER_S))
            duration_s -= PERIOD_S
            self._look()

    def _look(self) -> None:
        """Show the judge the servos."""
        self.body.advance(self._clock.now_ns())
        if self.body.hand.holding:
            self.judge.led(self.now_s)
        self.judge.ticked(self.now_s, self.watch.servos())

    def _approach(self, now_s: float) -> None:
        """Plan the faults that are near."""
        while self._faults and self._faults[0].begin_s <= now_s + NEAR_S:
            self.fault(self._faults.pop(0))

    def _inbox(self) -> Sequence[Command]:
        if self._over():
            raise Over
        now_s = self.now_s
        self._approach(now_s)
        while self._acts and self._acts[0].at_s <= now_s:
            act = self._acts.pop(0)
            if isinstance(act, Late):
                self._clock.late_ns = round(act.late_ms * 1e6)
                if act.late_ms > 150.0:
                    self.rows["late ticks"] += 1
            elif isinstance(act, Kill):
                self._kill = act
                self.watch.kill_at = self.watch.packets + act.sends
            else:
                self._gone = act
        if self._gone is not None:
            self.judge.asked(now_s, "host_lost")
            return (HostLost(),)
        commands = self.clerk.commands(now_s)
        for command in commands:
            self.judge.asked(now_s, command.kind)
            self.told.append((now_s, f"-> {command.kind}"))
        return commands

    def _leave(self) -> bool:
        return self._gone is not None

    def _outbox(self, record: TickRecord) -> bool:
        now_s = self.now_s
        self.watch.end_tick(self._clock.now_ns(), record.inputs.sample.port_open)
        self._look()
        outputs = record.outputs
        code = "" if outputs.fault is None else outputs.fault.code
        cause = self.clerk.persisting(outputs.mode is Mode.ENERGISING) if self._code and not code else ""
        self.judge.reported(now_s, outputs.mode, code, cause)
        if code != self._code or outputs.mode != self._mode:
            self.note(f"state {outputs.mode}" + (f", {code}: {outputs.fault.text}" if outputs.fault and code else ""))
            self._code, self._mode = code, outputs.mode
        self._count(record)
        self.clerk.see(now_s, record)
        self._repeat(record)
        if self._log is not None:
            self._log(record)
        return True

    def _repeat(self, record: TickRecord) -> None:
        """Run the step on a record's inputs once more."""
        tick = record.inputs.tick
        self._again, outputs = step(self._again if tick else State(), record.inputs, self._arm, self._robot, PERIOD_S)
        if outputs != record.outputs or (record.keyframe and to_json(self._again) != record.keyframe):
            self.judge.found(self.now_s, "replay", f"the step, run again, differs at tick {tick}")

    def _count(self, record: TickRecord) -> None:
        for event in record.outputs.events:
            if event.code.isupper() and event.code not in ("STATE", "CONNECTED"):
                self.rows[event.code] += 1
                self.note(f"   {event.code}: {event.text}")
            if event.code == "PORT_BACK":
                self.judge.port_back()
        for reply in record.outputs.replies:
            if not reply.ok:
                self.rows[f"refused or ended: {reply.code}"] += 1
                self.note(f"   refused or ended: {reply.code} {reply.message}")
        noisy = {reading.problem for reading in record.inputs.sample.servos if reading.problem}
        for problem in noisy - self._noisy:
            self.rows[f"{problem} in a reading"] += 1
        self._noisy = noisy
        for command in record.inputs.commands:
            if isinstance(command, Connected) and command.restarted:
                self.rows["adopted"] += 1
