"""The ROS 2 message types of a log, each declared once.

A declaration is the body of its `.msg` file: one `type name` a line, constants as `type NAME=value`. From it
derive both the schema text stored in the file (`ros2msg`: the body, then every type it needs) and the codec that
writes and reads the bytes (see cdr.py), so that the two cannot disagree.
"""

import re
from collections.abc import Mapping
from dataclasses import dataclass

from armctl.errors import LogError

# The format character of the struct module for every primitive of a fixed size.
PRIMITIVES = {
    "bool": "?",
    "byte": "B",
    "uint8": "B",
    "int8": "b",
    "uint16": "H",
    "int16": "h",
    "uint32": "I",
    "int32": "i",
    "uint64": "Q",
    "int64": "q",
    "float32": "f",
    "float64": "d",
}

# Body of every message type by its short name, `package/Type`.
MESSAGES: dict[str, str] = {
    "builtin_interfaces/Time": "int32 sec\nuint32 nanosec",
    "builtin_interfaces/Duration": "int32 sec\nuint32 nanosec",
    "std_msgs/Header": "builtin_interfaces/Time stamp\nstring frame_id",
    "std_msgs/String": "string data",
    "sensor_msgs/JointState": (
        "std_msgs/Header header\nstring[] name\nfloat64[] position\nfloat64[] velocity\nfloat64[] effort"
    ),
    "geometry_msgs/Point": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Vector3": "float64 x\nfloat64 y\nfloat64 z",
    "geometry_msgs/Quaternion": "float64 x\nfloat64 y\nfloat64 z\nfloat64 w",
    "geometry_msgs/Pose": "geometry_msgs/Point position\ngeometry_msgs/Quaternion orientation",
    "geometry_msgs/PoseStamped": "std_msgs/Header header\ngeometry_msgs/Pose pose",
    "geometry_msgs/Transform": "geometry_msgs/Vector3 translation\ngeometry_msgs/Quaternion rotation",
    "geometry_msgs/TransformStamped": (
        "std_msgs/Header header\nstring child_frame_id\ngeometry_msgs/Transform transform"
    ),
    "tf2_msgs/TFMessage": "geometry_msgs/TransformStamped[] transforms",
    "trajectory_msgs/JointTrajectoryPoint": (
        "float64[] positions\nfloat64[] velocities\nfloat64[] accelerations\nfloat64[] effort\n"
        "builtin_interfaces/Duration time_from_start"
    ),
    "trajectory_msgs/JointTrajectory": (
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint[] points"
    ),
    "diagnostic_msgs/KeyValue": "string key\nstring value",
    "diagnostic_msgs/DiagnosticStatus": (
        "byte OK=0\nbyte WARN=1\nbyte ERROR=2\nbyte STALE=3\n"
        "byte level\nstring name\nstring message\nstring hardware_id\ndiagnostic_msgs/KeyValue[] values"
    ),
    "diagnostic_msgs/DiagnosticArray": "std_msgs/Header header\ndiagnostic_msgs/DiagnosticStatus[] status",
    "rcl_interfaces/Log": (
        "byte DEBUG=10\nbyte INFO=20\nbyte WARN=30\nbyte ERROR=40\nbyte FATAL=50\n"
        "builtin_interfaces/Time stamp\nuint8 level\nstring name\nstring msg\nstring file\nstring function\n"
        "uint32 line"
    ),
    # One servo's reply: registers are control table 24..49 as they came, stamp_ns is monotonic.
    "armctl_msgs/Servo": (
        "uint8 id\nstring name\nbool fresh\nuint8 error\nstring problem\nint64 stamp_ns\nuint8[] registers"
    ),
    "armctl_msgs/ServoArray": "std_msgs/Header header\narmctl_msgs/Servo[] servos",
    # What else the control step saw in this tick, and how the tick went. `inputs_only`: the tick stands here
    # for replay alone, it lies before the file's own beginning.
    "armctl_msgs/Cycle": (
        "std_msgs/Header header\nuint64 tick\nint64 now_ns\nint64 time_ns\nint64 late_ns\nint64 lateness_us\n"
        "int64 bus_us\nint64 write_us\nuint32 retries\nuint32 dropped\nbool overrun\nbool port_open\n"
        "bool inputs_only"
    ),
}

_TYPE = re.compile(r"(?:[a-z][a-z0-9_]*/)?[A-Za-z][A-Za-z0-9]*\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


@dataclass(frozen=True, slots=True)
class Field:
    """One field; `type` is a primitive, `string` or the short name of another message."""

    name: str
    type: str
    is_array: bool


def short_name(name: str) -> str:
    """`package/Type` of `package/msg/Type`."""
    return name.replace("/msg/", "/")


def full_name(name: str) -> str:
    """`package/msg/Type` of `package/Type`."""
    return name.replace("/", "/msg/")


def fields(name: str, messages: Mapping[str, str] = MESSAGES) -> tuple[Field, ...]:
    """The fields of a type in order.

    Raises:
        LogError: the type is unknown, or its declaration uses what armctl does not know.
    """
    if name not in messages:
        raise LogError(f"message type {name}: unknown")
    found = []
    for line in messages[name].splitlines():
        words = line.split("#", 1)[0].split()
        if not words or "=" in line.split("#", 1)[0]:
            continue
        base = words[0].removesuffix("[]")
        if len(words) != 2 or not _TYPE.match(base) or not _NAME.match(words[1]):
            raise LogError(f"message type {name}: cannot read the field {line.strip()[:60]!r}")
        if base != "string" and base not in PRIMITIVES and "/" not in base:
            base = f"{name.split('/')[0]}/{base}"
        found.append(Field(words[1], base, words[0].endswith("[]")))
    # ROS 2 gives an empty message one byte, as IDL knows no empty structure.
    return tuple(found) or (Field("structure_needs_at_least_one_member", "uint8", False),)


def schema_text(name: str) -> str:
    """The `ros2msg` schema of a type: its body, then every type it needs, each after a rule and its name."""
    needed: list[str] = []

    def visit(current: str) -> None:
        for field in fields(current):
            if field.type in MESSAGES and field.type not in needed:
                needed.append(field.type)
                visit(field.type)

    visit(name)
    return MESSAGES[name] + "".join(f"\n{'=' * 80}\nMSG: {other}\n{MESSAGES[other]}" for other in needed) + "\n"


def parse_schema(name: str, text: str) -> dict[str, str]:
    """The bodies inside a `ros2msg` schema by short name; the inverse of `schema_text`."""
    first, *rest = re.split(r"^={3,}$", text, flags=re.MULTILINE)
    bodies = {short_name(name): first}
    for section in rest:
        head, _, body = section.strip().partition("\n")
        bodies[short_name(head.removeprefix("MSG:").strip())] = body
    return bodies
