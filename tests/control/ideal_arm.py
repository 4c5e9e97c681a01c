"""Servos that do exactly what they are told by the next tick: enough to drive the pure step."""

from __future__ import annotations

from collections.abc import Callable
from copy import deepcopy
from dataclasses import dataclass, field

from armctl import messages
from armctl.config import ArmConfig
from armctl.control.machine import State
from armctl.control.step import step
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.messages import Command, Connected, Inputs, JointTrajectory, Mode, Outputs, Reply, Run, Sample, TorqueOn
from tests.dynamixel.conftest import servo_table

PERIOD_S = 0.1


@dataclass
class IdealArm:
    """Register blocks 24..49 of every servo, the step's state, and everything the step said."""

    # Whose joints are at their goals: there is nothing to correct.
    arm: ArmConfig = field(default_factory=lambda: load_arm("ax12-line").model_copy(update={"correction": False}))
    state: State = field(default_factory=State)
    tick: int = 0
    now_ns: int = 1_000_000_000
    silent: set[int] = field(default_factory=set)
    # Joints that hear every write and push, but do not turn.
    stuck: set[int] = field(default_factory=set)
    # Joints that answer but hear no goal.
    deaf: set[int] = field(default_factory=set)
    # Joints whose replies come damaged.
    noisy: set[int] = field(default_factory=set)
    port_open: bool = True
    late_ns: int = 0
    period_s: float = PERIOD_S
    outputs: Outputs | None = None
    replies: dict[int, Reply] = field(default_factory=dict)
    events: list[str] = field(default_factory=list)
    goals: list[tuple[int, ...]] = field(default_factory=list)
    after_write: Callable[[IdealArm], None] = lambda _arm: None

    def __post_init__(self) -> None:
        self.robot = robots.get(self.arm.robot)
        self.blocks = [servo_table(servo_id)[ax12a.STATUS_BEGIN :] for servo_id in self.arm.servo_ids]
        self.stamps = [0] * len(self.blocks)
        for index, servo in enumerate(self.arm.servos):
            tick = servo.joint.tick(servo.joint.rest_rad)
            for register in (ax12a.PRESENT_POSITION, ax12a.GOAL):
                self.put(index, register, round(tick if servo.linkage is None else servo.linkage.second(tick)))
        self.seen = [bytes(block) for block in self.blocks]

    def put(self, index: int, register: ax12a.Register, value: int) -> None:
        begin = register.address - ax12a.STATUS_BEGIN
        self.blocks[index][begin : begin + register.size] = value.to_bytes(register.size, "little")

    def get(self, index: int, register: ax12a.Register) -> int:
        return ax12a.register_value(register, bytes(self.blocks[index]))

    def run_tick(self, *commands: Command) -> Outputs:
        """One tick: read, step, write."""
        self.now_ns += round(self.period_s * 1e9)
        readings = []
        for index, servo in enumerate(self.arm.servos):
            fresh = self.port_open and index not in self.silent | self.noisy
            if fresh:
                self.stamps[index], self.seen[index] = self.now_ns, bytes(self.blocks[index])
            readings.append(
                messages.ServoReading(
                    servo.servo_id,
                    self.seen[index] if self.stamps[index] else b"",
                    self.stamps[index],
                    fresh,
                    problem="" if fresh else "BUS_NOISE" if index in self.noisy else "NO_REPLY",
                )
            )
        sample = Sample(self.now_ns, tuple(readings), port_open=self.port_open)
        inputs = Inputs(self.tick, self.now_ns + 2_000_000, sample, commands, self.late_ns)
        before, given = deepcopy(self.state), self.state
        self.state, outputs = step(given, inputs, self.arm, self.robot, self.period_s)
        assert given == before, "the step changed the state that it was given"
        self.tick += 1
        self.outputs = outputs
        self.replies.update({reply.request_id: reply for reply in outputs.replies})
        self.events.extend(event.code for event in outputs.events)
        for write in outputs.writes:
            index = self.arm.servo_ids.index(write.servo_id)
            register = next(r for r in ax12a.REGISTERS if r.address == write.address)
            if index not in self.silent:
                self.put(index, register, write.value)
        if outputs.goal is not None:
            self.goals.append(outputs.goal.ticks)
            for index, (tick, speed) in enumerate(zip(outputs.goal.ticks, outputs.goal.speeds, strict=True)):
                if index in self.silent or index in self.deaf:
                    continue
                self.put(index, ax12a.GOAL, tick)
                self.put(index, ax12a.MOVING_SPEED, speed)
                self.put(index, ax12a.TORQUE_ENABLE, 1)  # an AX-12A may energise by a goal alone
                if index not in self.stuck:
                    self.put(index, ax12a.PRESENT_POSITION, tick)
                    continue
                if ahead := tick - self.get(index, ax12a.PRESENT_POSITION):
                    self.put(index, ax12a.PRESENT_LOAD, min(20 * abs(ahead), 780) + 1024 * (ahead < 0))
        self.after_write(self)
        return outputs

    def ask(self, command: messages.Request) -> Reply:
        """What is answered to a command in the tick that it comes to."""
        self.run_tick(command)
        return self.replies[command.request_id]

    def run_ticks(self, count: int, *commands: Command) -> Outputs:
        """`count` ticks, the first one with the commands; what the last one said."""
        for tick in range(count):
            self.run_tick(*(() if tick else commands))
        assert self.outputs is not None
        return self.outputs

    def goals_in(self, count: int, *commands: Command) -> list[tuple[int, ...]]:
        """The goals that are sent in `count` ticks."""
        before = len(self.goals)
        self.run_ticks(count, *commands)
        return self.goals[before:]

    def mode(self) -> Mode:
        return self.state.mode

    def code(self) -> str:
        """Of the latched fault; empty: there is none."""
        return self.state.fault.code if self.state.fault else ""

    def fault(self) -> tuple[str, int | None] | None:
        """Code and servo of the latched fault; None: there is none."""
        return (self.state.fault.code, self.state.fault.servo_id) if self.state.fault else None

    def connect(self) -> IdealArm:
        self.run_tick(Connected())
        return self

    def power(self) -> IdealArm:
        """Torque on at every servo, as a predecessor may have left it."""
        for index in range(len(self.blocks)):
            self.put(index, ax12a.TORQUE_ENABLE, 1)
        return self

    def positions_rad(self) -> tuple[float, ...]:
        return tuple(
            joint.position_rad(self.get(index, ax12a.PRESENT_POSITION)) for index, joint in enumerate(self.arm.joints)
        )


def line(
    arm: IdealArm, delta_rad: float = -0.4, seconds: float = 2.0, begin_s: float = 0.0, end_s: float = 0.0
) -> JointTrajectory:
    """A joint-space line of the elbow-like joint 0 from where the arm is."""
    start = arm.positions_rad()
    count = round(seconds / PERIOD_S) + 1
    points = tuple((start[0] + delta_rad * k / (count - 1), *start[1:]) for k in range(count))
    return JointTrajectory(PERIOD_S, points, begin_s, end_s, label="line")


def energising(arm: IdealArm | None = None) -> IdealArm:
    """Torque was asked for, and the goals were sent in the tick just over."""
    arm = (arm or IdealArm()).connect()
    arm.run_tick()
    arm.run_ticks(2, TorqueOn(1))
    return arm


def holding(arm: IdealArm | None = None) -> IdealArm:
    arm = energising(arm)
    arm.run_ticks(12)
    assert (arm.mode(), arm.replies[1].ok) == (Mode.HOLDING, True)
    return arm


def running(ticks: int = 0) -> IdealArm:
    """So many ticks after a run has begun, whose request is 5."""
    arm = holding()
    arm.run_ticks(ticks + 1, Run(5, line(arm)))
    return arm
