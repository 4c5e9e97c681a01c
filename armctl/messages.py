"""The one schema of what moves between parts: bus, control step, log, API, dashboard.

Frozen dataclasses of plain values, so that every one of them can be compared, pickled between processes and written
as JSON without loss (json_text.py). Joint order is the calibration file's order everywhere; positions are radians,
time is monotonic nanoseconds.
"""

from dataclasses import dataclass
from enum import StrEnum
from typing import Literal

NS_PER_S = 1_000_000_000

# Longest motion that anybody may ask for; slow ways to where it begins, dwell and settling come on top.
LONGEST_S = 600.0
# Most numbers of a trajectory: with its command and a keyframe that holds it, a tick's record is one message between
# two processes, and a kernel with net.core.wmem_max as it comes takes 416 KiB.
MAX_NUMBERS = 12_000


def most_points(joints: int) -> int:
    """Of a trajectory of so many joints; each has its time too."""
    return MAX_NUMBERS // (joints + 1)


# ---------------------------------------------------------------------------------------------- bus -> step


@dataclass(frozen=True, slots=True)
class ServoReading:
    """What one servo said, and when. A servo that missed this tick keeps its last registers and their old stamp."""

    servo_id: int
    # Control table 24..49 (26 bytes) of the last good reply; empty if it never answered.
    registers: bytes
    # When `registers` arrived; 0 if never.
    stamp_ns: int
    # Whether `registers` were read in this very sample.
    fresh: bool
    # Error byte of the last good reply.
    error: int = 0
    # Why this sample got no good reply: NO_REPLY, BUS_NOISE, PORT_GONE or nothing.
    problem: str = ""


@dataclass(frozen=True, slots=True)
class Sample:
    """One reading of every servo; it took `bus_us`."""

    # The instant the reading began; the time of every message of this tick.
    time_ns: int
    servos: tuple[ServoReading, ...]
    bus_us: int = 0
    retries: int = 0
    port_open: bool = True


# ------------------------------------------------------------------------------------------ client -> step


@dataclass(frozen=True, slots=True)
class Grip:
    """What a closing gripper feels for: the motion ends early, and well, where the joint's load says that it holds."""

    # Index of the gripper's joint.
    joint: int
    load_ratio: float


@dataclass(frozen=True, slots=True)
class JointTrajectory:
    """Joint positions on a uniform time grid, or at times of their own; straight joint lines between neighbours.

    The plan proper occupies [begin_s, end_s]; what lies before is approach, what lies after is settling.
    """

    period_s: float
    positions_rad: tuple[tuple[float, ...], ...]
    begin_s: float = 0.0
    end_s: float = 0.0
    label: str = ""
    grip: Grip | None = None
    # When each position is due, rising from 0; empty: one every `period_s`.
    times_s: tuple[float, ...] = ()
    # Whether goals are corrected so that the joints are at these positions; if not, goals are these positions.
    corrected: bool = True

    @property
    def duration_s(self) -> float:
        return self.times_s[-1] if self.times_s else self.period_s * (len(self.positions_rad) - 1)


@dataclass(frozen=True, slots=True)
class Answered:
    """What is answered by one `Reply` with the same `request_id`."""

    request_id: int


@dataclass(frozen=True, slots=True)
class Hold(Answered):
    """Decelerate along the path and freeze the last goal. Served in every state; `stop` is this."""

    kind: Literal["hold"] = "hold"


@dataclass(frozen=True, slots=True)
class Release(Answered):
    """Switch torque off, the caller having warned of it; answered when all are limp, or names one that is not."""

    kind: Literal["release"] = "release"


@dataclass(frozen=True, slots=True)
class TorqueOn(Answered):
    """Carefully energise the arm where it is."""

    kind: Literal["torque_on"] = "torque_on"


@dataclass(frozen=True, slots=True)
class Teach(Answered):
    """Make the arm limp and verified so, for hand guiding; from holding or off."""

    kind: Literal["teach"] = "teach"


