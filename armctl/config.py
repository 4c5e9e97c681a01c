"""YAML text -> frozen configuration, strictly; `armctl.files` says where the files are and reads them.

Two files exist. `Config` says how the daemon runs (`armctl.yaml`, optional: every key has a default).
`ArmConfig` describes one physical arm (`calibration/NAME.yaml`). Units stand in the key; angles are degrees in
the files, because people write them, and radians in every property the code reads. The comment above a key is what
`armctl help configuration` tells of it. How both are read stands in `armctl.strict_yaml`.
"""

import hashlib
import math
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import Discriminator, Field, Tag, model_validator

from armctl.dynamixel import ax12a, servos
from armctl.errors import ConfigError
from armctl.gripper import MAX_GRIP_TICK, GripperConfig, OwnGripper
from armctl.links import ChainRow, ChainTable, Metres
from armctl.pair import APART_TICKS, Linkage, PairConfig
from armctl.strict_yaml import NAME_PATTERN, Degrees, Frozen, Name, is_none, parse_yaml, validate

# What is defined below this module, and may be taken from here: parts of an arm, and how a file is read.
__all__ = ["ChainRow", "ChainTable", "GripperConfig", "OwnGripper", "PairConfig"]
__all__ += ["NAME_PATTERN", "Frozen", "Name", "parse_yaml", "validate"]

# The goals and speeds of so many fit into one SYNC_WRITE: 8 bytes, and 5 a servo, of the 250 that the SDK sends.
MOST_SERVOS = 48
UserOrGroup = Annotated[str, Field(pattern=r"^@?[A-Za-z_][A-Za-z0-9_.-]{0,31}$")]


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
    # Which servo it is: one of `ax-12a`, `ax-12w`, `ax-18a`.
    model: str = Field(servos.DEFAULT, exclude_if=servos.DEFAULT.__eq__)
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
    # A second servo that turns this joint.
    pair: PairConfig | None = Field(None, exclude_if=is_none)

    def _check(self) -> None:
        if self.model not in servos.MODELS:
            raise ValueError(f"model {self.model!r}: no such servo; known: {', '.join(servos.MODELS)}")
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
            if self.linkage is not None and not -0.5 <= (second := self.linkage.second(tick)) <= ax12a.TICK_MAX + 0.5:
                found = f"limits_deg {limit} is tick {second:.0f} of the second servo, which reaches 0 to 1023"
                raise ValueError(f"{found}; correct pair, or narrow limits_deg")
        if self.pair is not None and self.pair.servo_id == self.servo_id:
            own = f"pair.servo_id {self.servo_id} is that of the first servo"
            raise ValueError(f"{own}; give each servo an id of its own")

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

    @cached_property
    def linkage(self) -> Linkage | None:
        """How its two servos read against each other; None: it has one."""
        return None if self.pair is None else self.pair.linked(self.direction, self.zero_tick)

    @property
    def servo_count(self) -> int:
        """How many servos turn it."""
        return 1 if self.pair is None else 2

    @property
    def speed_limit_rad_s(self) -> float:
        return math.radians(self.speed_limit_deg_s)

    @property
    def acceleration_limit_rad_s2(self) -> float:
        return math.radians(self.acceleration_limit_deg_s2)

    @property
    def rest_rad(self) -> float:
        return math.radians(self.rest_deg)


class Servo(NamedTuple):
    """One servo of an arm, and the joint it turns."""

    servo_id: int
    # Index of the joint.
    of: int
    joint: JointConfig
    # How it reads against the joint's first servo; None: it is that.
    linkage: Linkage | None = None

    @property
    def name(self) -> str:
        return self.joint.name

    @property
    def model(self) -> str:
        return self.joint.model

    def position_rad(self, tick: float) -> float:
        """Joint position [rad] of this servo's position [tick]."""
        return self.joint.position_rad(tick if self.linkage is None else self.linkage.first(tick))

    @property
    def limits_tick(self) -> tuple[int, int]:
        """Lowest and highest whole goal tick inside the joint's limits; a second servo has room to be off."""
        if self.linkage is None:
            return self.joint.limits_tick
        low, high = sorted([round(self.linkage.second(tick)) for tick in self.joint.limits_tick])
        return max(0, low - APART_TICKS), min(ax12a.TICK_MAX, high + APART_TICKS)

    @property
    def measured(self) -> bool:
        """Whether it is a second servo of which a table was measured."""
        return self.joint.pair is not None and self.joint.pair.table is not None


