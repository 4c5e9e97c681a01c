"""A simulated arm that is asked as a daemon's is, without a daemon, and looked at where it truly is.

Requests are the daemon's own (`armctl/host/motions.py`, `reach.py`); they reach the control step through `execute`, as
they do through the host. What the judge goes by is not what they answer, but the true shafts and the servos' registers.
"""

from collections.abc import Coroutine, Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, TypeVar, cast

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.files import load_arm
from armctl.host import motions, reach
from armctl.host.host import Host
from armctl.host.watch import Done, Leg, Watch
from armctl.lab.sag_identification import identify
from armctl.messages import Command, Jog, JointTrajectory, LagModel, Mode, Reply, Run, TickRecord, UseModel
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault
from armctl.sim.spec import RANDOM_SPEC, ArmSpec
from armctl.sim.virtual_arm import VirtualArm
from armctl.trajectory.grasp import ReachRequest
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import Measured
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.thinning import thinned
from armctl.trajectory.transfer import TransferRequest
from proving import reading
from proving.arms import arm_text
from proving.reading import GOAL, TICK_DEG
from proving.truth import FloatArray, Reach

ARM = "ax12-line"
FIRST_TICKS = 5
# Time between two looks at a tool that draws a line.
LOOK_NS = 4_000_000
# So long before a plan can begin.
EARLY_S = 0.3
# A motion that takes longer beyond its trajectory is given up.
PATIENCE_S = 15.0
# From its last heartbeat to where a jog has ended.
JOG_ENDS_S = 1.0
# What a daemon still records after a motion.
TAIL_S = 0.3

Answer = TypeVar("Answer")


@dataclass(frozen=True, slots=True)
class Look:
    """The arm after one tick."""

    time_s: float
    # The shafts' true positions [rad], and the goals that the servos have [rad].
    joints_rad: tuple[float, ...]
    goals_rad: tuple[float, ...]
    # Where along its trajectory the arm is told to be by now; None: nowhere.
    progress: float | None
    mode: Mode
    # Codes of the faults that are latched.
    faults: tuple[str, ...]


