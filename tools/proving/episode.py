"""One episode of the soak: the control process's own code on simulated servos and a virtual clock, and its user.

Rules:

1. The loop, the bus, the SDK and the simulator are the real ones; only the clock and the port's far end are virtual.
   Nothing in control is asked or changed: commands go in by `ControlLoop.run`'s inbox, records come out of its outbox.
2. The judge sees the servos' side; the user (`clerk.py`) sees what `armctl status` would show.
3. Everything follows from the story: the same one gives the same bytes on the wire.
4. Every tick's inputs go through the step once more, which must say the same: what a replay of its log would show.
"""

from __future__ import annotations

import traceback
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.control.machine import State
from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.errors import BusError
from armctl.json_text import to_json
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import Command, Connected, HostLost, JointTrajectory, Mode, Run, TickRecord
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault, Faults
from armctl.sim.servo import ServoVariants
from armctl.sim.spec import DEFAULT_SPEC
from armctl.sim.virtual_arm import VirtualArm
from proving import reading
from proving.arms import arm_of, arm_text
from proving.clerk import Clerk
from proving.evidence import Outcome
from proving.invariants import Judge
from proving.meetings import Meetings
from proving.motions import MotionJudge
from proving.promises import Promises
from proving.readings import differences
from proving.requests import PERIOD_S, postures
from proving.story import Garble, HostGone, Kill, Late, Story, Strike, Tamper
from proving.watch import Killed, Watch, WatchedPort, damaged

ARM = "ax12-line"
# A fault is planned so long before it begins: the next tick comes earlier, however late.
NEAR_S = 2.0
# A control process that could not open the port is started again so much later.
RESTART_S = 1.0
# Before a fault is cleared its servos are identified; silent ones take so long at most.
IDENTIFIED_S = 3.0
NEVER_NS = 2**63


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


@dataclass(frozen=True)
class Stage:
    """What every episode of a process shares."""

    arm: ArmConfig
    robot: Robot
    # Some that the arm can take [rad].
    postures: Sequence[FloatArray]
    # The arm as the judge reads it.
    judged: reading.Arm


def stage(arm_name: str = ARM) -> Stage:
    """The stage for an arm given by name or path."""
    return stage_of(arm_text(arm_name))


