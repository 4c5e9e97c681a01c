"""The arm as all clients share it: who may command it now, what it is asked, and what was seen of it.

Rules.
1. Every request to the control process is answered by it, in a tick record; nothing is assumed to have happened.
2. One client at a time commands. The lease is its connection: it ends with the request, with `teach_end`, or
   with the connection. Anyone may `stop`.
3. A client that vanishes during its `run` stops the arm; while teaching it leaves the arm limp and the take kept.
4. Nothing here looks fresher than it is: ages grow from the last tick on, also when no tick comes any more.
"""

from __future__ import annotations

import asyncio
import itertools
import json
import logging
import os
import re
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from armctl.clock import NS_PER_S, Clock
from armctl.config import ArmConfig
from armctl.control.faults import card
from armctl.dynamixel import ax12a
from armctl.errors import IllegalTransition, RequestRefused
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import matrix_from_quaternion, rpy_from_matrix
from armctl.messages import (
    Clear,
    Command,
    Fault,
    Hold,
    JointState,
    Mode,
    Park,
    Release,
    Reply,
    Run,
    Teach,
    TeachEnd,
    TickRecord,
    ToolPose,
    TorqueOn,
)
from armctl.recording.channels import COMMAND, OVERRUN_NS
from armctl.trajectory.plan import Plan, joint_trajectory, preflight
from armctl.trajectory.straightness import max_error, mean_error

ANSWER_S = 10.0
"""Longest wait for the control process's answer to anything but the end of a motion."""
PAUSES_S = 60.0
"""How much longer than planned a motion may take: it pauses while a servo is silent."""
PARK_S = 60.0
"""Longest way to rest: half a turn of every joint at 20 deg/s takes a quarter of it."""
TAIL_NS = 300_000_000
"""What a run's recording keeps after the motion has ended."""
STATISTICS_TICKS = 600

logger = logging.getLogger(__name__)


class Sender(Protocol):
    """The host's end of the link to a control process."""

    def send(self, message: object) -> bool: ...


class Control(Protocol):
    """The control process as far as commands need it."""

    @property
    def pid(self) -> int: ...
    @property
    def link(self) -> Sender: ...


class TakeRecorder(Protocol):
    """The recorder as far as requests need it."""

    @property
    def log_path(self) -> Path | None: ...
    @property
    def problem(self) -> str: ...
    def put(self, record: TickRecord) -> None: ...
    def note(self, topic: str, text: str, time_ns: int) -> None: ...
    def begin_take(self, name: str) -> Path: ...
    def end_take(self) -> Path | None: ...


class Client(Protocol):
    """Whoever asks; one connection."""

    @property
    def name(self) -> str: ...


@dataclass(eq=False)
class _Lease:
    client: Client
    what: str
    lost: bool = False


@dataclass
class _Watch:
    """What is seen of the arm while a plan runs."""

    time_ns: list[int] = field(default_factory=list)
    positions_rad: list[tuple[float, ...]] = field(default_factory=list)
    marks_ns: dict[str, int] = field(default_factory=dict)

    def see(self, record: TickRecord) -> None:
        self.time_ns.append(record.inputs.sample.time_ns)
        self.positions_rad.append(tuple(joint.position_rad for joint in record.outputs.joints))
        for event in record.outputs.events:
            if event.code in ("PLAN_BEGIN", "PLAN_END"):
                self.marks_ns[event.code] = record.inputs.sample.time_ns


