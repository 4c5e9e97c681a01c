"""YAML text -> frozen configuration, strictly; `armctl.files` says where the files are and reads them.

Two files exist. `Config` says how the daemon runs (`armctl.yaml`, optional: every key has a default).
`ArmConfig` describes one physical arm (`calibration/NAME.yaml`). Units stand in the key; angles are degrees in
the files, because people write them, and radians in every property the code reads. The comment above a key is what
`armctl help configuration` tells of it.

A file is refused as a whole, with file, key, value and bound of everything that is wrong in it. YAML is read
without its surprises: no aliases, tags or duplicate keys, no `.nan`, no `1:30` or `0o17` numbers, at most 64 KiB and
16 levels deep.
"""

import hashlib
import math
import re
from functools import cached_property
from typing import Annotated, Any, Literal, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from armctl.dynamixel import ax12a
from armctl.errors import ConfigError

MAX_YAML_BYTES = 65536
MAX_YAML_DEPTH = 16
# 5.9 deg: nearer than what a joint may be behind its goal before it counts as blocked.
MAX_GRIP_TICK = 20
# How many faults of a file or a request are told at once.
MAX_FAULTS = 20
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

Name = Annotated[str, Field(pattern=NAME_PATTERN)]
UserOrGroup = Annotated[str, Field(pattern=r"^@?[A-Za-z_][A-Za-z0-9_.-]{0,31}$")]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0, allow_inf_nan=False)]


