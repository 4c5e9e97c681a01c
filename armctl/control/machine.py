"""The control machine: its phases, what may happen in each, and nothing else.

Theory. The arm is limp, coming to torque, under torque, or latched by a fault. What the outside sees of that is one of
nine modes (`messages.Mode`). Some modes take several steps, each of which ends when the servos *show* something, so
the machine itself knows more: it is always in one *phase*, and every phase shows as one mode (`MODE`). Every change of
phase is an entry of `TRANSITIONS`. A trigger that the row of the present phase does not name is illegal, and changes
nothing.
Who may ask for what, and in which words a request is refused, follows from the same table.

A latched arm keeps the torque it has; only `release` and `clear` are heard. Nothing advances but the deceleration and,
while something lasts that would soon drop the arm anyway (`Trigger.STRAIN`), the slow way to rest. That way is the one
of `park`, after some time in which a `stop` calls it off:

    come to a stop --set_off--> go there --arrived--> see that the arm is there --parked--> torque off
    each of them --give_up--> hold: torque is never cut but at the rest pose

Torque comes on in five steps, and each of them may fail (`energise_failed`: torque goes off again):

    soft limit written --soft_seen--> goal written --settings_seen--> torque enabled --torque_seen--> torque limit rises
                       --ramped--> full limit to be shown --energised--> holding

Torque goes off in one (`State.letting_go`): it is written until every servo is seen limp (`limp_seen`), also while a
fault is latched.
"""

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from importlib import resources
from types import MappingProxyType

from armctl.errors import IllegalTransition
from armctl.messages import Fault, JointTrajectory, LagModel, Mode, Problem


class Phase(StrEnum):
    """Where the machine is."""

    # Just connected: what torque the servos have is still to be taken over.
    FOUND = "found"
    OFF = "off"

    # Settings and a soft torque limit are written; to be read back before any goal, which may energise.
    SOFTENING = "softening"
    # The present position is written as goal; to be read back.
    PREPARING = "preparing"
    # Torque is enabled; every servo has to show it.
    ENABLING = "enabling"
    # The torque limit rises from soft to full.
    RAMPING = "ramping"
    # Every servo has to show its full torque limit.
    CONFIRMING = "confirming"

    HOLDING = "holding"
    MOVING = "moving"
    JOGGING = "jogging"

    PARK_STARTING = "park_starting"
    PARK_GOING = "park_going"
    # The rest pose has to be seen before torque goes.
    PARK_CHECKING = "park_checking"
    # It was broken off; the arm slows down.
    PARK_ENDING = "park_ending"

    # Torque is switched off for teaching; every servo has to show it.
    LETTING_GO = "letting_go"
    TEACHING = "teaching"
    # Torque is switched off for good; every servo has to show it.
    RELEASING = "releasing"

    FAULTED = "faulted"
    # Announced: whatever moves comes to rest, and the arm waits before it sets off for its rest pose.
    FAULT_STOPPING = "fault_stopping"
    FAULT_GOING = "fault_going"
    FAULT_CHECKING = "fault_checking"


class Trigger(StrEnum):
    """What moves the machine: requests first, then what the servos show, then faults."""

    TORQUE_ON = "torque_on"
    RUN = "run"
    JOG = "jog"
    PARK = "park"
    RELEASE = "release"
    TEACH = "teach"
    TEACH_END = "teach_end"
    CLEAR_LIMP = "clear_limp"
    CLEAR_POWERED = "clear_powered"

    ADOPT_LIMP = "adopt_limp"
    ADOPT_POWERED = "adopt_powered"
    SOFT_SEEN = "soft_seen"
    SHAFT_MOVED = "shaft_moved"
    SETTINGS_SEEN = "settings_seen"
    TORQUE_SEEN = "torque_seen"
    RAMPED = "ramped"
    ENERGISED = "energised"
    ENERGISE_FAILED = "energise_failed"
    LIMP_SEEN = "limp_seen"
    STOPPED = "stopped"
    SET_OFF = "set_off"
    ARRIVED = "arrived"
    PARKED = "parked"
    GIVE_UP = "give_up"

    FAULT = "fault"
    # What would soon end in a dropped arm lasts.
    STRAIN = "strain"


P, T = Phase, Trigger
_FAULT = {T.FAULT: P.FAULTED}
_CLEAR = {T.CLEAR_LIMP: P.OFF, T.CLEAR_POWERED: P.HOLDING}
_COMING_ON = _FAULT | {T.ENERGISE_FAILED: P.RELEASING, T.RELEASE: P.RELEASING}
_PARKING = _FAULT | {T.GIVE_UP: P.PARK_ENDING}
_LATCHED = {T.RELEASE: P.FAULTED}
_TO_REST = _LATCHED | {T.GIVE_UP: P.FAULTED}