def stage_of(text: str) -> Stage:
    """The stage for the arm that a file describes."""
    arm = arm_of(text)
    robot = robots.get(arm.robot, arm.lengths_m)
    return Stage(arm, robot, postures(arm, robot), reading.read(text))


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
        self._judged = stage.judged
        self._story, self._arm, self._robot = story, arm, stage.robot
        self.postures = stage.postures
        self._clock = LateClock()
        self._faults = [line.fault for line in story.lines if isinstance(line, Strike)]
        spec = replace(DEFAULT_SPEC, variants=variants(story.seed))
        self.body = SimulatedArm(arm, seed=story.seed, spec=spec, faults=Faults(seed=story.seed))
        self.body.advance(self._clock.now_ns())
        limits = [(servo.get(ax12a.CW_LIMIT), servo.get(ax12a.CCW_LIMIT)) for servo in self.body.servos]
        self.judge = Judge(stage.judged, PERIOD_S, limits)
        self.watch = Watch(stage.judged, self.body, self.judge)
        self._virtual = VirtualArm(
            self.body, PERIOD_S, clock=self._clock, make_port=lambda wire, clock: WatchedPort(wire, clock, self.watch)
        )
        self.rows: Counter[str] = Counter()
        self.told: list[tuple[float, str]] = [(line.at_s, str(line)) for line in story.lines]
        self.clerk = Clerk(story, arm, stage.robot, self)
        self._garbles = [line for line in story.lines if isinstance(line, Garble)]
        for garble in self._garbles:
            self.judge.garbled(garble.at_s, garble.at_s + garble.duration_s)
        if self._garbles:
            self.watch.spoil = self._spoil
        self._spoiling = np.random.default_rng((story.seed, 6))
        # What was asked, by its number.
        self._asked: dict[int, str] = {}
        # Why runs that no host has looked at are plainly wrong; empty: they are not.
        self._unseen: dict[int, str] = {}
        # Runs that the host has let through.
        self._through: dict[int, Run] = {}
        self._motions = MotionJudge(stage.judged, self.body.chain)
        self.meetings = Meetings(story)
        self._promises = Promises([servo.name for servo in arm.servos], self.judge.found)
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
        # When a `clear` was first asked for, of the fault that is told.
        self._clear_ns = self._fault_ns = NEVER_NS
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

    def let_through(self, run: Run) -> None:
        """The host has looked at a motion and found nothing against it."""
        self._through[run.request_id] = run
        for reason in self._motions.against(run.trajectory.positions_rad, run.trajectory.period_s):
            self.judge.found(self.now_s, "preflight", f"let through by the host: {reason}")

    def plainly_wrong(self, motion: JointTrajectory) -> list[str]:
        """All that is plainly wrong with a motion, for whoever looks for one."""
        return list(self._motions.against(motion.positions_rad, motion.period_s))

    def _spoil(self, packet: bytes, now_ns: int) -> bytes:
        """What of a packet of the host comes to the servos."""
        now_s = self.watch.now_s(now_ns)
        for line in self._garbles:
            if line.at_s <= now_s < line.at_s + line.duration_s and self._spoiling.random() < line.probability:
                self.rows["damaged requests"] += 1
                return damaged(packet, line.how, self._spoiling)
        return packet

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
                self._promises.lost()
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
                self._promises.lost()
                self._idle(back_s)
                restarted = False
        told = sorted(self.told, key=lambda one: one[0])
        judge, wire = self.judge, self.watch.wire.hexdigest()
        return Outcome(judge.violations, self.rows, self.now_s, wire, told, judge.red, self.meetings.met)

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
        self.judge.ticked(self.now_s, self.watch.servos(), self.watch.strains())

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
            if command.kind == "clear":
                self._clear_ns = min(self._clear_ns, self._clock.now_ns())
            self._asked[getattr(command, "request_id", -1)] = command.kind
            self._promises.asked(command.kind, getattr(command, "request_id", -1))
            if isinstance(command, Run) and command.request_id not in self._through:
                self._unseen[command.request_id] = self._motions.plainly_wrong(command.trajectory)
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
        code_before = self._code
        codes = frozenset(fault.code for fault in outputs.faults)
        self.judge.names({fault.code: fault.servo_id for fault in outputs.faults})
        self.judge.reported(now_s, outputs.mode, code, cause, codes)
        self.meetings.tick(now_s, any(servo.torque for servo in self.watch.servos()))
        if code != self._code or outputs.mode != self._mode:
            self.note(f"state {outputs.mode}" + (f", {code}: {outputs.fault.text}" if outputs.fault and code else ""))
            self._code, self._mode = code, outputs.mode
        self._count(record)
        whole = not any(garble.at_s <= now_s < garble.at_s + garble.duration_s + 1.0 for garble in self._garbles)
        whole &= not any(self.body.faults.in_force(kind) for kind in ("second_writer", "same_id"))
        self._promises.tick(now_s, outputs.mode, bool(codes), record.inputs.sample.servos, outputs.replies, whole)
        for index, text in differences(self._judged, self.watch.replies, record.inputs.sample.servos, outputs.joints):
            self.judge.misread(now_s, index, text)
        # A control process that begins has cleared nothing.
        latest_ns = [self.watch.identified_ns.get(servo_id, -NS_PER_S * 9) for servo_id in self._arm.servo_ids]
        since_ns = min(self._clock.now_ns() - IDENTIFIED_S * NS_PER_S, self._clear_ns)
        if any(isinstance(command, Connected) for command in record.inputs.commands):
            since_ns = min(since_ns, self._fault_ns)  # on a slow line what ends now may have begun with the fault
        anew = since_ns <= min(latest_ns)
        if code_before and not code and record.inputs.tick and not anew:
            self.judge.found(now_s, "7", f"{code_before} was cleared, and the servos were not identified anew")
        self._clear_ns = self._clear_ns if code else NEVER_NS
        self._fault_ns = outputs.fault.since_ns if outputs.fault else NEVER_NS
        self.watch.replies.clear()
        self.clerk.see(now_s, record)
        self._repeat(record)
        if self._log is not None:
            self._log(record)
        return True

    def _accepted(self, record: TickRecord) -> None:
        """A run begins, of those asked for in this tick."""
        refused = {reply.request_id for reply in record.outputs.replies if not reply.ok}
        for command in record.inputs.commands:
            wrong = self._unseen.get(getattr(command, "request_id", -1), "")
            if wrong and getattr(command, "request_id", -1) not in refused:
                self.judge.found(self.now_s, "1", f"a run is accepted: {wrong}")

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
            match event.code:
                case "PORT_BACK":
                    self.judge.port_back()
                case "REST_AHEAD":
                    self.judge.rest_announced()
                case "RUN_ACCEPTED":
                    self._accepted(record)
        for reply in record.outputs.replies:
            self.judge.replied(self.now_s, self._asked.get(reply.request_id, ""), reply.ok, self.watch.servos())
            if not reply.ok and reply.code == "LIMIT" and reply.request_id in self._through:
                text = f"let through by the host, and refused by the control process: {reply.message}"
                self.judge.found(self.now_s, "preflight", text)
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
