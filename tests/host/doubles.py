"""Stand-ins for what the host talks to: ideal servos behind the real control step, and a recorder in memory."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import ParamSpec, Self, TypeVar, cast

import pytest

from armctl.clock import VirtualClock
from armctl.config import ArmConfig, Config
from armctl.control.link import Link, LinkClosed, Ready
from armctl.dynamixel import ax12a
from armctl.errors import IllegalTransition, LogError, RequestRefused
from armctl.host.host import Host
from armctl.host.methods import Methods, RunOptimisation
from armctl.kinematics.transform import FloatArray
from armctl.messages import Command, Connected, Inputs, Mode, Run, Sample, ServoReading, TickRecord
from armctl.recording.writer import LogContext
from armctl.trajectory.plan import Plan
from tests.control.ideal_arm import PERIOD_S, IdealArm
from tests.genetic import hand
from tests.recording.logs import write

P = ParamSpec("P")
T = TypeVar("T")


class IdealControl:
    """A control process without a process: it ticks when told to, on the host's own clock."""

    def __init__(self, clock: VirtualClock, arm: IdealArm | None = None, *, restarted: bool = False) -> None:
        self.arm = IdealArm(now_ns=clock.now_ns()) if arm is None else arm
        self.pid = 4242
        self.link, theirs = Link.pair()
        self._theirs = Link(theirs)
        self._clock = clock
        # Commands that no tick has seen yet.
        self._waiting: list[Command] = []
        self._connect: tuple[Command, ...] = (Connected(restarted=restarted),)
        self.commands: list[Command] = []
        self.alive = True
        self.terminated = False

    def ready(self) -> Self:
        self._theirs.send(Ready(self.pid))
        return self

    def connect_again(self) -> None:
        """The next tick is the first of a new process."""
        self._connect = (Connected(restarted=True),)

    def take(self) -> list[Command]:
        """Commands that wait; no tick will see them."""
        self._hear()
        taken, self._waiting = self._waiting, []
        return taken

    def _hear(self) -> None:
        self._waiting += cast("list[Command]", self._theirs.receive())

    def say(self, message: object) -> None:
        self._theirs.send(message)

    def tick(self) -> TickRecord:
        """One tick with the commands that wait in the link."""
        commands = tuple(self.take())
        self.commands += commands
        arm = self.arm
        outputs = arm.run_tick(*self._connect, *commands)
        self._connect = ()
        readings = tuple(
            ServoReading(joint.servo_id, seen, stamp, fresh=stamp == arm.now_ns)
            for joint, seen, stamp in zip(arm.arm.joints, arm.seen, arm.stamps, strict=True)
        )
        sample = Sample(arm.now_ns, readings, bus_us=2500, port_open=arm.port_open)
        inputs = Inputs(arm.tick - 1, arm.now_ns + 2_000_000, sample, commands)
        self._clock.sleep_until_ns(inputs.now_ns)
        return TickRecord(inputs, outputs, lateness_us=100)

    def tick_over_link(self) -> None:
        """One tick, told to the host; the last one once the host has closed the link."""
        try:
            self._theirs.send(self.tick())
        except LinkClosed:
            self.die()

    def undisturbed(self) -> bool:
        """Whether a motion is under way and no command waits."""
        moving = self.arm.mode() is Mode.MOVING and bool(self.commands) and isinstance(self.commands[-1], Run)
        try:
            self._hear()
        except LinkClosed:  # the next tick finds out
            return False
        return moving and not self._waiting

    def die(self) -> None:
        self.alive = False
        self._theirs.close()

    def beat(self) -> None:
        """It is not told by time here."""

    def poll(self) -> int | None:
        return -9

    def kill(self) -> None:
        self.die()

    def terminate(self, timeout_s: float) -> None:
        assert timeout_s > 0.0
        self.terminated = True
        self.link.close()


