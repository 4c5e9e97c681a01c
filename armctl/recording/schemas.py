"""The ROS 2 message types of a log, each declared once, in `msg/PACKAGE/TYPE.msg`; armctl's own in the ROS 2 package
that users build of `docs/armctl_msgs/`.

A declaration has one `type name` a line, constants as `type NAME=value`. From it derive both the schema text
stored in the log (`ros2msg`: the body, then every type it needs) and the codec that writes and reads the bytes
(see cdr.py), so that the two cannot disagree.
"""

import re
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

from armctl.errors import LogError

# The format character of the struct module for every primitive of a fixed size.
PRIMITIVES = {
    "bool": "?", "byte": "B", "uint8": "B", "int8": "b", "uint16": "H", "int16": "h",
    "uint32": "I", "int32": "i", "uint64": "Q", "int64": "q", "float32": "f", "float64": "d",
}  # fmt: skip


def _body(path: Path) -> str:
    """What a `.msg` file declares; its comments stand on lines of their own and are left out."""
    return "\n".join(line for line in path.read_text(encoding="utf-8").splitlines() if not line.startswith("#"))


_OWN = Path(__file__).parents[1] / "docs" / "armctl_msgs" / "msg"
# Body of every message type by its short name, `package/Type`.
MESSAGES = {f"armctl_msgs/{path.stem}": _body(path) for path in sorted(_OWN.glob("*.msg"))} | {
    f"{path.parent.name}/{path.stem}": _body(path) for path in sorted(Path(__file__).with_name("msg").glob("*/*.msg"))
}

_TYPE = re.compile(r"(?:[a-z][a-z0-9_]*/)?[A-Za-z][A-Za-z0-9]*\Z")
_NAME = re.compile(r"[a-z][a-z0-9_]*\Z")


class Field(NamedTuple):
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
    """The `ros2msg` schema of a type, named in short or in full: its body, then every type it needs, each after a rule
    and its name.
    """
    name = short_name(name)
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
