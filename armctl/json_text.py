"""Messages as lines of JSON, and back; Python's text of a float round-trips every bit."""

import json
from dataclasses import fields, is_dataclass
from functools import cache
from typing import Annotated, Any, TypeVar, cast

from pydantic import Field, TypeAdapter

from armctl.messages import Command

T = TypeVar("T")


@cache
def _adapter(kind: Any) -> TypeAdapter[Any]:
    return TypeAdapter(kind)


def _plain(value: object) -> object:
    if is_dataclass(value):  # not `asdict`, which copies every number of a trajectory
        # What only some arms have is not told of others: logs of old arms stay as they are.
        return {it.name: v for it in fields(value) if (v := getattr(value, it.name)) != it.default or not it.metadata}
    if isinstance(value, bytes):
        return value.hex()
    raise TypeError(f"no JSON form for {type(value).__name__}")


def to_json(message: Any) -> str:
    """Any message as one line of JSON; bytes become hexadecimal."""
    return json.dumps(message, default=_plain, separators=(",", ":"), allow_nan=False)


def named(result: object, *names: str) -> dict[str, Any]:
    """Attributes of anything by their names, arrays as lists."""
    values = ((name, getattr(result, name)) for name in names)
    return {name: value.tolist() if hasattr(value, "tolist") else value for name, value in values}


def from_json(kind: type[T], text: str) -> T:
    """The message of type `kind` written by `to_json`.

    Raises:
        ValueError: the text is not such a message.
    """
    return cast(T, _adapter(kind).validate_python(json.loads(text)))  # type: ignore[arg-type]  # classes are hashable


def command_from_json(text: str) -> Command:
    """A command written by `to_json`, told apart by its `kind`.

    Raises:
        ValueError: the text is no command.
    """
    return cast(Command, _adapter(_BY_KIND).validate_python(json.loads(text)))


# One object for all calls: another one would be another type, with an adapter of its own that is kept for ever.
_BY_KIND = Annotated[Command, Field(discriminator="kind")]