@dataclass
class MemoryRecorder:
    """Takes by name, notes in order."""

    folder: Path = Path("/recordings")
    log_path: Path | None = Path("/logs/log.mcap.part")
    problem: str = ""
    # Why no take can be begun.
    stopped: str = ""
    dropped_records: int = 0
    records: list[TickRecord] = field(default_factory=list)
    notes: list[str] = field(default_factory=list)
    # Number of ticks in each take that has ended.
    takes: dict[str, int] = field(default_factory=dict)
    begun: tuple[str, int] | None = None
    on_begin: Callable[[], None] = lambda: None
    closed: bool = False

    def put(self, record: TickRecord) -> None:
        self.records.append(record)

    def note(self, text: str, time_ns: int) -> None:
        assert time_ns > 0
        self.notes.append(text)

    def check(self) -> None:
        if self.stopped:
            raise LogError(self.stopped)

    def begin_take(self, name: str) -> Path:
        self.on_begin()
        if name in self.takes:
            raise LogError(f"take {name}: there is one of that name")
        assert self.begun is None
        self.begun = name, len(self.records)
        return self.folder / f"{name}.mcap"

    def end_take(self) -> Path | None:
        if self.begun is None:
            return None
        name, begin = self.begun
        self.takes[name], self.begun = len(self.records) - begin, None
        return self.folder / f"{name}.mcap"

    def close(self) -> None:
        self.end_take()
        self.closed = True


@dataclass(eq=False)
class NamedClient:
    """A client as the host knows it."""

    name: str
    uid: int = 1000
    told: list[tuple[str, dict[str, object]]] = field(default_factory=list)

    def notify(self, method: str, params: dict[str, object]) -> None:
        self.told.append((method, params))


@contextmanager
def refused(code: str, match: str | None = None) -> Iterator[pytest.ExceptionInfo[RequestRefused]]:
    """Something inside is refused with that code, in words that `match`."""
    with pytest.raises(RequestRefused, match=match) as caught:
        yield caught
    assert (caught.value.code, isinstance(caught.value, IllegalTransition)) == (code, code == "ILLEGAL_TRANSITION")


def write_take(path: Path, samples: FloatArray, arm: ArmConfig) -> None:
    """A take as the recorder would have written it while a hand moved the arm through `samples` [rad], (m, joints)."""
    ideal = IdealArm(arm)
    control = IdealControl(VirtualClock(ideal.now_ns), ideal)
    context = LogContext(arm=arm, robot=ideal.robot, config=Config(), port="/dev/robot", period_s=PERIOD_S)

    def ticks() -> Iterator[TickRecord]:
        for row in samples:
            for index, joint in enumerate(arm.joints):
                ideal.put(index, ax12a.PRESENT_POSITION, round(joint.tick(row[index])))
            yield control.tick()

    write(path, ticks(), context=context)
    control.die()
    control.link.close()


def methods_over(folder: Path, run: RunOptimisation) -> Methods:
    """The methods of an arm that nobody drives, over the recordings in a folder."""
    return Methods(Host(hand.arm(), hand.robot(), PERIOD_S, MemoryRecorder(), VirtualClock()), folder, run)


def small_plan(arm: IdealArm, **changes: object) -> Plan:
    """A short, slow plan near where the arm rests that every pre-flight accepts."""
    start = arm.positions_rad()
    low = (start[0], start[1] - 0.5, *start[2:])
    high = (start[0] + 0.1, start[1] - 0.6, *start[2:])
    values: dict[str, object] = {
        "arm_id": arm.arm.arm_id,
        "calibration_hash": arm.arm.calibration_hash,
        "from_m": (0.1, 0.0, 0.2),
        "to_m": (0.1, 0.1, 0.2),
        "duration_s": 2.0,
        "via": 0,
        "interpolation": "linear",
        "waypoints_rad": (low, high),
        "waypoint_progress": (0.0, 1.0),
        "predicted_mean_error_mm": 1.5,
        "predicted_max_error_mm": 2.5,
        "seed": 0,
    }
    return Plan.model_validate(values | changes)
