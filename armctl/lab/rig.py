"""What an experiment runs its plans on: one protocol, and the arm that is all virtual.

`VirtualRig` puts simulated servos, the real bus, the real control loop and a virtual clock into one process: no
daemon, no port of the system's. What it measures is what the servos report through the wire; the true tool path
stands beside it, for judging only, and nothing that corrects a plan may look at it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.control.loop import ControlLoop
from armctl.dynamixel.bus import ServoBus
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import FloatArray
from armctl.messages import Command, JointTrajectory, Mode, Reply, Run, Teach, TeachEnd, TickRecord, TorqueOn
from armctl.sim import steps
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.loopback import LoopbackPort
from armctl.trajectory.plan import Plan, joint_trajectory, preflight

TRUTH_NS = 4_000_000
"""Time between two points of the true tool path."""
EARLY_TICKS = 2
"""So long before the plan can begin the true path is looked at."""
FIRST_TICKS = 5
ENERGISE_TICKS = 30
SLACK_TICKS = 50
BEFORE_S, AFTER_S = 0.3, 0.8
"""How much of a take is kept before the hand leaves and after it has arrived."""


@dataclass(frozen=True, eq=False)
class Measured:
    """One executed plan, as the arm itself tells it; times count from the plan's begin.

    Shapes: times (m,), positions (m, joints), tool points (k, 3).
    """

    time_s: FloatArray
    positions_rad: FloatArray
    """By the encoders, at `time_s`."""
    duration_s: float
    recording: str
    """Name of the log; empty where none was kept."""
    true_time_s: FloatArray | None = None
    true_tool_m: FloatArray | None = None
    """The tool's real path: known of a simulated arm only."""


class Rig(Protocol):
    """An arm that runs plans."""

    arm: ArmConfig
    robot: Robot
    period_s: float

    @property
    def goals_rad(self) -> Sequence[float]:
        """Where the arm is commanded to be."""
        ...

    def run(self, plan: Plan) -> Measured:
        """Approach the plan's start, run it, measure.

        Raises:
            RequestRefused: the plan may not run, or was stopped; every reason.
        """
        ...


