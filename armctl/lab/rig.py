"""What an experiment runs its plans on: the protocol of a rig, the virtual rig, and the arm of a daemon.

`VirtualRig` measures what the servos report through the wire. The true tool path is recorded as well, but only to judge
by: nothing that corrects a plan may look at it. `DaemonRig` reads its runs back from the recordings of the daemon.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Protocol

import numpy as np

from armctl.client import Client
from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.kinematics.transform import FloatArray
from armctl.messages import LagModel, Run, Teach, TeachEnd, TorqueOn, UseModel
from armctl.recording import recordings
from armctl.recording.recordings import Recording
from armctl.sim.arm import SimulatedArm
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.plan import Plan, joint_trajectory, preflight
from armctl.trajectory.preflight import Driven
from armctl.trajectory.refinement import Measured, waited_long

# Time between two points of the true tool path.
TRUTH_NS = 4_000_000
# So long before the plan can begin the true path is looked at.
EARLY_TICKS = 2
FIRST_TICKS = 5
# How much of a take is kept before the hand leaves and after it has arrived.
BEFORE_S, AFTER_S = 0.3, 0.8
# Runs of a daemon's arm at most until one takes as long as its plan.
TRIES = 3


class Rig(Driven, Protocol):
    """An arm that runs plans."""

    @property
    def goals_rad(self) -> Sequence[float]:
        """Where the arm is commanded to be."""

    def use(self, model: LagModel) -> None:
        """Let the control step correct by this model from now on."""

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        """Approach the plan's start, run it, measure.

        Args:
            corrected: Whether the control step corrects goals.
        Raises:
            RequestRefused: the plan may not run, or was stopped; every reason.
        """


class ObservingClock(VirtualClock):
    """A virtual clock that notes the arm's true positions every `TRUTH_NS` while time passes."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__()
        self._arm = arm
        # None: it does not look.
        self.observe_from_ns: int | None = None
        # When, and what it saw.
        self.seen: list[tuple[int, FloatArray]] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        begin_ns = deadline_ns if self.observe_from_ns is None else self.observe_from_ns
        while (next_ns := (max(self.now_ns(), begin_ns) // TRUTH_NS + 1) * TRUTH_NS) <= deadline_ns:
            super().sleep_until_ns(next_ns)
            self._arm.advance(next_ns)
            self.seen.append((next_ns, self._arm.true_positions()))
        super().sleep_until_ns(deadline_ns)


class VirtualRig(VirtualArm):
    """A simulated arm under the real bus and control loop, in virtual time; torque is on."""

    def __init__(self, simulated: SimulatedArm, period_s: float = 0.1) -> None:
        """
        Raises:
            RequestRefused: the arm does not take torque.
        """
        self._observing = ObservingClock(simulated)
        super().__init__(simulated, period_s, clock=self._observing)
        self.energise(FIRST_TICKS)

    def use(self, model: LagModel) -> None:
        self.carry_out(UseModel(self.next_id(), model))

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        if reasons := preflight(plan, self, self.goals_rad):
            raise RequestRefused("PREFLIGHT", reasons)
        trajectory = replace(joint_trajectory(plan, self, self.goals_rad), corrected=corrected)
        clock = self._observing
        clock.seen = []
        clock.observe_from_ns = clock.now_ns() + round((trajectory.begin_s - EARLY_TICKS * self.period_s) * NS_PER_S)
        try:
            records = self.carry_out(Run(self.next_id(), trajectory))
        finally:
            clock.observe_from_ns = None
        marks = {event.code: record.inputs.sample.time_ns for record in records for event in record.outputs.events}
        begin_ns = marks.get("PLAN_BEGIN", records[0].inputs.sample.time_ns)
        end_ns = marks.get("PLAN_END", records[-1].inputs.sample.time_ns)
        inside = [record for record in records if begin_ns <= record.inputs.sample.time_ns <= end_ns]
        stamps = np.array([[reading.stamp_ns for reading in record.inputs.sample.servos] for record in inside])
        truth = [(time_ns - begin_ns, q) for time_ns, q in clock.seen if begin_ns <= time_ns <= end_ns]
        return Measured(
            time_s=(stamps.mean(axis=1) - begin_ns) / NS_PER_S,
            positions_rad=np.array([[joint.position_rad for joint in record.outputs.joints] for record in inside]),
            duration_s=(end_ns - begin_ns) / NS_PER_S,
            recording="",
            true_time_s=np.array([since_ns for since_ns, _ in truth]) / NS_PER_S,
            true_tool_m=self.simulated.tool_positions(np.array([q for _, q in truth])),
        )

    def teach(self, A: FloatArray, B: FloatArray, seed: int) -> FloatArray:
        """What the encoders see [rad], shape (samples, joints), while a simulated hand guides the limp arm from A to B.

        Raises:
            UnreachableTarget: an end of the line is out of the hand's reach.
        """
        hand = self.simulated.hand
        try:
            guided = hand.guide(A, B, seed=seed)
            records = self.carry_out(Teach(self.next_id()))
            records += self.ticks(round(guided.duration_s / self.period_s))
            self.carry_out(TeachEnd(self.next_id()))
            self.carry_out(TorqueOn(self.next_id()))
        finally:
            hand.release()
        begin, end = (round(at / self.period_s) for at in (guided.begin_s - BEFORE_S, guided.end_s + AFTER_S))
        return np.array([[joint.position_rad for joint in record.outputs.joints] for record in records[begin:end]])


class DaemonRig:
    """A daemon's arm; every run is a recording of its own, kept."""

    def __init__(self, client: Client, arm: ArmConfig) -> None:
        """
        Args:
            arm: The daemon's.
        """
        self._client, self.arm = client, arm
        self.robot = robots.get(arm.robot, arm.lengths_m)
        self.period_s = float(client.call("status")["period_s"])

    @property
    def goals_rad(self) -> Sequence[float]:
        """Where the arm is, by its encoders."""
        return [joint["position_rad"] for joint in self._client.call("status")["joints"]]

    def use(self, model: LagModel) -> None:
        """The daemon has it from the file beside the calibration."""

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        """As `Rig.run`. A run that waited for servos for long is repeated."""
        for _ in range(TRIES):
            answer = self._client.call("run", plan=plan.model_dump(mode="json"), corrected=corrected)
            path = Path(self._client.call("recordings_show", name=answer["recording"])["path"])
            measured = measured_run(recordings.load(path), float(answer["duration_s"]))
            if not waited_long(plan.duration_s, measured.duration_s, self.period_s):
                return measured
        took = f"{TRIES} runs in a row took {measured.duration_s:.2f} s or so instead of {plan.duration_s:.2f} s"
        why = "servos miss readings and the arm waits for them; see `armctl doctor`"
        raise RequestRefused("DISTURBED", f"{took}: {why}")


def measured_run(run: Recording, duration_s: float) -> Measured:
    """What a recorded run measured between the begin and the end of its plan, by the plan's time.

    What was read while the arm waited does not count; where it began to, a servo had not been heard.

    Raises:
        RequestRefused: RECORDS_LOST, the plan's begin or end is missing.
    """
    if run.plan_s is None:
        raise RequestRefused("RECORDS_LOST", f"{run.path}: the plan's begin or end is missing in the recording")
    begin_s, end_s = run.plan_s
    stood = np.diff(run.waited_s, prepend=0.0) > 0.9 * np.diff(run.time_s, prepend=-1.0)
    some = (run.time_s >= begin_s - 1e-6) & (run.time_s <= end_s + 1e-6) & ~(stood | np.append(stood[1:], False))
    waited_s = run.waited_s[some] - np.interp(begin_s, run.time_s, run.waited_s)
    return Measured(run.time_s[some] - begin_s - waited_s, run.positions_rad[some], duration_s, run.name)
