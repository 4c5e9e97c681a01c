"""The control machine: its states, what may happen in each, and nothing else.

Theory. The arm is limp (`off`, `teaching`), on its way to torque (`energising`), under torque (`holding`,
`moving`, `jogging`, `parking`) or latched (`faulted`). A latched arm keeps what torque it has; only `release` and
`clear` are heard, and nothing advances but the deceleration and, for a fault that would soon drop the arm anyway, the
slow way to rest. Every change of mode is one row of `TRANSITIONS`; an event without a row in the present mode is
illegal and changes nothing. Who may ask for what, and in which words a request is refused, follows from the same table.

    off --torque_on--> energising --energised--> holding --run--> moving --stopped--> holding
    holding --jog--> jogging --stopped--> holding
    holding --park--> parking --parked--> off, --stopped--> holding
    off, holding --teach--> teaching --teach_end--> off
    any --fault--> faulted --clear_limp--> off, --clear_powered--> holding
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import StrEnum
from types import MappingProxyType
from typing import TYPE_CHECKING

from armctl.errors import IllegalTransition
from armctl.messages import Fault, JointTrajectory, Mode, Problem

if TYPE_CHECKING:
    from dataclasses import replace as replace  # so that the fields' names and types are checked
else:

    def replace(state, **changes):
        """What `dataclasses.replace` does, for the classes below in a tenth of its time: a step makes several of them.

        They are frozen, without slots and without `__post_init__`, so that a copy of the fields is all there is to it.

        Raises:
            TypeError: there is no such field.
        """
        fields = state.__dict__
        if not changes.keys() <= fields.keys():
            raise TypeError(f"{type(state).__name__} has no {', '.join(sorted(changes.keys() - fields.keys()))}")
        other = object.__new__(type(state))
        other.__dict__.update(fields, **changes)
        return other


class Trigger(StrEnum):
    """What moves the machine."""

    ADOPT_POWERED = "adopt_powered"
    TORQUE_ON = "torque_on"
    ENERGISED = "energised"
    ENERGISE_FAILED = "energise_failed"
    RUN = "run"
    JOG = "jog"
    STOPPED = "stopped"
    PARK = "park"
    PARKED = "parked"
    RELEASE = "release"
    TEACH = "teach"
    TEACH_END = "teach_end"
    FAULT = "fault"
    CLEAR_LIMP = "clear_limp"
    CLEAR_POWERED = "clear_powered"


TRANSITIONS = MappingProxyType(
    {
        (Mode.OFF, Trigger.ADOPT_POWERED): Mode.HOLDING,
        (Mode.OFF, Trigger.TORQUE_ON): Mode.ENERGISING,
        (Mode.OFF, Trigger.RELEASE): Mode.OFF,
        (Mode.OFF, Trigger.TEACH): Mode.TEACHING,
        (Mode.OFF, Trigger.FAULT): Mode.FAULTED,
        (Mode.ENERGISING, Trigger.ENERGISED): Mode.HOLDING,
        (Mode.ENERGISING, Trigger.ENERGISE_FAILED): Mode.OFF,
        (Mode.ENERGISING, Trigger.RELEASE): Mode.OFF,
        (Mode.ENERGISING, Trigger.FAULT): Mode.FAULTED,
        (Mode.HOLDING, Trigger.RUN): Mode.MOVING,
        (Mode.HOLDING, Trigger.RELEASE): Mode.OFF,
        (Mode.HOLDING, Trigger.TEACH): Mode.TEACHING,
        (Mode.HOLDING, Trigger.FAULT): Mode.FAULTED,
        (Mode.MOVING, Trigger.STOPPED): Mode.HOLDING,
        (Mode.MOVING, Trigger.FAULT): Mode.FAULTED,
        (Mode.HOLDING, Trigger.JOG): Mode.JOGGING,
        (Mode.JOGGING, Trigger.STOPPED): Mode.HOLDING,
        (Mode.JOGGING, Trigger.FAULT): Mode.FAULTED,
        (Mode.HOLDING, Trigger.PARK): Mode.PARKING,
        (Mode.PARKING, Trigger.PARKED): Mode.OFF,
        (Mode.PARKING, Trigger.STOPPED): Mode.HOLDING,
        (Mode.PARKING, Trigger.FAULT): Mode.FAULTED,
        (Mode.TEACHING, Trigger.TEACH_END): Mode.OFF,
        (Mode.TEACHING, Trigger.RELEASE): Mode.OFF,
        (Mode.TEACHING, Trigger.FAULT): Mode.FAULTED,
        (Mode.FAULTED, Trigger.RELEASE): Mode.FAULTED,
        (Mode.FAULTED, Trigger.CLEAR_LIMP): Mode.OFF,
        (Mode.FAULTED, Trigger.CLEAR_POWERED): Mode.HOLDING,
    }
)

_ADVICE: dict[Mode, str] = {
    Mode.OFF: "the arm is limp; `armctl torque on` first",
    Mode.ENERGISING: "torque is coming on; wait until it holds",
    Mode.HOLDING: "the arm is holding under torque",
    Mode.MOVING: "the arm is moving; `armctl stop` first",
    Mode.JOGGING: "the arm is being jogged; end that first, or `armctl stop`",
    Mode.PARKING: "the arm is on its way to rest; `armctl stop` first",
    Mode.TEACHING: "the arm is limp for teaching; end the teaching first",
    Mode.FAULTED: "a fault is latched; see `armctl status`, then `armctl clear`",
}


@dataclass(frozen=True)
class Motion:
    """A trajectory under way."""

    trajectory: JointTrajectory
    request_id: int | None
    """Who hears of its end; None: nobody asked, a fault did."""
    progress_s: float = 0.0
    """Where along the trajectory the arm is commanded to be now."""
    rate: float = 1.0
    """Trajectory seconds per second; a stop or a pause lowers it to 0 along the path."""
    wanted_rate: float = 1.0
    """Where `rate` goes while nothing holds it up."""
    paused: bool = False
    stop_code: str = ""
    """Why it is being stopped; empty while it runs."""
    resisted_ticks: int = 0
    """How often in a row a closing gripper has felt its load."""
    begun: bool = False
    ended: bool = False


@dataclass(frozen=True)
class Jogging:
    """A jog under way."""

    position_rad: tuple[float, ...]
    """Where the joints are commanded to be now; goals are its nearest ticks."""
    velocity_rad_s: tuple[float, ...]
    """How fast they are commanded to move now."""
    joints_rad_s: tuple[float, ...]
    tool_m_s: tuple[float, ...]
    """What the last heartbeat asked for."""
    heard_ns: int
    """When the last heartbeat came."""
    rate: float = 1.0
    """Falls from 1 to 0 once heartbeats cease or the jog is stopped."""
    stop_code: str = ""
    """Why it is being stopped; empty while it goes on."""


class Settle(StrEnum):
    """How far the way to rest has come."""

    NO = "no"
    STOP = "stop"
    """Whatever moves comes to rest first."""
    MOVE = "move"
    VERIFY = "verify"
    """The rest pose has to be seen before torque goes."""


@dataclass(frozen=True)
class State:
    """Everything the control step remembers from one tick to the next; plain values only."""

    mode: Mode = Mode.OFF
    connected: bool = False
    """Whether the servos of the open port have been identified."""
    adopted: bool = False
    """Whether the torque found at connection has been taken over."""
    problems: tuple[Problem, ...] = ()
    fault: Fault | None = None
    phase: int = 0
    """Ticks spent in the present mode; the sequence counter of `energising` and `teaching`."""
    request_id: int | None = None
    """Whose reply is due when the present sequence ends."""
    hold_request_ids: tuple[int, ...] = ()
    """Who waits to hear that the arm is still."""
    goal: tuple[int, ...] | None = None
    """Last goal sent [tick]."""
    previous_goal: tuple[int, ...] | None = None
    """The goal before it: what a servo shows that missed the last one."""
    ramp: tuple[float, ...] | None = None
    """Where the servos' own speed ramps stood when the last goal was sent [tick]; None: at it."""
    goal_ns: int = 0
    """When that was."""
    settings: tuple[int, ...] = ()
    """Of each servo the registers that only torque-on writes (see tick.py), as they were when torque was taken over."""
    anchor: tuple[int, ...] | None = None
    """Positions [tick] when energising began."""
    motion: Motion | None = None
    jog: Jogging | None = None
    settle: Settle = Settle.NO
    error_since_ns: tuple[int, ...] = ()
    """Since when each joint has been farther from its goal than allowed; 0: it is not."""
    load_since_ns: tuple[int, ...] = ()
    """Since when each servo's load has been above what it can bear; 0: it is not."""
    noise: tuple[int, ...] = ()
    """Readings lost to noise in each of the latest ticks."""
    last_ticks: tuple[int, ...] = ()
    """Positions of the previous sample [tick]."""


def transition(state: State, trigger: Trigger) -> State:
    """The state after `trigger`.

    Raises:
        IllegalTransition: the trigger has no row in this mode; says why in the user's words.
    """
    target = TRANSITIONS.get((state.mode, trigger))
    if target is None:
        raise IllegalTransition(f"{trigger.value.replace('_', ' ')} is not possible now: {_ADVICE[state.mode]}")
    return replace(state, mode=target, phase=0)