class _ObservingClock(VirtualClock):
    """Virtual time that looks at the arm every `TRUTH_NS` while it passes."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__()
        self._arm = arm
        self.observe_from_ns: int | None = None
        """None: it does not look."""
        self.time_ns: list[int] = []
        self.positions_rad: list[FloatArray] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        begin_ns = deadline_ns if self.observe_from_ns is None else self.observe_from_ns
        while (next_ns := (max(self.now_ns(), begin_ns) // TRUTH_NS + 1) * TRUTH_NS) <= deadline_ns:
            super().sleep_until_ns(next_ns)
            self._arm.advance(next_ns)
            self.time_ns.append(next_ns)
            self.positions_rad.append(self._arm.true_positions())
        super().sleep_until_ns(deadline_ns)


class VirtualRig:
    """A simulated arm under the real bus and control loop, in virtual time; torque is on."""

    def __init__(self, simulated: SimulatedArm, period_s: float = 0.1) -> None:
        """
        Raises:
            RequestRefused: the arm does not take torque.
        """
        steps.compiled()
        self.simulated = simulated
        self.arm = simulated.config
        self.robot = robots.get(self.arm.robot, self.arm.lengths_m)
        self.period_s = period_s
        self._clock = _ObservingClock(simulated)
        bus = ServoBus(LoopbackPort(SimulatedBus(simulated), self._clock), self.arm.servo_ids, self._clock)
        self._loop = ControlLoop(bus, self._clock, self.arm, self.robot, period_s)
        self._loop.open()
        self._request_id = 0
        for _ in range(FIRST_TICKS):
            self._loop.tick(())
        self._carry_out(TorqueOn(self._next_id()), ENERGISE_TICKS)

    @property
    def goals_rad(self) -> tuple[float, ...]:
        """Where the arm is commanded to be."""
        goal = self._loop.state.goal
        assert goal is not None
        return tuple(joint.position_rad(tick) for joint, tick in zip(self.arm.joints, goal, strict=True))

    def run(self, plan: Plan) -> Measured:
        if reasons := preflight(plan, self.arm, self.robot, self.goals_rad):
            raise RequestRefused("PREFLIGHT", reasons)
        return self.follow(joint_trajectory(plan, self.arm, self.goals_rad, self.period_s))

    def teach(self, A: FloatArray, B: FloatArray, seed: int) -> FloatArray:
        """What the encoders see [rad], shape (samples, joints), while a simulated hand guides the limp arm from A to B.

        Raises:
            UnreachableTarget: an end of the line is out of the hand's reach.
        """
        hand = self.simulated.hand
        try:
            guided = hand.guide(A, B, seed=seed)
            records = self._carry_out(Teach(self._next_id()), ENERGISE_TICKS)
            records += [self._loop.tick(()) for _ in range(round(guided.duration_s / self.period_s))]
            self._carry_out(TeachEnd(self._next_id()), ENERGISE_TICKS)
            self._carry_out(TorqueOn(self._next_id()), ENERGISE_TICKS)
        finally:
            hand.release()
        begin, end = (round(at / self.period_s) for at in (guided.begin_s - BEFORE_S, guided.end_s + AFTER_S))
        return np.array([[joint.position_rad for joint in record.outputs.joints] for record in records[begin:end]])

    def follow(self, trajectory: JointTrajectory) -> Measured:
        """Run a trajectory that begins where the arm is; what was measured between its begin_s and end_s.

        Raises:
            RequestRefused: it was refused or stopped.
        """
        clock = self._clock
        clock.time_ns, clock.positions_rad = [], []
        clock.observe_from_ns = clock.now_ns() + round((trajectory.begin_s - EARLY_TICKS * self.period_s) * NS_PER_S)
        try:
            records = self._carry_out(
                Run(self._next_id(), trajectory), round(trajectory.duration_s / self.period_s) + SLACK_TICKS
            )
        finally:
            clock.observe_from_ns = None
        marks = {
            event.code: record.inputs.sample.time_ns
            for record in records
            for event in record.outputs.events
            if event.code in ("PLAN_BEGIN", "PLAN_END")
        }
        begin_ns = marks.get("PLAN_BEGIN", records[0].inputs.sample.time_ns)
        end_ns = marks.get("PLAN_END", records[-1].inputs.sample.time_ns)
        inside = [record for record in records if begin_ns <= record.inputs.sample.time_ns <= end_ns]
        stamps = np.array([[reading.stamp_ns for reading in record.inputs.sample.servos] for record in inside])
        true_ns = np.array(clock.time_ns)
        during = (true_ns >= begin_ns) & (true_ns <= end_ns)
        return Measured(
            time_s=(stamps.mean(axis=1) - begin_ns) / NS_PER_S,
            positions_rad=np.array([[joint.position_rad for joint in record.outputs.joints] for record in inside]),
            duration_s=(end_ns - begin_ns) / NS_PER_S,
            recording="",
            true_time_s=(true_ns[during] - begin_ns) / NS_PER_S,
            true_tool_m=self.simulated.tool_positions(np.array(clock.positions_rad)[during]),
        )

    def _next_id(self) -> int:
        self._request_id += 1
        return self._request_id

    def _carry_out(self, command: Command, most_ticks: int) -> list[TickRecord]:
        """Tick until the command is answered, and its motion over."""
        records: list[TickRecord] = []
        reply: Reply | None = None
        while len(records) < most_ticks and not (reply is not None and self._loop.state.mode is not Mode.MOVING):
            records.append(self._loop.tick(() if records else (command,)))
            reply = next(iter(records[-1].outputs.replies), reply)
        if reply is None or not reply.ok:
            code, text = (
                ("NO_ANSWER", "the arm did not finish in time") if reply is None else (reply.code, reply.message)
            )
            raise RequestRefused(code, text)
        return records