# fmt: off
TRANSITIONS: Mapping[Phase, Mapping[Trigger, Phase]] = MappingProxyType({
    P.FOUND:     {T.ADOPT_LIMP: P.OFF, T.ADOPT_POWERED: P.HOLDING,
                  T.TEACH: P.LETTING_GO, T.RELEASE: P.RELEASING} | _FAULT,
    P.OFF:       {T.TORQUE_ON: P.SOFTENING, T.TEACH: P.LETTING_GO, T.RELEASE: P.RELEASING} | _FAULT,

    P.SOFTENING:  {T.SOFT_SEEN: P.PREPARING} | _COMING_ON,
    P.PREPARING:  {T.SETTINGS_SEEN: P.ENABLING, T.SHAFT_MOVED: P.PREPARING} | _COMING_ON,
    P.ENABLING:   {T.TORQUE_SEEN: P.RAMPING} | _COMING_ON,
    P.RAMPING:    {T.RAMPED: P.CONFIRMING} | _COMING_ON,
    P.CONFIRMING: {T.ENERGISED: P.HOLDING} | _COMING_ON,

    P.HOLDING: {T.RUN: P.MOVING, T.JOG: P.JOGGING, T.PARK: P.PARK_STARTING,
                T.TEACH: P.LETTING_GO, T.RELEASE: P.RELEASING} | _FAULT,
    P.MOVING:  {T.STOPPED: P.HOLDING} | _FAULT,
    P.JOGGING: {T.STOPPED: P.HOLDING} | _FAULT,

    P.PARK_STARTING: {T.SET_OFF: P.PARK_GOING} | _PARKING,
    P.PARK_GOING:    {T.ARRIVED: P.PARK_CHECKING} | _PARKING,
    P.PARK_CHECKING: {T.PARKED: P.RELEASING} | _PARKING,
    P.PARK_ENDING:   {T.STOPPED: P.HOLDING} | _FAULT,

    P.LETTING_GO: {T.LIMP_SEEN: P.TEACHING, T.TEACH_END: P.RELEASING, T.RELEASE: P.RELEASING} | _FAULT,
    P.TEACHING:   {T.TEACH_END: P.OFF, T.RELEASE: P.RELEASING} | _FAULT,
    P.RELEASING:  {T.LIMP_SEEN: P.OFF, T.RELEASE: P.RELEASING} | _FAULT,

    P.FAULTED:        {T.STRAIN: P.FAULT_STOPPING} | _CLEAR | _LATCHED,
    P.FAULT_STOPPING: {T.SET_OFF: P.FAULT_GOING} | _CLEAR | _TO_REST,
    P.FAULT_GOING:    {T.ARRIVED: P.FAULT_CHECKING} | _TO_REST,
    P.FAULT_CHECKING: {T.PARKED: P.FAULTED} | _TO_REST,
})
# fmt: on

_SHOWN: dict[Mode, tuple[Phase, ...]] = {
    Mode.STARTING: (P.FOUND,),
    Mode.OFF: (P.OFF,),
    Mode.ENERGISING: (P.SOFTENING, P.PREPARING, P.ENABLING, P.RAMPING, P.CONFIRMING),
    Mode.HOLDING: (P.HOLDING,),
    Mode.MOVING: (P.MOVING,),
    Mode.JOGGING: (P.JOGGING,),
    Mode.PARKING: (P.PARK_STARTING, P.PARK_GOING, P.PARK_CHECKING, P.PARK_ENDING),
    Mode.TEACHING: (P.TEACHING,),
    Mode.RELEASING: (P.RELEASING, P.LETTING_GO),
    Mode.FAULTED: (P.FAULTED, P.FAULT_STOPPING, P.FAULT_GOING, P.FAULT_CHECKING),
}
# What the outside sees of each phase.
MODE: Mapping[Phase, Mode] = {phase: mode for mode, phases in _SHOWN.items() for phase in phases}

ENERGISING = frozenset(_SHOWN[Mode.ENERGISING])
LATCHED = frozenset(_SHOWN[Mode.FAULTED])
# On the way to rest.
TO_REST = frozenset(phase for phase, row in TRANSITIONS.items() if T.GIVE_UP in row)