@dataclass(frozen=True, slots=True)
class TeachEnd(Answered):
    """Leave teach mode; the arm stays limp (off)."""

    kind: Literal["teach_end"] = "teach_end"


@dataclass(frozen=True, slots=True)
class Run(Answered):
    """Execute a trajectory that starts where the arm is commanded to be now."""

    trajectory: JointTrajectory
    kind: Literal["run"] = "run"


@dataclass(frozen=True, slots=True)
class Pause(Answered):
    """Bring a run to rest on its path, to be resumed there."""

    kind: Literal["pause"] = "pause"


@dataclass(frozen=True, slots=True)
class Resume(Answered):
    """Go on with a paused run."""

    kind: Literal["resume"] = "resume"


@dataclass(frozen=True, slots=True)
class SetRate(Answered):
    """Run at `rate` trajectory seconds per second, 0.1 to 1: never faster than what was checked."""

    rate: float
    kind: Literal["set_rate"] = "set_rate"


@dataclass(frozen=True, slots=True)
class Jog(Answered):
    """One heartbeat of a jog: the one velocity that is wanted until the next heartbeat, without which the arm stops."""

    joints_rad_s: tuple[float, ...] = ()
    # Velocity of the tool point in the base frame, (x, y, z).
    tool_m_s: tuple[float, ...] = ()
    # True for the first heartbeat alone: a jog that has ended does not go on by itself.
    begin: bool = False
    kind: Literal["jog"] = "jog"


@dataclass(frozen=True, slots=True)
class Park(Answered):
    """Go slowly to the rest pose, and switch torque off there."""

    kind: Literal["park"] = "park"


@dataclass(frozen=True, slots=True)
class Clear(Answered):
    """Acknowledge the latched fault; refused while its cause persists."""

    kind: Literal["clear"] = "clear"


@dataclass(frozen=True, slots=True)
class LagModel:
    """How far each joint of one arm stays behind its goal (see trajectory/lag.py)."""

    arm_id: str
    calibration_hash: str
    # A row a joint of the chain: of each link [rad/m], of friction [rad], of velocity [s], constant [rad].
    rows: tuple[tuple[float, ...], ...]
    # What it left unexplained of the motions that it was identified from, and how many they were; 0: it is nominal.
    residual_tick: tuple[float, ...] = ()
    lines: int = 0


@dataclass(frozen=True, slots=True)
class UseModel(Answered):
    """Correct goals by this model of the arm from now on; refused of another arm, or while it moves."""

    model: LagModel
    kind: Literal["use_model"] = "use_model"


@dataclass(frozen=True, slots=True)
class Problem:
    """One reason why a connected bus is not fit for motion."""

    code: str
    text: str
    servo_id: int | None = None


@dataclass(frozen=True, slots=True)
class Connected:
    """The bus was (re)opened and every servo identified; `problems` are what forbids torque."""

    problems: tuple[Problem, ...] = ()
    restarted: bool = False
    # Firmware version of every servo; -1: it could not be read.
    firmware: tuple[int, ...] = ()
    kind: Literal["connected"] = "connected"


@dataclass(frozen=True, slots=True)
class HostLost:
    """The host process is gone: hold, then leave."""

    kind: Literal["host_lost"] = "host_lost"


@dataclass(frozen=True, slots=True)
class HostSilent:
    """The host process is there and says nothing: slow down and hold, since nobody could stop the arm."""

    kind: Literal["host_silent"] = "host_silent"


Request = Hold | Release | TorqueOn | Teach | TeachEnd | Run | Pause | Resume | SetRate | Jog | Park | Clear | UseModel
Command = Request | Connected | HostLost | HostSilent


@dataclass(frozen=True, slots=True)
class Inputs:
    """Everything one control step sees; logging them is enough to repeat it."""

    tick: int
    now_ns: int
    sample: Sample
    commands: tuple[Command, ...] = ()
    # How far behind its deadline this tick began.
    late_ns: int = 0