class Host:
    """One arm, its control process of the moment, its recorder, and its commander of the moment."""

    def __init__(self, arm: ArmConfig, robot: Robot, period_s: float, recorder: TakeRecorder, clock: Clock) -> None:
        self.arm, self.robot, self.period_s = arm, robot, period_s
        self.recorder = recorder
        self._clock = clock
        self._control: Control | None = None
        self._lost_ns: int | None = None
        self._ids = itertools.count(1)
        self._pending: dict[int, asyncio.Future[Reply]] = {}
        self._latest: TickRecord | None = None
        self._dropped = 0
        self._statistics: deque[tuple[int, int, int]] = deque(maxlen=STATISTICS_TICKS)
        self._ticked = asyncio.Event()
        self._lease: _Lease | None = None
        self._take: str | None = None
        self._take_lock = asyncio.Lock()
        self._watch: _Watch | None = None
        self._hold: asyncio.Task[Reply] | None = None
        self._background: set[asyncio.Task[Any]] = set()

    # ------------------------------------------------------------------------------------ control process

    def attach(self, control: Control) -> None:
        """Commands go to this control process from now on."""
        self._control = control

    def control_lost(self) -> None:
        """The control process is gone: what it still owed an answer fails."""
        self._control, self._lost_ns = None, self._clock.now_ns()
        for future in self._pending.values():
            if not future.done():
                future.set_exception(_restarting())

    def receive(self, record: TickRecord) -> None:
        """Take one tick record in: to the recorder, to whoever waits, and as the present state."""
        self.recorder.put(record)
        self._latest, self._lost_ns = record, None
        self._dropped += record.dropped
        self._statistics.append((record.inputs.sample.bus_us, record.lateness_us, record.inputs.sample.retries))
        if self._watch is not None:
            self._watch.see(record)
        for reply in record.outputs.replies:
            future = self._pending.get(reply.request_id)
            if future is not None and not future.done():
                future.set_result(reply)
        for event in record.outputs.events:
            if event.severity != "info":
                logger.warning("%s: %s", event.code, event.text)
        ticked, self._ticked = self._ticked, asyncio.Event()
        ticked.set()

    async def tick(self) -> None:
        """Wait for the next tick record."""
        await self._ticked.wait()

    async def _request(self, make: Callable[[int], Command], timeout_s: float = ANSWER_S) -> Reply:
        """Send a command and wait for what became of it.

        Raises:
            RequestRefused: it was refused, or the control process died or stayed silent.
        """
        request_id = next(self._ids)
        future: asyncio.Future[Reply] = asyncio.get_running_loop().create_future()
        self._pending[request_id] = future
        try:
            async with asyncio.timeout(timeout_s):
                while not self._send(make(request_id)) and not future.done():
                    await asyncio.sleep(0.01)
                reply = await future
        except TimeoutError:
            raise RequestRefused(
                "NO_ANSWER", f"the control process did not answer within {timeout_s:g} s; see `armctl status`"
            ) from None
        finally:
            del self._pending[request_id]
        if reply.ok:
            return reply
        if reply.code == "ILLEGAL_TRANSITION":
            raise IllegalTransition(reply.message)
        raise RequestRefused(reply.code, reply.message)

    def _send(self, command: Command) -> bool:
        if self._control is None:
            raise _restarting()
        return self._control.link.send(command)

    # --------------------------------------------------------------------------------------------- leases

    @contextmanager
    def _commanding(self, client: Client, what: str) -> Iterator[_Lease]:
        """Hold the lease for one request.

        Raises:
            RequestRefused: code BUSY, naming who commands.
        """
        self._refuse_if_busy(client, what)
        before, lease = self._lease, _Lease(client, what)
        self._lease = lease
        try:
            yield lease
        finally:
            if self._lease is lease:
                self._lease = before

    def _refuse_if_busy(self, client: Client, what: str) -> None:
        lease = self._lease
        if lease is None or (lease.client is client and lease.what == "teach" and what not in ("run", "teach_begin")):
            return
        who = "this client" if lease.client is client else f"client {lease.client.name}"
        end = "end the teaching first" if lease.what == "teach" else "wait, or `armctl stop`"
        raise RequestRefused("BUSY", f"{what}: {who} commands the arm now ({lease.what}); {end}")

    def _teaching(self, client: Client) -> None:
        if self._lease is None or self._lease.client is not client or self._lease.what != "teach":
            raise IllegalTransition("this client is not teaching; teach_begin comes first")

    def client_gone(self, client: Client) -> None:
        """End what the client leaves behind, safely."""
        lease = self._lease
        if lease is None or lease.client is not client:
            return
        lease.lost = True
        if lease.what in ("run", "park"):
            self.note(
                {"event": "LEASE_LOST", "who": client.name, "text": f"the client left during its {lease.what}: hold"}
            )
            self._in_background(self.stop())
        elif lease.what == "teach":
            self._lease = None
            self._in_background(self._abandon_teaching(client))

    def _in_background(self, work: Any) -> None:
        task = asyncio.ensure_future(work)
        self._background.add(task)
        task.add_done_callback(self._background_done)

    def _background_done(self, task: asyncio.Task[Any]) -> None:
        self._background.discard(task)
        if not task.cancelled() and (error := task.exception()) is not None:
            logger.warning("after a client left: %s", error)

    def note(self, message: dict[str, Any]) -> None:
        """Put something no tick record tells into the log."""
        logger.info("%s", message)
        self.recorder.note(COMMAND, json.dumps(message), self._clock.now_ns())

    # ------------------------------------------------------------------------------------------- requests

    async def stop(self) -> dict[str, Any]:
        """Hold; returns when the arm is still. Open to every client; requests under way share one command."""
        if self._hold is None or self._hold.done():
            self._hold = asyncio.create_task(self._request(Hold))
        await asyncio.shield(self._hold)
        return self._state()

    async def release(self, client: Client) -> dict[str, Any]:
        return await self._command(client, "release", Release)

    async def torque_on(self, client: Client) -> dict[str, Any]:
        return await self._command(client, "torque_on", TorqueOn)

    async def clear(self, client: Client) -> dict[str, Any]:
        return await self._command(client, "clear", Clear)

    async def park(self, client: Client) -> dict[str, Any]:
        """Go slowly to rest, limp once there; returns then. A client that leaves meanwhile stops the arm."""
        with self._commanding(client, "park"):
            await self._request(Park, PARK_S)
            return self._state()

    async def _command(self, client: Client, what: str, make: Callable[[int], Command]) -> dict[str, Any]:
        with self._commanding(client, what):
            await self._request(make)
            return self._state()

    async def teach_begin(self, client: Client) -> dict[str, Any]:
        """Make the arm limp; the client keeps the lease until `teach_end`."""
        with self._commanding(client, "teach_begin") as lease:
            await self._request(Teach)
            if lease.lost:
                await self._request(TeachEnd)
        if not lease.lost:
            self._lease = _Lease(client, "teach")
        return self._state()

    async def take_begin(self, client: Client, name: str) -> dict[str, Any]:
        """Start recording a take.

        Raises:
            LogError: the name is taken, or the file cannot be written.
        """
        self._teaching(client)
        if self._take is not None:
            raise IllegalTransition(f"take {self._take} is being recorded; take_end comes first")
        path = await self._begin_take(name)
        return {"recording": name, "path": str(path)}

    async def take_end(self, client: Client) -> dict[str, Any]:
        """Finish the take."""
        self._teaching(client)
        if self._take is None:
            raise IllegalTransition("no take is being recorded; take_begin comes first")
        name = self._take
        path = await self._end_take()
        return {"recording": name, "path": str(path)}

    async def teach_end(self, client: Client) -> dict[str, Any]:
        """Leave teach mode, keeping a take that is still open; the arm stays limp."""
        self._teaching(client)
        lease = self._lease
        try:
            await self._end_teaching()
        finally:
            if self._lease is lease:
                self._lease = None
        return self._state()

    async def _end_teaching(self) -> None:
        await self._end_take()
        # A fault, or a new control process, has ended the mode already.
        if self._latest is not None and self._latest.outputs.mode is Mode.TEACHING:
            await self._request(TeachEnd)

    async def _abandon_teaching(self, client: Client) -> None:
        take = await self._end_take()
        if take is not None:
            self.note({"event": "ORPHAN_TAKE", "who": client.name, "path": str(take)})
        await self._end_teaching()

    async def _begin_take(self, name: str) -> Path:
        async with self._take_lock:  # whoever ends a take waits until it has begun
            path = await asyncio.to_thread(self.recorder.begin_take, name)
            self._take = name
            return path

    async def _end_take(self) -> Path | None:
        async with self._take_lock:
            try:
                return await asyncio.to_thread(self.recorder.end_take)
            finally:
                self._take = None

    async def run(self, client: Client, plan: Plan) -> dict[str, Any]:
        """Pre-flight, slow approach, the plan itself; recorded, and compared with the line it was made for.

        Raises:
            RequestRefused: pre-flight (every reason), BUSY, stopped or failed on the way.
            LogError: the recording cannot be made.
        """
        with self._commanding(client, "run") as lease:
            q_now = self._commanded_joints()
            reasons = await asyncio.to_thread(preflight, plan, self.arm, self.robot, q_now)
            if reasons:
                raise RequestRefused("PREFLIGHT" if self._within_limits(plan) else "LIMIT", reasons)
            trajectory = joint_trajectory(plan, self.arm, q_now, self.period_s)
            name = _run_name(trajectory.label or f"via{plan.via}")
            await self._begin_take(name)
            try:
                if lease.lost:
                    raise RequestRefused("LEASE_LOST", "the client left before its run began")
                self._watch = watch = _Watch()
                self._hold = None  # a stop from now on is a new one
                try:
                    await self._request(
                        lambda request_id: Run(request_id, trajectory), trajectory.duration_s + PAUSES_S
                    )
                except RequestRefused as refusal:
                    if refusal.code == "NO_ANSWER":
                        self._in_background(self.stop())
                    raise
                end_ns = watch.time_ns[-1] + TAIL_NS
                while watch.time_ns[-1] < end_ns:
                    await self.tick()
            finally:
                self._watch = None
                await self._end_take()
            return {"recording": name, **self._measured(plan, watch)}

    def _commanded_joints(self) -> tuple[float, ...]:
        """Where the servos are told to be now [rad], one a joint: their own goal registers."""
        latest = self._latest
        if self._control is None or latest is None:
            raise _restarting()
        if (mode := latest.outputs.mode) is not Mode.HOLDING:
            raise IllegalTransition(f"run: the arm is {mode.value}, not holding; {_TO_HOLD[mode]}")
        return tuple(
            joint.position_rad(ax12a.register_value(ax12a.GOAL, reading.registers))
            for joint, reading in zip(self.arm.joints, latest.inputs.sample.servos, strict=True)
        )

    def _within_limits(self, plan: Plan) -> bool:
        low, high = np.array([joint.limits_rad for joint in self.arm.joints]).T
        q = np.array(plan.waypoints_rad)
        return q.shape[1] == len(low) and bool(((low <= q) & (q <= high)).all())

    def _measured(self, plan: Plan, watch: _Watch) -> dict[str, Any]:
        """The executed path against the plan's line (Raharjo et al. eqs. 19, 20)."""
        if len(watch.marks_ns) < 2:
            raise RequestRefused("RECORDS_LOST", "the run ended, but its beginning or end was lost; see its recording")
        begin_ns, end_ns = watch.marks_ns["PLAN_BEGIN"], watch.marks_ns["PLAN_END"]
        time_ns = np.array(watch.time_ns)
        q = np.array(watch.positions_rad)[(begin_ns <= time_ns) & (time_ns <= end_ns), : self.robot.chain.n]
        points = tool_position(self.robot.chain, q)
        line = np.asarray(plan.from_m), np.asarray(plan.to_m)
        return {
            "mean_error_mm": 1e3 * float(mean_error(points, *line)),
            "max_error_mm": 1e3 * float(max_error(points, *line)),
            "duration_s": (end_ns - begin_ns) / NS_PER_S,
            "predicted_mean_error_mm": plan.predicted_mean_error_mm,
            "predicted_max_error_mm": plan.predicted_max_error_mm,
            "begin_ns": begin_ns,
            "end_ns": end_ns,
        }

    # --------------------------------------------------------------------------------------------- status

    def _state(self) -> dict[str, Any]:
        return {"state": self._state_name()}

    def _state_name(self) -> str:
        if self._latest is None or self._control is None:
            return "restarting" if self._lost_ns is not None else "starting"
        return self._latest.outputs.mode.value

    def log(self) -> dict[str, Any]:
        """Where the log goes, why it does not, and how many ticks the host was too slow for."""
        recorder = self.recorder
        path = None if recorder.log_path is None else str(recorder.log_path)
        return {"path": path, "problem": recorder.problem, "dropped": self._dropped}

    def status(self) -> dict[str, Any]:
        """The snapshot every client sees, as of now."""
        now_ns = self._clock.now_ns()
        latest = self._latest
        age_s = None if latest is None else max(0, now_ns - latest.inputs.now_ns) / NS_PER_S
        states = (None,) * len(self.arm.joints) if latest is None else latest.outputs.joints
        tool = None if latest is None else latest.outputs.tool
        return {
            "state": self._state_name(),
            "fault": self._fault(now_ns),
            "tick": None if latest is None else latest.inputs.tick,
            "age_s": age_s,
            "period_s": self.period_s,
            "joints": [
                {"name": joint.name, "servo_id": joint.servo_id, **_joint(state, age_s)}
                for joint, state in zip(self.arm.joints, states, strict=True)
            ],
            "tool": None if tool is None else _tool(tool),
            "cycle": self._cycle(),
            "recording": self._take,
            "progress": None if latest is None else latest.outputs.progress,
            "commander": None if self._lease is None else f"{self._lease.client.name}: {self._lease.what}",
            "log": self.log(),
            "arm_id": self.arm.arm_id,
            "pids": {"daemon": os.getpid(), "control": None if self._control is None else self._control.pid},
        }

    def _fault(self, now_ns: int) -> dict[str, Any] | None:
        if self._lost_ns is not None:
            fault = Fault("RESTARTED", "the control process died; a new one is being started", self._lost_ns)
            arm, following = (
                "still; every servo keeps its last goal with the torque it has",
                "wait a second, then type `armctl status`",
            )
        elif self._latest is None or self._latest.outputs.fault is None:
            return None
        else:
            fault = self._latest.outputs.fault
            arm, following = card(fault, self._latest.outputs.mode)
        return {
            "code": fault.code,
            "servo_id": fault.servo_id,
            "since_s": max(0, now_ns - fault.since_ns) / NS_PER_S,
            "arm": arm,
            "next": following,
            "text": fault.text,
        }

    def _cycle(self) -> dict[str, int]:
        """Bus and timing figures of the last minute (at 10 Hz)."""
        bus_us, lateness_us, retries = zip(*self._statistics, strict=True) if self._statistics else ((0,),) * 3
        return {
            "bus_us_p50": _percentile(bus_us, 50),
            "bus_us_p99": _percentile(bus_us, 99),
            "lateness_us_p99": _percentile(lateness_us, 99),
            "overruns": sum(late > OVERRUN_NS // 1000 for late in lateness_us),
            "retries": sum(retries),
        }


_TO_HOLD = {
    Mode.OFF: "`armctl torque on` first",
    Mode.ENERGISING: "wait until torque is on",
    Mode.MOVING: "wait, or `armctl stop`",
    Mode.PARKING: "wait, or `armctl stop`",
    Mode.TEACHING: "end the teaching first",
    Mode.FAULTED: "see `armctl status`, then `armctl clear`",
}


def _restarting() -> RequestRefused:
    return RequestRefused(
        "RESTARTED", "the control process died and is being started again; the arm keeps its last goal; try again"
    )


def _run_name(label: str) -> str:
    """A recording's name: what ran, and when."""
    stamp = datetime.now(UTC).strftime("%Y%m%dT%H%M%S.%f")[:-3]
    return f"run-{re.sub('[^A-Za-z0-9._-]', '-', label)[:32]}-{stamp}Z"


def _joint(state: JointState | None, tick_age_s: float | None) -> dict[str, Any]:
    if state is None or tick_age_s is None or not state.known:
        return dict.fromkeys(
            ("position_rad", "velocity_rad_s", "load_ratio", "voltage_V", "temperature_degC", "torque_enabled", "age_s")
        )
    return {
        "position_rad": state.position_rad,
        "velocity_rad_s": state.velocity_rad_s,
        "load_ratio": state.load_ratio,
        "voltage_V": state.voltage_V,
        "temperature_degC": state.temperature_degC,
        "torque_enabled": state.torque_enabled,
        "age_s": state.age_s + tick_age_s,
    }


def _tool(pose: ToolPose) -> dict[str, Any]:
    rpy = rpy_from_matrix(matrix_from_quaternion(pose.quaternion))
    return {"position_m": list(pose.position_m), "rpy_rad": list(rpy)}


def _percentile(values: tuple[int, ...], percent: int) -> int:
    return sorted(values)[(len(values) - 1) * percent // 100]
