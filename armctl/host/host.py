"""The arm as all clients share it: who may command it now, and what it is asked.

Rules.
1. Every request to the control process is answered by it, in a tick record, a `stop` of an arm at rest at once;
   nothing is assumed to have happened.
2. One client at a time commands. The lease is its connection: it ends with the request, with `teach_end`, with the
   jog, or with the connection. Anyone may `stop` and `pause`; the commander's other connections may `resume` and
   change the `rate`, because the one that runs waits for its end.
3. A client that vanishes during its `run` stops the arm; while teaching it leaves the arm limp and the take kept.
"""

import asyncio
import json
import logging
import os
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from armctl import messages
from armctl.clock import NS_PER_S, Clock
from armctl.config import ArmConfig
from armctl.control.jog import led
from armctl.control.machine import ADVICE
from armctl.errors import ConfigError, IllegalTransition, RequestRefused
from armctl.host.exchange import ANSWER_S, COMMANDS, Exchange, restarting
from armctl.host.lease import Client, Lease, Leases
from armctl.host.snapshot import Statistics, arm_snapshot, fault_snapshots, note_words
from armctl.host.takes import TakeRecorder, Takes
from armctl.host.watch import Done, Leg, Watch, holds, refuse_at_limit, refuse_collision, run_name
from armctl.json_text import named
from armctl.kinematics.robots.robot import Robot
from armctl.messages import JointTrajectory, LagModel, Mode, Reply, TickRecord
from armctl.trajectory.thinning import thinned

# How long a motion may go without any progress, unless somebody paused it, before it is given up.
STUCK_S = 60.0
# Longest way to rest: half a turn of every joint at 20 deg/s takes a quarter of it.
PARK_S = 60.0
# For how long torque is asked for again when a servo was not heard just then.
UNHEARD_NS = 300_000_000
# What a run's recording keeps after the motion has ended.
TAIL_NS = 300_000_000
# What the arm does is not told from a tick that is later than its period by more than this.
STALE_NS = 300_000_000
# What is said of a stop while the port is gone.
UNREACHED = "the stop did not reach the arm: its serial port is gone; support the arm, then switch its power off"
# What is stopped when its client leaves: also a jog, whose last heartbeat may be under way.
MOVING = ("run", "path", "play", "move", "park", "reach", "grip", "transfer", "program", "jog", "jogging")

# What a log is told beside a motion; the name of its recording, and its legs.
Note = dict[str, Any] | None
Recorded = tuple[str, list[Done]]

logger = logging.getLogger(__name__)