class Frozen(BaseModel):
    """What comes from outside: checked as a whole, nothing converted, nothing unknown, and never changed after."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)


class Compliance(Frozen):
    """Position-control registers of one servo, in register units."""

    # Ticks around the goal within which the motor does nothing.
    margin: int = Field(1, ge=0, le=254)
    # Ticks over which torque grows to its full value; the servo rounds it down to 2, 4, 8, ..., 128.
    slope: int = Field(32, ge=1, le=254)
    # Torque at the edge of the margin, of 1023.
    punch: int = Field(32, ge=0, le=1023)


class JointConfig(Frozen):
    """One servo and the joint it turns: position_rad = direction * (tick - zero_tick) * TICK_RAD."""

    # Of the joint, wherever one is shown or asked for.
    name: Name
    # Its ID on the bus.
    servo_id: int = Field(ge=0, le=253)
    # -1 where the servo is mounted the other way round.
    direction: Literal[1, -1] = 1
    # What the servo reads at joint position 0; `armctl calibrate` finds it.
    zero_tick: float = Field(512.0, ge=-1023.0, le=2046.0)
    # Lowest and highest joint position of any goal.
    limits_deg: tuple[Degrees, Degrees] = Field(strict=False)
    # No motion asks more of the joint.
    speed_limit_deg_s: float = Field(60.0, gt=0.0, le=354.0)
    # No plan asks more of the joint.
    acceleration_limit_deg_s2: float = Field(400.0, gt=0.0, le=20000.0)
    # Where the joint lies when the arm is parked, and may go limp.
    rest_deg: Degrees = 0.0
    # Fraction of full torque the daemon allows once the arm holds.
    torque_limit_ratio: float = Field(1.0, gt=0.0, le=1.0)
    # How stiffly the servo holds.
    compliance: Compliance = Compliance()

    @model_validator(mode="after")
    def _check(self) -> Self:
        low, high = self.limits_deg
        if not low < high:
            raise ValueError(f"limits_deg [{low}, {high}]: the first must be below the second")
        if not low <= self.rest_deg <= high:
            raise ValueError(f"rest_deg {self.rest_deg} lies outside limits_deg [{low}, {high}]")
        for limit in (low, high):
            tick = self.tick(math.radians(limit))
            if not -0.5 <= tick <= ax12a.TICK_MAX + 0.5:
                raise ValueError(
                    f"limits_deg {limit} is tick {tick:.0f} with zero_tick {self.zero_tick}; a servo reaches 0 to 1023"
                )
        return self

    def tick(self, position_rad: float) -> float:
        """Servo position [tick, unrounded] of a joint position [rad]."""
        return self.zero_tick + self.direction * position_rad / ax12a.TICK_RAD

    def position_rad(self, tick: float) -> float:
        """Joint position [rad] of a servo position [tick]."""
        return self.direction * (tick - self.zero_tick) * ax12a.TICK_RAD

    @cached_property
    def limits_rad(self) -> tuple[float, float]:
        return math.radians(self.limits_deg[0]), math.radians(self.limits_deg[1])

    @cached_property
    def limits_tick(self) -> tuple[int, int]:
        """Lowest and highest whole goal tick inside the limits."""
        ends = sorted(self.tick(limit) for limit in self.limits_rad)
        return max(0, math.ceil(ends[0] - 1e-9)), min(ax12a.TICK_MAX, math.floor(ends[1] + 1e-9))

    @property
    def speed_limit_rad_s(self) -> float:
        return math.radians(self.speed_limit_deg_s)

    @property
    def acceleration_limit_rad_s2(self) -> float:
        return math.radians(self.acceleration_limit_deg_s2)

    @property
    def rest_rad(self) -> float:
        return math.radians(self.rest_deg)


class GripperConfig(Frozen):
    """The joint that grips. It moves no tool point, and gets from open to closed unless something is in between."""

    # Its name among the joints.
    joint: Name
    # Where it has let go.
    open_deg: Degrees
    # Where it is closed with nothing in between.
    closed_deg: Degrees
    # The load that tells a grip, and that holds it: above friction, below what makes the servo hot.
    load_ratio: float = Field(0.3, ge=0.15, le=0.5)


class ArmConfig(Frozen):
    """One physical arm: its servos, their calibration and the robot model they form."""

    # Of this one arm; recordings, plans and logs carry it, and another arm refuses them.
    arm_id: Name
    # Kinematic model, one of `armctl robots`.
    robot: Name
    # Link lengths that differ from the robot's own, by the robot's parameter names.
    lengths_m: dict[str, float] = {}
    # Height of the surface the arm stands on, in the base frame; no plan goes below it.
    floor_m: float = 0.0
    # How thick the links are all round, for what may touch; half the longest side of an AX-12A.
    link_radius_m: float = Field(0.025, gt=0.0, le=0.5)
    # No motion moves the tool point faster; while teaching, a faster hand is warned.
    tool_speed_limit_m_s: float = Field(0.25, gt=0.0, le=2.0)
    # Supply voltage outside which the arm goes to rest.
    voltage_V: tuple[float, float] = Field((9.0, 13.0), strict=False)
    # Temperature from which the arm goes to rest, before a servo's own trip drops it.
    temperature_limit_degC: float = Field(65.0, gt=0.0, le=80.0)
    # Whether lasting heat, wrong voltage or overload send the arm to its rest pose; if not, it holds where it is.
    rest_on_strain: bool = True
    # Whether goals are corrected by the lag that is foreseen and by what the encoders show.
    correction: bool = True
    # From the base to the tool.
    joints: tuple[JointConfig, ...] = Field(min_length=1, max_length=32, strict=False)
    # What `reach --grip` closes.
    gripper: GripperConfig | None = None

    @model_validator(mode="after")
    def _check_gripper(self) -> Self:
        gripper = self.gripper
        if gripper is None:
            return self
        if gripper.joint not in self.joint_names:
            raise ValueError(f"gripper.joint {gripper.joint}: no such joint; known: {', '.join(self.joint_names)}")
        joint = self.joints[self.joint_names.index(gripper.joint)]
        low, high = joint.limits_deg
        for angle in (gripper.open_deg, gripper.closed_deg):
            if not low <= angle <= high:
                raise ValueError(f"gripper: {angle} deg lies outside limits_deg [{low}, {high}] of {joint.name}")
        if gripper.open_deg == gripper.closed_deg:
            raise ValueError(f"gripper: open and closed are both {gripper.open_deg} deg")
        slope_tick = 1 << (joint.compliance.slope.bit_length() - 1)  # the register's steps are 2, 4, 8, ..., 128
        behind_tick = joint.compliance.margin + gripper.load_ratio * slope_tick
        if behind_tick > MAX_GRIP_TICK:
            raise ValueError(
                f"gripper.load_ratio {gripper.load_ratio}: with compliance slope {joint.compliance.slope} the servo is "
                f"{behind_tick:.0f} ticks behind its goal then, at most {MAX_GRIP_TICK}; lower either of them"
            )
        return self

    @model_validator(mode="after")
    def _check(self) -> Self:
        for what in ("name", "servo_id"):
            values = [getattr(joint, what) for joint in self.joints]
            for index, value in enumerate(values):
                if value in values[:index]:
                    raise ValueError(f"two joints have {what} {value}")
        return self

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
        return tuple(joint.servo_id for joint in self.joints)

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def calibration_hash(self) -> str:
        """Short fingerprint that tells whether a log was recorded with this calibration.

        How thick the links are changes nothing in a log, and every plan is judged anew before it runs. What a gripper
        was told stands in the log itself, as does how goals were corrected.
        """
        told = self.model_dump_json(exclude={"link_radius_m", "gripper", "correction"})
        return hashlib.sha256(told.encode()).hexdigest()[:16]


class LogConfig(Frozen):
    """Where logs go and when a file is full."""

    # A file is finished, and the next begun, after this long.
    rotate_s: float = Field(3600.0, ge=1.0)
    # And when it holds this much.
    rotate_bytes: int = Field(128 * 2**20, ge=2**16)
    # Logging stops, and control goes on, when less than this is free and no old log is left to delete.
    free_bytes: int = Field(256 * 2**20, ge=0)
    # What all finished logs together may take; the oldest are deleted beyond it.
    quota_bytes: int = Field(4 * 2**30, ge=2**20)
    # Logs older than this, counted back from the newest, are deleted; 0: none is for its age.
    max_age_s: float = Field(0.0, ge=0.0)
    # So much before and after a fault is kept in a file of its own, which no bound deletes.
    snapshot_s: float = Field(30.0, ge=1.0, le=600.0)


class Config(Frozen):
    """How the daemon runs."""

    # Serial device, or the link of a simulator; empty: the --port option must name one.
    port: str = ""
    # Bit rate of the servos.
    baud: int = Field(1_000_000, ge=7_843, le=1_000_000)
    # Name of a file in `calibration/`, or a path.
    arm: str = "ax12-line"
    # Of the control tick.
    period_s: float = Field(0.1, ge=0.01, le=1.0)
    # Folder of logs, recordings and plans; empty: below the user's XDG data folder.
    data_dir: str = ""
    # Users, and groups as @name, who may command; others that reach the socket may look, and stop the arm. Empty:
    # everybody who reaches it.
    commanders: tuple[UserOrGroup, ...] = Field((), strict=False)
    # Bounds of the log.
    log: LogConfig = LogConfig()


class _StrictLoader(yaml.SafeLoader):
    """SafeLoader without aliases, tags, duplicate keys, depth and surprising scalars."""

    yaml_implicit_resolvers: dict[str, list[tuple[str, re.Pattern[str]]]] = {}  # noqa: RUF012

    depth = 0

    def compose_node(self, parent: Any, index: Any) -> Any:
        event = self.peek_event()  # type: ignore[no-untyped-call]
        problem = (
            "aliases are not allowed" if isinstance(event, yaml.AliasEvent)
            else "tags are not allowed" if getattr(event, "tag", None) is not None
            else f"nested more than {MAX_YAML_DEPTH} deep" if self.depth == MAX_YAML_DEPTH
            else ""
        )  # fmt: skip
        if problem:
            raise yaml.MarkedYAMLError(problem=problem, problem_mark=event.start_mark)
        self.depth += 1
        node = super().compose_node(parent, index)
        self.depth -= 1
        return node

    def construct_mapping(self, node: Any, deep: bool = False) -> dict[Any, Any]:
        seen: set[str] = set()
        for key_node, _ in node.value:
            if not isinstance(key_node, yaml.ScalarNode):
                raise yaml.MarkedYAMLError(problem="a key must be a plain word", problem_mark=key_node.start_mark)
            if key_node.value in seen:
                raise yaml.MarkedYAMLError(
                    problem=f"key {key_node.value!r} stands twice", problem_mark=key_node.start_mark
                )
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


for _tag, _regexp, _first in (
    ("tag:yaml.org,2002:null", r"^(?:~|null|)$", ["~", "n", ""]),
    ("tag:yaml.org,2002:bool", r"^(?:true|false)$", list("tf")),
    ("tag:yaml.org,2002:int", r"^[-+]?(?:0|[1-9][0-9]*)$", list("-+0123456789")),
    ("tag:yaml.org,2002:float", r"^[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?$", list("-+0123456789")),
):
    _StrictLoader.add_implicit_resolver(_tag, re.compile(_regexp), _first)


def parse_yaml(text: str, file: str) -> dict[str, Any]:
    """The top-level mapping of a YAML text.

    Raises:
        ConfigError: not YAML, not a mapping, too large, or using a feature that is not allowed.
    """
    if len(text.encode(errors="replace")) > MAX_YAML_BYTES:
        raise ConfigError(file, "", f"larger than {MAX_YAML_BYTES} bytes")
    try:
        data = yaml.load(text, Loader=_StrictLoader)  # a SafeLoader with fewer features
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        where = f"line {mark.line + 1}, column {mark.column + 1}" if mark else ""
        raise ConfigError(file, where, error.problem or "not valid YAML") from None
    except (yaml.YAMLError, ValueError, RecursionError) as error:
        raise ConfigError(file, "", f"not valid YAML: {error}") from None
    if data is None:
        return {}
    if not isinstance(data, dict):
        raise ConfigError(file, "", f"holds a {type(data).__name__}, not keys and values")
    return data


M = TypeVar("M", bound=BaseModel)


def validate(model: type[M], data: object, file: str) -> M:
    """`data` as a `model`.

    Raises:
        ConfigError: naming the file and, for every fault in it up to `MAX_FAULTS`, key, value and bound.
    """
    try:
        return model.model_validate(data)
    except ValidationError as error:
        lines = []
        for fault in error.errors(include_url=False)[:MAX_FAULTS]:
            key = ".".join(str(part) for part in fault["loc"])
            message = fault["msg"].removeprefix("Value error, ")
            if fault["type"] == "extra_forbidden":
                message = "unknown key"
            if fault["type"] not in ("missing", "value_error"):
                message += f" (found {str(fault['input'])[:60]!r})"
            lines.append((key, message))
        first, *rest = lines
        text = first[1] + "".join(f"\n  {key}: {message}" for key, message in rest)
        if (more := error.error_count() - MAX_FAULTS) > 0:
            text += f"\n  and {more} more"
        raise ConfigError(file, first[0], text) from None
