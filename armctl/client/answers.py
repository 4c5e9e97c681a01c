"""What the daemon answers, as types: dictionaries whose keys are those of the JSON.

Angles are radians, places x, y, z in metres from the base. These are the keys that programs ask for most; others come,
too.
"""

from typing import Any, NotRequired, TypedDict


class State(TypedDict):
    """What the arm does now: `holding`, say, or `moving`."""

    state: str


class Joint(TypedDict):
    """One joint; what its servo tells is None until it has answered once."""

    name: str
    servo_id: int
    position_rad: float | None
    # Where it is commanded to be a tick later; None: armctl has no say in it.
    wanted_rad: float | None
    velocity_rad_s: float | None
    # Share of the greatest torque, -1 to 1.
    load_ratio: float | None
    voltage_V: float | None
    temperature_degC: float | None
    torque_enabled: bool | None


class Tool(TypedDict):
    """Where the tool is: R = Rz(yaw) Ry(pitch) Rx(roll)."""

    position_m: list[float]
    rpy_rad: list[float]
    speed_m_s: float | None


class Fault(TypedDict):
    """One fault that is latched, and the next command to type."""

    code: str
    text: str
    servo_id: int | None
    next: str


class Status(State):
    """One snapshot."""

    # The worst first.
    faults: list[Fault]
    tick: int | None
    period_s: float
    joints: list[Joint]
    tool: Tool | None
    # Share of the motion that is done; None: none is under way.
    progress: float | None
    arm_id: str
    calibration_hash: str


class Recorded(TypedDict):
    """A motion that has come to its end; `notice`: what of it was not as the arm's model says."""

    recording: str
    notice: NotRequired[str]


class Moved(Recorded):
    """Where the arm came to rest, by the encoders; where the gripper was asked, whether it holds something."""

    position_error_mm: float
    position_m: list[float]
    joints_rad: list[float]
    duration_s: float
    gripped: NotRequired[bool | None]


class Followed(Recorded):
    """How far the tool was off the path that it was to follow, by the encoders; of a refined run its rounds, too."""

    mean_error_mm: float
    max_error_mm: float
    duration_s: float
    rounds: NotRequired[list[dict[str, Any]]]
    # The file of the best one; None: no correction of a path was better.
    plan: NotRequired[str | None]


class Programmed(Recorded):
    """The steps that were done (`name`, `ok`, `text`), where they began, and what ended them before their time."""

    steps: list[dict[str, Any]]
    resumed_at: str | None
    ended: dict[str, str] | None
    stands_at: str | None