class Host:
    """One arm, its control process of the moment, its recorder, and its commander of the moment."""

    def __init__(
        self,
        arm: ArmConfig,
        robot: Robot,
        period_s: float,
        recorder: TakeRecorder,
        clock: Clock,
        load_model: Callable[[], LagModel | None] = lambda: None,
        learn: Callable[[Sequence[Done]], str] = lambda _: "",
    ) -> None:
        """
        Args:
            load_model: The arm's own lag model, as far as there is one by now.
            learn: Learns from what was run; what is not as the model says, or nothing.
        """
        self.arm, self.robot, self.period_s = arm, robot, period_s
        self.recorder, self._clock = recorder, clock
        self._lost_ns: int | None = None
        self.exchange = Exchange()
        self.latest: TickRecord | None = None
        self._statistics = Statistics()
        self._ticked = asyncio.Event()
        self.leases = Leases()
        self.takes = Takes(recorder)
        # Whether the hand that teaches was too fast at the latest tick.
        self._hurried = False
        self._watch: Watch | None = None
        self._background: set[asyncio.Task[Any]] = set()
        self._load_model, self._learn = load_model, learn
        # What is not as the arm's model says; told to all, until `clear` or another model.
        self.notice = ""
        # The control process that was told a model, and which.
        self._model: tuple[int | None, LagModel | None] = None, None

    # ------------------------------------------------------------------------------------ control process

    def control_lost(self) -> None:
        """The control process is gone: what it still owed an answer fails."""
        self._lost_ns = self._clock.now_ns()
        self.exchange.lost()

    def receive(self, record: TickRecord) -> None:
        """Take one tick record in: to the recorder, to whoever waits, and as the present state."""
        self.recorder.put(record)
        self.latest, self._lost_ns = record, None
        self._statistics.see(record)
        self._mind_the_hand(record.outputs.mode)
        if record.outputs.mode is not Mode.JOGGING:
            self.leases.end("jogging")
        if self._watch is not None:
            self._watch.see(record)
        for reply in record.outputs.replies:
            self.exchange.answer(reply)
        for event in record.outputs.events:
            if event.severity != "info":
                logger.warning("%s: %s", event.code, event.text)
                if self._watch is not None and self.leases.current is not None:
                    self.leases.current.client.notify("progress", {"warning": event.code, "text": event.text})
        ticked, self._ticked = self._ticked, asyncio.Event()
        ticked.set()

    def _mind_the_hand(self, mode: Mode) -> None:
        """Tell, once an excursion, that the hand is too fast."""
        speed_m_s, limit_m_s = self._statistics.tool_speed_m_s() or 0.0, self.arm.tool_speed_limit_m_s
        hurried = mode is Mode.TEACHING and speed_m_s > limit_m_s
        if hurried and not self._hurried:
            text = f"the tool moves at {1e3 * speed_m_s:.0f} mm/s (bound {1e3 * limit_m_s:.0f})"
            self.note({"event": "TEACHING_FAST", "text": text})
        self._hurried = hurried

    async def tick(self) -> None:
        """Wait for the next tick record."""
        await self._ticked.wait()

    # --------------------------------------------------------------------------------------------- leases

    def client_gone(self, client: Client) -> None:
        """End what the client leaves behind, safely."""
        left = [lease for lease in self.leases.held() if lease.client is client]
        for lease in left:
            lease.lost = True
        if left and left[0] is self.leases.current and left[0].what in ("jogging", "jog", "teach"):
            self.leases.current = None  # it would outlast its request
        whats = [lease.what for lease in left]
        if "teach" in whats:
            self._in_background(self._abandon_teaching(client))
        if moving := [what for what in whats if what in MOVING]:
            text = f"the client left during its {moving[0]}: hold"
            self.note({"event": "LEASE_LOST", "who": client.name, "text": text})
            self._in_background(self.stop())

    async def _abandon_teaching(self, client: Client) -> None:
        take = await self.takes.end()
        if take is not None:
            self.note({"event": "ORPHAN_TAKE", "who": client.name, "path": str(take)})
        await self.end_teaching()

    async def end_teaching(self) -> None:
        """Leave teach mode, keeping a take that is still open; the arm stays limp."""
        await self.takes.end()
        # A fault, or a new control process, has ended the mode already.
        if self.latest is not None and self.latest.outputs.mode is Mode.TEACHING:
            await self.exchange.request(messages.TeachEnd)

    def _in_background(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._background.add(task)
        task.add_done_callback(self._background_done)

    def _background_done(self, task: asyncio.Task[Any]) -> None:
        self._background.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.warning("in the background: %s", error)

    def note(self, message: dict[str, Any]) -> None:
        """Put something no tick record tells into the log."""
        logger.info("%s", note_words(message))
        self.recorder.note(json.dumps(message), self._clock.now_ns())

    # ------------------------------------------------------------------------------------------- requests

    async def stop(self) -> dict[str, Any]:
        """Hold; returns when the arm is still. Open to every client.

        Requests share one command while it is under way, and for half a period more where nothing else was asked since.
        A motion that is still being checked does not begin any more. While the port is gone, `unreached` says so.
        """
        if self.leases.current is not None:
            self.leases.current.stopped = True
        await self.exchange.hold(self._clock.now_ns(), round(self.period_s * NS_PER_S) // 2)
        gone = self.latest is not None and not self.latest.inputs.sample.port_open
        return {**self.state(), **({"unreached": UNREACHED} if gone else {})}

    def stop_asked(self, who: str) -> None:
        """Somebody stops the arm through the control process's own socket: what is being checked begins no more."""
        if self.leases.current is not None:
            self.leases.current.stopped = True
        self.note({"request": "stop", "who": who, "outcome": "ok"})

    async def command(self, client: Client, what: str) -> dict[str, Any]:
        """One of `COMMANDS`; returns when the control process has carried it out, or refused it.

        Torque that is on stays on, and is asked for again when a reply was late just then. `park` goes slowly to rest,
        limp once there; a client that leaves meanwhile stops the arm.
        """
        asked_ns = self._clock.now_ns()
        with self.leases.commanding(client, what):
            while not (what == "torque_on" and self.state()["state"] == Mode.HOLDING.value):
                try:
                    await self.exchange.request(COMMANDS[what], PARK_S if what == "park" else ANSWER_S)
                    break
                except RequestRefused as refused:
                    if refused.code != "NO_REPLY" or self._clock.now_ns() - asked_ns > UNHEARD_NS:
                        raise
        self.notice = "" if what == "clear" else self.notice
        return self.state()

    async def pause(self) -> dict[str, Any]:
        """Bring the run to rest on its path, to be resumed there. Open to every client, as `stop` is.

        Between two legs, runs of a refinement, or steps of a program, the next one waits.
        """
        with self.leases.pausing():
            await self.exchange.request(messages.Pause)
        return self.state()

    async def resume(self, client: Client) -> dict[str, Any]:
        self.leases.refuse_others(client, "resume")
        if (lease := self.leases.current) is not None and lease.paused:
            lease.paused = False
        else:
            await self.exchange.request(messages.Resume)
        return self.state()

    async def rate(self, client: Client, rate: float) -> dict[str, Any]:
        """Run at this many trajectory seconds a second."""
        self.leases.refuse_others(client, "rate")
        await self.exchange.request(partial(messages.SetRate, rate=rate))
        if (lease := self.leases.current) is not None and lease.what != "run":  # a slow run refines nothing
            lease.rate = rate
        return {**self.state(), "rate": rate}

    async def jog(
        self, client: Client, joints_rad_s: tuple[float, ...], tool_m_s: tuple[float, ...], begin: bool
    ) -> dict[str, Any]:
        """One heartbeat of a jog; answered by the next tick, which is when the next one is due.

        Raises:
            RequestRefused: BUSY, a joint stands at its limit, the tool can go no farther straight on, a link would
                touch another, or the jog has ended.
        """
        with self.leases.commanding(client, "jog") as lease:
            if begin:
                q_now = self.commanded_joints("jog")
            elif self.latest is None or self.latest.outputs.mode is not Mode.JOGGING:
                raise IllegalTransition("the jog has ended; begin another one")
            else:
                q_now = self.latest.outputs.wanted_rad
            self.exchange.forget_hold()  # a stop from now on is a new one
            if len(joints_rad_s) == len(q_now) or len(tool_m_s) == 3:
                ahead = led(self.arm, self.robot, q_now, messages.Jog(0, joints_rad_s, tool_m_s))
                refuse_at_limit(q_now, ahead, self.arm)
                refuse_collision(q_now, ahead, self.arm, self.robot)
            await self.exchange.request(lambda request_id: messages.Jog(request_id, joints_rad_s, tool_m_s, begin))
        if not lease.lost and self.latest is not None and self.latest.outputs.mode is Mode.JOGGING:
            self.leases.keep(client, "jogging")
        return self.state()

    async def execute(self, client: Client, what: str, legs: Sequence[Leg], note: Note = None) -> Recorded:
        """Run one leg after the other, each made from where the arm is then; returns when it rests after the last.

        Args:
            note: Goes into the recording before the first leg.
        Returns:
            The one recording of them all, and what became of each.
        Raises:
            RequestRefused: a leg cannot be made (before the first one nothing has moved), or was stopped, or failed.
            LogError: the recording cannot be made.
        """
        with self.leases.commanding(client, what) as lease:
            return await self.carry_out(lease, legs, note)

    async def carry_out(self, lease: Lease, legs: Sequence[Leg], note: Note = None) -> Recorded:
        """`execute` for a client that commands already."""
        trajectory = await self._made(legs[0], lease.what)
        await self._use_model()
        done: list[Done] = []
        async with self.takes.around(run_name(trajectory.label)) as name:
            try:
                if note is not None:
                    self.note(note)
                for leg in legs:
                    if done:
                        trajectory = await self._made(leg, lease.what)
                    while lease.paused and not (lease.stopped or lease.lost):
                        await self.tick()
                    lease.refuse_if_over()
                    lease.begun, self._watch = True, (watch := Watch())
                    self.exchange.forget_hold()  # a stop from now on is a new one
                    done.append(Done(trajectory, watch, await self._run_to_its_end(trajectory, lease.rate)))
                    end_ns = watch.time_ns[-1] + TAIL_NS
                    while len(done) == len(legs) and watch.time_ns[-1] < end_ns:
                        await self.tick()
            finally:
                self._watch = None
        if notice := await asyncio.to_thread(self._learn, done):
            self.notice = notice
            self.note({"event": "MODEL", "text": notice})
            lease.client.notify("progress", {"warning": "MODEL", "text": notice})
        return name, done

    async def _made(self, leg: Leg, what: str) -> JointTrajectory:
        q_now = self.commanded_joints(what)
        return await asyncio.to_thread(lambda: thinned(leg(q_now)))

    async def own_model(self) -> LagModel | None:
        """The arm's own lag model, if there is one that can be read."""
        try:
            return await asyncio.to_thread(self._load_model)
        except ConfigError as error:
            logger.error("the lag of this arm is foreseen as that of a new one: %s", error)
            return None

    async def _use_model(self) -> None:
        """Let the control process correct by the arm's own model, if there is one that it does not know yet."""
        model = await self.own_model()
        if model is not None and (self.exchange.pid, model) != self._model:
            await self.exchange.request(lambda request_id: messages.UseModel(request_id, model))
            if self._model[1] not in (None, model):
                self.notice = ""
            self._model = self.exchange.pid, model

    async def _run_to_its_end(self, trajectory: JointTrajectory, rate: float) -> Reply:
        request = asyncio.ensure_future(self.exchange.request(partial(messages.Run, trajectory=trajectory), None))
        try:
            if rate != 1.0:  # behind the run, in the same tick
                self._in_background(self.exchange.request(partial(messages.SetRate, rate=rate)))
            before = None
            while not (await asyncio.wait({request}, timeout=STUCK_S))[0]:
                assert self.latest is not None  # the trajectory begins where it was seen
                outputs = self.latest.outputs
                if outputs.progress == before and outputs.rate != 0.0:
                    self._in_background(self.stop())
                    why = f"the motion made no progress for {STUCK_S:g} s; see `armctl status`"
                    raise RequestRefused("NO_ANSWER", why)
                before = outputs.progress
            return request.result()
        finally:
            request.cancel()

    def commanded_joints(self, what: str) -> tuple[float, ...]:
        """Where the joints of a holding arm are wanted now [rad]."""
        if self.exchange.pid is None or self.latest is None:
            raise restarting()
        now = self.latest.outputs
        if now.mode is not Mode.HOLDING:
            why = ADVICE[now.mode].format(fault=now.fault and now.fault.code)
            raise IllegalTransition(f"{what} is not possible while {now.mode.value}: {why}")
        return now.wanted_rad

    def holds(self) -> bool:
        """Whether the gripper holds something now."""
        return self.latest is not None and holds(self.arm, [one.load_ratio for one in self.latest.outputs.joints])

    # --------------------------------------------------------------------------------------------- status

    def state(self) -> dict[str, Any]:
        """What the arm does now: the answer to most requests."""
        if self.latest is None or self.exchange.pid is None:
            return {"state": "restarting" if self._lost_ns is not None else Mode.STARTING.value}
        if self._clock.now_ns() - self.latest.inputs.now_ns > round(self.period_s * NS_PER_S) + STALE_NS:
            return {"state": "stalled"}
        return {"state": self.latest.outputs.mode.value}

    def log(self) -> dict[str, Any]:
        """Where the log goes, why it does not, and how many ticks the host was too slow for."""
        return {**self.takes.log(), "dropped": self._statistics.dropped}

    def status(self) -> dict[str, Any]:
        """The snapshot every client sees, as of now."""
        now_ns, commander = self._clock.now_ns(), self.leases.current
        faults = fault_snapshots(self.latest, self._lost_ns, now_ns)
        return {
            **self.state(),
            "fault": faults[0] if faults else None,
            "faults": faults,
            "notice": self.notice or None,
            "period_s": self.period_s,
            **arm_snapshot(self.arm, self.latest, self._statistics, now_ns),
            "recording": self.takes.name,
            "commander": None if commander is None else f"{commander.client.name}: {commander.what}",
            "log": self.log(),
            **named(self.arm, "arm_id", "calibration_hash", "tool_speed_limit_m_s"),
            "pids": {"daemon": os.getpid(), "control": self.exchange.pid},
        }