class ArmConfig(Frozen):
    """One physical arm: its servos, their calibration and the robot model they form."""

    # Of this one arm; recordings, plans and logs carry it, and another arm refuses them.
    arm_id: Name
    # Kinematic model: one of `armctl robots`, or a table of one's own, or a URDF (`armctl help new-arm`).
    robot: Annotated[
        Annotated[Name, Tag("a name")] | Annotated[ChainTable, Tag("a table")],
        Discriminator(lambda told: "a name" if isinstance(told, str) else "a table"),
    ]
    # Link lengths that differ from the robot's own, by the robot's parameter names.
    lengths_m: dict[str, Metres] = Field(default_factory=dict)
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
    # Whether the servos go on with the speed ramp of the goal before; if not, each begins at the shaft. Left out: that
    # shows itself in a motion (RAMP_RESTARTS).
    ramp_from_reference: bool | None = Field(None, exclude_if=is_none)
    # From the base to the tool.
    joints: tuple[JointConfig, ...] = Field(min_length=1, max_length=32, strict=False)
    # What `reach --grip` closes.
    gripper: GripperConfig | None = None

    @model_validator(mode="before")
    @classmethod
    def _with_own_gripper(cls, told: Any) -> Any:
        """A gripper with a servo of its own becomes the last joint."""
        match told:
            case {"joints": [*joints], "gripper": {"servo_id": _} as gripper}:
                try:
                    own = validate(OwnGripper, gripper, "gripper")
                except ConfigError as error:
                    raise ValueError(str(error)) from None
                if own.open_tick == own.closed_tick:
                    raise ValueError(f"gripper: open_tick and closed_tick are both {own.open_tick}")
                joint, gripper = own.as_joint()
                return told | {"joints": [*joints, joint], "gripper": gripper}
        return told

    def _check(self) -> None:
        rows, names = 0 if isinstance(self.robot, str) else len(self.robot.dh), self.joint_names
        if rows > len(names):
            raise ValueError(f"robot has {rows} joints, but joints has {len(names)}; give one entry each")
        if not 0.0 < self.voltage_V[0] < self.voltage_V[1]:
            raise ValueError(f"voltage_V {list(self.voltage_V)}: the first must be above 0 and below the second")
        if self.gripper is not None:
            self._check_gripper(self.gripper, rows)
        for what, remedy in (("name", "give each its own"), ("servo_id", "give each servo an id of its own")):
            values = [getattr(joint, what) for joint in self.joints]
            if twice := [value for index, value in enumerate(values) if value in values[:index]]:
                raise ValueError(f"two joints have {what} {twice[0]}; {remedy}")
        if (count := len(self.servos)) > MOST_SERVOS:
            raise ValueError(f"joints have {count} servos; one packet holds goals for {MOST_SERVOS}, leave some out")
        for index, servo in enumerate(self.servos):
            if servo.servo_id in self.servo_ids[:index]:
                both = f"{self.servos[self.servo_ids.index(servo.servo_id)].name} and the pair of {servo.name}"
                raise ValueError(f"{both} have servo_id {servo.servo_id}; give each servo an id of its own")

    def _check_gripper(self, gripper: GripperConfig, rows: int) -> None:
        if gripper.joint in self.joint_names[:rows]:
            raise ValueError(
                f"gripper.joint {gripper.joint}: it is one of the {rows} joints that move the tool; name one after"
                " them, or leave it out of the chain"
            )
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

    @property
    def robot_name(self) -> str:
        """What to call its kinematic model."""
        return self.robot if isinstance(self.robot, str) else self.arm_id

    @property
    def servos(self) -> tuple[Servo, ...]:
        """The first servo of every joint, in the order of the joints, then the second ones of those that have two."""
        firsts = [Servo(joint.servo_id, i, joint) for i, joint in enumerate(self.joints)]
        pairs = [(i, joint, joint.pair) for i, joint in enumerate(self.joints)]
        return (*firsts, *(Servo(pair.servo_id, i, joint, joint.linkage) for i, joint, pair in pairs if pair))

    @cached_property
    def servo_ids(self) -> tuple[int, ...]:
        """In the order of `servos`, which is that of samples, goals and logs."""
        return tuple(servo.servo_id for servo in self.servos)

    @cached_property
    def servo_names(self) -> tuple[str, ...]:
        """What logs call them; a `+` is in no name of a joint."""
        return tuple(servo.name + ("" if servo.linkage is None else "+") for servo in self.servos)

    @cached_property
    def pairs(self) -> tuple[tuple[int, int], ...]:
        """Places in `servos` of the two servos of every joint that has two."""
        return tuple((servo.of, index) for index, servo in enumerate(self.servos) if servo.linkage is not None)

    @cached_property
    def rigid_pairs(self) -> tuple[tuple[int, int], ...]:
        """Those of `pairs` that turn one shaft; each servo of a gripper has a finger of its own."""
        return tuple(pair for pair in self.pairs if self.joints[pair[0]].name != (self.gripper and self.gripper.joint))

    @cached_property
    def joint_names(self) -> tuple[str, ...]:
        return tuple(joint.name for joint in self.joints)

    @cached_property
    def calibration_hash(self) -> str:
        """Short fingerprint that tells whether a log was recorded with this calibration.

        How thick the links are changes nothing in a log, and every plan is judged anew before it runs. What a gripper
        was told stands in the log itself, as does how goals were corrected.
        """
        told = self.model_dump_json(exclude={"link_radius_m", "gripper", "correction", "ramp_from_reference"})
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
    # So much before and after a fault is kept in a file of its own.
    snapshot_s: float = Field(30.0, ge=1.0, le=600.0)
    # What these files may take together; the oldest are deleted beyond it.
    snapshots_bytes: int = Field(512 * 2**20, ge=2**20)


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