# ------------------------------------------------------------------------------------------ step -> outside


class Mode(StrEnum):
    """States of the control machine (see control/machine.py)."""

    # Until all servos have been heard, nobody knows whether they have torque.
    STARTING = "starting"
    OFF = "off"
    ENERGISING = "energising"
    HOLDING = "holding"
    MOVING = "moving"
    JOGGING = "jogging"
    PARKING = "parking"
    TEACHING = "teaching"
    RELEASING = "releasing"
    FAULTED = "faulted"


@dataclass(frozen=True, slots=True)
class Fault:
    """A latched fault; the card a person reads is derived from it (see control/faults.py)."""

    code: str
    text: str
    since_ns: int
    servo_id: int | None = None
    # Code of the fault that it follows from, if another of those latched explains it.
    follows: str = ""


@dataclass(frozen=True, slots=True)
class Write:
    """One register write to one servo, answered by it."""

    servo_id: int
    address: int
    size: int
    value: int


@dataclass(frozen=True, slots=True)
class Goal:
    """One SYNC_WRITE of goal position [tick] and moving speed [register units] for every servo in order."""

    ticks: tuple[int, ...]
    speeds: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Reply:
    """Outcome of a request, told once."""

    request_id: int
    ok: bool
    code: str = ""
    message: str = ""


@dataclass(frozen=True, slots=True)
class Event:
    """Something worth a line in the log: a transition, a fault, a mark in a run."""

    severity: Literal["info", "warning", "error"]
    code: str
    text: str
    servo_id: int | None = None


@dataclass(frozen=True, slots=True)
class JointState:
    """One joint as the daemon sees it; NaN-free: `known` is False until its servo has answered once."""

    known: bool
    position_rad: float
    velocity_rad_s: float
    load_ratio: float
    voltage_V: float
    temperature_degC: float
    torque_enabled: bool
    age_s: float


@dataclass(frozen=True, slots=True)
class ToolPose:
    """Tool frame in the base frame: position [m], unit quaternion (x, y, z, w)."""

    position_m: tuple[float, float, float]
    quaternion: tuple[float, float, float, float]


@dataclass(frozen=True, slots=True)
class Outputs:
    """Everything one control step says."""

    mode: Mode
    # Every one that is latched, the worst first.
    faults: tuple[Fault, ...]
    joints: tuple[JointState, ...]
    # None until every joint is known.
    tool: ToolPose | None
    writes: tuple[Write, ...] = ()
    # None: nothing is sent, the servos keep the goal they have.
    goal: Goal | None = None
    replies: tuple[Reply, ...] = ()
    events: tuple[Event, ...] = ()
    # Fraction of the running trajectory, None when none runs.
    progress: float | None = None
    # Trajectory seconds per second asked for, 0 while paused; None when none runs.
    rate: float | None = None
    # Time until the arm sets off for its rest pose because of a fault, 0 once it has; None: it does not.
    rest_in_s: float | None = None
    # Where the joints are wanted, from where a trajectory may begin; empty: armctl has no say in it.
    wanted_rad: tuple[float, ...] = ()

    @property
    def fault(self) -> Fault | None:
        """The worst of those latched."""
        return self.faults[0] if self.faults else None


@dataclass(frozen=True, slots=True)
class TickRecord:
    """What the control process hands to the host after each tick."""

    inputs: Inputs
    outputs: Outputs
    lateness_us: int = 0
    write_us: int = 0
    # Whether each servo confirmed its write, in the order of `outputs.writes`.
    confirmed: tuple[bool, ...] = ()
    # Whether the goal left, which no servo answers; False where there was none.
    goal_sent: bool = False
    # JSON of the step's state after this tick, on some ticks: where a replay can begin.
    keyframe: str = ""
    # Tick records lost before this one because the host did not take them.
    dropped: int = 0
    # What went over the wire since the record before: when, whether it was sent, and the bytes.
    wire: tuple[tuple[int, bool, bytes], ...] = ()