class _Eye(VirtualClock):
    """A clock that looks at an arm every `LOOK_NS` while time passes, from when it is told to."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__()
        self._arm = arm
        # None: it does not look.
        self.open_ns: int | None = None
        self.seen: list[tuple[int, FloatArray]] = []

    def sleep_until_ns(self, deadline_ns: int) -> None:
        begin_ns = deadline_ns if self.open_ns is None else self.open_ns
        while (next_ns := (max(self.now_ns(), begin_ns) // LOOK_NS + 1) * LOOK_NS) <= deadline_ns:
            super().sleep_until_ns(next_ns)
            self._arm.advance(next_ns)
            self.seen.append((next_ns, self._arm.true_positions()))
        super().sleep_until_ns(deadline_ns)


class ServedArm:
    """One arm under torque; a rig to the laboratory, a host to the daemon's requests."""

    def __init__(
        self,
        seed: int,
        spec: ArmSpec = RANDOM_SPEC,
        *,
        name: str = ARM,
        taken: ArmConfig | None = None,
        correction: bool = True,
        model: LagModel | None = None,
        period_s: float = 0.1,
    ) -> None:
        """
        Args:
            taken: What the program takes it for; None: what its file says.
        Raises:
            RequestRefused: the arm does not take torque, or not this model.
        """
        self.simulated = SimulatedArm(load_arm(name), seed=seed, spec=spec)
        arm: ArmConfig = (taken or self.simulated.config).model_copy(update={} if correction else {"correction": False})
        self._eye = _Eye(self.simulated)
        self._virtual = VirtualArm(self.simulated, period_s, arm=arm, clock=self._eye)
        self.arm, self.robot, self.period_s = arm, self._virtual.robot, period_s
        judged = reading.read(arm_text(name))
        self._joints = judged.joints
        # Of the true arm, whatever its file says of its lengths.
        self.truly = Reach(judged, self.simulated.chain)
        # Every tick, from which on the last motion; what it was to be, where its tool truly went, and how long it took.
        self.looks: list[Look] = []
        self.began = 0
        self.asked: JointTrajectory | None = None
        self.path_m: FloatArray = np.empty((0, 3))
        self.took_s = 0.0
        self._records: list[TickRecord] = []
        self._virtual.on_tick = self._look
        self._virtual.energise(FIRST_TICKS)
        if model is not None:
            self.use(model)

    # ------------------------------------------------------------------------------------------ what is asked of it

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        """Run a plan as `armctl run` has it done; what its encoders showed, and nothing of the truth."""
        self._eye.seen = []
        try:
            answer = _answer(motions.run(self._host, self._client, plan, corrected=corrected))
        finally:
            self._eye.open_ns = None
        begin_ns, end_ns = answer["begin_ns"], answer["end_ns"]
        inside = [record for record in self._records if begin_ns <= record.inputs.sample.time_ns <= end_ns]
        self.path_m = self.truly.tool_m(np.array([q for at_ns, q in self._eye.seen if begin_ns <= at_ns <= end_ns]))
        self.took_s = (end_ns - begin_ns) / NS_PER_S
        stamps = np.array([[one.stamp_ns for one in record.inputs.sample.servos] for record in inside])
        return Measured(
            time_s=(stamps.mean(axis=1) - begin_ns) / NS_PER_S,
            positions_rad=np.array([[joint.position_rad for joint in record.outputs.joints] for record in inside]),
            duration_s=self.took_s,
            recording="",
        )

    def move(self, request: MoveRequest) -> dict[str, Any]:
        """As `armctl move` does."""
        return _answer(motions.move(self._host, self._client, request))

    def reach(self, request: ReachRequest) -> dict[str, Any]:
        """As `armctl reach` does."""
        return _answer(reach.reach(self._host, self._client, request))

    def transfer(self, request: TransferRequest) -> dict[str, Any]:
        """As `armctl transfer` does."""
        return _answer(motions.transfer(self._host, self._client, request))

    def jog(self, tool_m_s: FloatArray, seconds: float) -> str:
        """As a button does that is held for so long; why the tool went no farther, empty: nobody said so."""
        self._eye.seen, self._eye.open_ns = [], self._eye.now_ns()
        x, y, z = tool_m_s.tolist()
        told = ""
        for beat in range(round(seconds / self.period_s)):
            record = self._virtual.tick(Jog(self._virtual.next_id(), (), (x, y, z), begin=beat == 0))
            if told := next((reply.message for reply in record.outputs.replies if not reply.ok), ""):
                break
        self._eye.open_ns = None
        self.path_m = self.truly.tool_m(np.array([q for _, q in self._eye.seen]))
        self.wait(JOG_ENDS_S)
        return told

    def use(self, model: LagModel) -> None:
        """Offer the control step a model, as the host does before a motion."""
        self._virtual.carry_out(UseModel(self._virtual.next_id(), model))

    def wait(self, seconds: float) -> list[TickRecord]:
        """Nothing is asked for a while; what the program says meanwhile."""
        return self._virtual.ticks(round(seconds / self.period_s))

    @property
    def tool_m(self) -> FloatArray:
        """Where the tool truly is [m], shape (3,)."""
        return np.asarray(self.truly.tool_m(np.array([self.looks[-1].joints_rad]))[0])

    def strike(self, kind: str, joint: int, begin_s: float, duration_s: float) -> None:
        """A fault of the simulator, so long from now."""
        servo_id = self.arm.joints[joint].servo_id
        fault = Fault(kind=kind, servo_id=servo_id, begin_s=begin_s, duration_s=duration_s)
        self.simulated.faults.begin(fault, self.simulated.time_s)

    @property
    def goals_rad(self) -> tuple[float, ...]:
        """Where the joints are wanted."""
        return self._virtual.goals_rad

    # ---------------------------------------------------------------------------------------------- as a host has it

    @property
    def _host(self) -> Host:
        return cast(Host, self)  # which has what the requests use of one

    _client = cast(Any, None)

    async def execute(
        self, _client: object, what: str, legs: Sequence[Leg], _note: dict[str, Any] | None = None
    ) -> tuple[str, list[Done]]:
        """Run one leg after the other, each made from where the arm is then.

        Raises:
            RequestRefused: a leg cannot be made, was refused, or ended by a fault.
        """
        done = []
        for leg in legs:
            trajectory = thinned(leg(self.goals_rad))
            self._records, self.asked, self.began = [], trajectory, len(self.looks)
            if trajectory.end_s > trajectory.begin_s:
                self._eye.open_ns = self._eye.now_ns() + round((trajectory.begin_s - EARLY_S) * NS_PER_S)
            done.append(self._to_its_end(trajectory))
        for record in self._virtual.ticks(round(TAIL_S / self.period_s)):
            done[-1].watch.see(record)
        return what, done

    def _to_its_end(self, trajectory: JointTrajectory) -> Done:
        watch = Watch()
        reply: Reply | None = None
        command: tuple[Command, ...] = (Run(self._virtual.next_id(), trajectory),)
        for _ in range(round((trajectory.duration_s + PATIENCE_S) / self.period_s)):
            record = self._virtual.tick(*command)
            watch.see(record)
            command = ()
            reply = next(iter(record.outputs.replies), reply)
            if reply is not None and record.outputs.mode is not Mode.MOVING:
                if not reply.ok:
                    raise RequestRefused(reply.code, reply.message)
                return Done(trajectory, watch, reply)
        raise RequestRefused("NO_ANSWER", f"{trajectory.label} did not end within {PATIENCE_S:g} s of its time")

    # -------------------------------------------------------------------------------------------------- as it truly is

    def _look(self, record: TickRecord) -> None:
        self._records.append(record)
        goals = [servo.table[GOAL.address] | servo.table[GOAL.address + 1] << 8 for servo in self.simulated.servos]
        at = [
            np.radians(joint.direction * (tick - joint.zero_tick) * TICK_DEG)
            for tick, joint in zip(goals, self._joints, strict=True)
        ]
        self.looks.append(
            Look(
                record.inputs.now_ns / NS_PER_S,
                tuple(self.simulated.true_positions().tolist()),
                tuple(map(float, at)),
                record.outputs.progress,
                record.outputs.mode,
                tuple(fault.code for fault in record.outputs.faults),
            )
        )


@cache
def identified(seed: int) -> LagModel:
    """The model of an arm as its seed draws it, from calibration lines that this arm has run."""
    return identify(ServedArm(seed), np.random.default_rng(seed))


def _answer(coroutine: Coroutine[Any, Any, Answer]) -> Answer:
    """What a request answers that never has to wait: virtual time passes inside it."""
    try:
        coroutine.send(None)
    except StopIteration as done:
        return cast(Answer, done.value)
    raise AssertionError("a request waited for something that is not the arm")