# By mode, why something cannot be done now, and what to do first.
ADVICE: Mapping[str, str] = tomllib.loads(resources.files(__package__).joinpath("advice.toml").read_text("utf-8"))


# ------------------------------------------------------------------------------------------------- memory
#
# Not frozen: a step copies what it is given once, works on the copy, and returns it (see step.py). Every field but
# `State.motion` and `State.jog` is a value that cannot change, so a copy of these three objects is a copy of all.


@dataclass(frozen=True)
class Settling:
    """The tool is brought to its place, at rest (see motion.py)."""

    # In all; those since the last change in which all servos were heard; sum of each joint's errors over the latest.
    ticks: int = 0
    heard: int = 0
    sum_rad: tuple[float, ...] = ()
    # How often goals were changed.
    count: int = 0
    # By how many ticks each joint was to turn last, and those that did not when they were to.
    asked: tuple[int, ...] = ()
    stuck: tuple[int, ...] = ()
    # Each joint's error before the last change, by how much that turned its goal back, and what of it a reversal takes.
    error_rad: tuple[float, ...] = ()
    back_rad: tuple[float, ...] = ()
    slack_rad: tuple[float, ...] = ()


@dataclass
class Motion:
    """A trajectory under way."""

    trajectory: JointTrajectory
    # Who hears of its end; None: nobody asked, a fault did.
    request_id: int | None
    # Where along the trajectory the arm is commanded to be now.
    progress_s: float = 0.0
    # Trajectory seconds per second; a stop or a pause lowers it to 0 along the path.
    rate: float = 1.0
    # Where `rate` goes while nothing holds it up.
    wanted_rate: float = 1.0
    paused: bool = False
    # Why it is being stopped; empty while it runs.
    stop_code: str = ""
    # How often in a row a closing gripper has felt its load.
    resisted_ticks: int = 0
    begun: bool = False
    ended: bool = False
    # What `rate` would be if no reply had been lost; trajectory seconds that lost ones have cost, and their ticks.
    free_rate: float = 1.0
    lost_s: float = 0.0
    unheard_ticks: int = 0
    slowness_told: bool = False
    # None: the trajectory is not over.
    settling: Settling | None = None


@dataclass
class Jogging:
    """A jog under way."""

    # Where the joints are commanded to be now; goals are its nearest ticks.
    position_rad: tuple[float, ...]
    # How fast they are commanded to move now.
    velocity_rad_s: tuple[float, ...]
    # What the last heartbeat asked for: one of the two, the other is empty.
    joints_rad_s: tuple[float, ...]
    tool_m_s: tuple[float, ...]
    # When the last heartbeat came.
    heard_ns: int
    # Falls from 1 to 0 once heartbeats cease or the jog is stopped.
    rate: float = 1.0
    # Why it is being stopped; empty while it goes on.
    stop_code: str = ""


@dataclass(frozen=True)
class Following:
    """Where the joints are wanted, and by what their goals are corrected (see settle.py)."""

    corrected: bool
    # Where, when the last goal is due, and how fast there.
    wanted_rad: tuple[float, ...]
    velocity_rad_s: tuple[float, ...]
    # Where they were read as it was sent.
    seen_rad: tuple[float, ...]
    # On which side friction pushes, from -1 to 1.
    side: tuple[float, ...]
    trim_rad: tuple[float, ...]
    # The correction with which the motion began, and the last one, before it was made whole ticks.
    before_rad: tuple[float, ...]
    given_rad: tuple[float, ...]
    # For how long the motion has gone on.
    age_s: float = 0.0
    # How far each joint that is to stand has been off of late; empty: none has stood yet.
    off_rad: tuple[float, ...] = ()


@dataclass(frozen=True)
class LettingGo:
    """Torque is being switched off, until every servo has been seen without (see enforce.py)."""

    # When it was decided last.
    since_ns: int
    # Servos, by index, that have not been seen limp since.
    stiff: tuple[int, ...]
    # Who waits to hear that the arm is limp, or which servo is not.
    request_ids: tuple[int, ...] = ()


@dataclass(frozen=True)
class Look:
    """A joint that may push against something is to be looked at once it stands (see relief.py)."""

    joint: int
    # Since when it has stood at the goal that was decided for it; 0: it has not.
    since_ns: int = 0
    # Whether it has been relieved.
    relieved: bool = False


@dataclass
class State:
    """Everything the control step remembers from one tick to the next; plain values only."""

    phase: Phase = Phase.FOUND
    # Spent in the present phase: for time-outs, and for how far the torque limit has risen.
    ticks: int = 0
    # Whether the servos of the open port have been identified.
    connected: bool = False
    problems: tuple[Problem, ...] = ()
    # What is latched, the worst first.
    faults: tuple[Fault, ...] = ()
    # Whether the servos are meant to have torque; None: unknown, or it is just coming on.
    powered: bool | None = None
    # The way to rest was ended or given up: there is none until the faults are cleared.
    stays: bool = False
    # Whose reply is due when the present sequence ends.
    request_id: int | None = None
    # Who waits to hear that the arm is still.
    hold_request_ids: tuple[int, ...] = ()
    # Where the servos are to be: the last goal sent, taken over or decided [tick]; empty: armctl has no say in it.
    goal: tuple[int, ...] = ()
    # Goals before it, latest first: what a servo shows that missed what came after. Any other is not from here.
    sent: tuple[tuple[int, ...], ...] = ()
    # In how many samples every servo has been heard since each of them was replaced.
    heard_since: tuple[int, ...] = ()
    # Where the servos' own speed ramps stood when the last goal was sent [tick]; empty: at it.
    ramp: tuple[float, ...] = ()
    # When the last goal was sent.
    goal_ns: int = 0
    # Whether those ramps were seen to begin at the shaft with each goal, and for how many ticks it has looked so.
    ramp_restarts: bool = False
    lazy_ticks: int = 0
    # Of each servo the registers that only torque-on writes (see ax12a.py), from when torque was taken over.
    settings: tuple[int, ...] = ()
    # None: the joints are wanted at their goals.
    following: Following | None = None
    # How the arm lags, as it showed itself; None: as an arm of new servos does.
    model: LagModel | None = None
    letting_go: LettingGo | None = None
    # Since when goals from elsewhere have been found again and again, and when the last one was; 0: none.
    foreign_since_ns: int = 0
    foreign_ns: int = 0
    # Whether the arm is left to another program that goes on writing, until `clear`.
    yielded: bool = False
    # Servos, by index, that were seen far from the goal decided for them in the tick before, led by another.
    led_off: tuple[int, ...] = ()
    # Servos, by index, that since they last showed their goal have been limp, or unheard as their place was decided.
    limp: tuple[int, ...] = ()
    looks: tuple[Look, ...] = ()
    # Output of each joint that came back after a relief: a weight; empty: none did.
    borne_ratio: tuple[float, ...] = ()
    # Since when each standing joint has pushed beyond what gravity explains; 0: it does not; empty: not looked at yet.
    push_since_ns: tuple[int, ...] = ()
    # Positions [tick] when energising began.
    anchor: tuple[int, ...] = ()
    motion: Motion | None = None
    jog: Jogging | None = None
    # Since when each joint has been farther from its goal than allowed; 0: it is not; empty: not looked at yet.
    error_since_ns: tuple[int, ...] = ()
    # Since when each servo's heat, supply and load have been beyond what it can bear, as in `error_since_ns`.
    heat_since_ns: tuple[int, ...] = ()
    supply_since_ns: tuple[int, ...] = ()
    load_since_ns: tuple[int, ...] = ()
    # The same of each pair of servos on one joint that read apart, or push against each other; an arm may have none.
    pair_since_ns: tuple[int, ...] = field(default=(), metadata={"of": "some arms"})
    # Readings lost to noise in each of the latest ticks.
    noise: tuple[int, ...] = ()
    # Positions of the previous sample, and of those before it in which none was meant to have torque [tick]; what was
    # read before a late tick says nothing any more of where a shaft is.
    last_ticks: tuple[int, ...] = ()
    earlier_ticks: tuple[tuple[int, ...], ...] = ()

    @property
    def fault(self) -> Fault | None:
        """The worst of those latched."""
        return self.faults[0] if self.faults else None

    @property
    def mode(self) -> Mode:
        """What the outside sees of it."""
        return MODE[self.phase]

    def target(self, trigger: Trigger) -> Phase:
        """The phase that `trigger` leads to.

        Raises:
            IllegalTransition: it has no entry in the row of this phase; says why in the user's words.
        """
        found = TRANSITIONS[self.phase].get(trigger)
        if found is None:
            why = ADVICE[self.mode].format(fault=self.fault and self.fault.code)
            raise IllegalTransition(f"{trigger.value.replace('_', ' ')} is not possible now: {why}")
        return found

    def go(self, trigger: Trigger) -> None:
        """Change the phase.

        Raises:
            IllegalTransition: see `target`; nothing has changed.
        """
        self.phase, self.ticks = self.target(trigger), 0
