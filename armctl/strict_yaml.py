"""Strict text (YAML, JSON, tables), and strict types to read it into.

What comes from outside is refused as a whole, with file, key, value and bound of everything that is wrong in it. YAML
is read without its surprises: no aliases, tags or duplicate keys, no `.nan`, no `1:30` or `0o17` numbers, at most
64 KiB and 16 levels deep.
"""

import csv
import io
import json
import math
import re
from collections.abc import Sequence
from contextlib import suppress
from typing import Annotated, Any, Self, TypeVar

import yaml
from pydantic import BaseModel, ConfigDict, Field, ValidationError, model_validator

from armctl.errors import ConfigError

MAX_YAML_BYTES = 65536
MAX_YAML_DEPTH = 16
# How many faults of a file or a request are told at once.
MAX_FAULTS = 20
NAME_PATTERN = r"^[A-Za-z0-9][A-Za-z0-9._-]{0,63}$"

Name = Annotated[str, Field(pattern=NAME_PATTERN)]
Degrees = Annotated[float, Field(ge=-360.0, le=360.0, allow_inf_nan=False)]


class Frozen(BaseModel):
    """What comes from outside: checked as a whole, nothing converted, nothing unknown, and never changed after."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False)

    @model_validator(mode="after")
    def _checked(self) -> Self:
        self._check()
        return self

    def _check(self) -> None:
        """Refuse, by a ValueError, values that do not fit together."""


def is_none(value: object) -> bool:
    """For `exclude_if` of a field: what is left out is not told, so logs and hashes of old arms stay as they are."""
    return value is None


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
            plain = isinstance(key_node, yaml.ScalarNode)
            if not plain or key_node.value in seen:
                problem = f"key {key_node.value!r} stands twice" if plain else "a key must be a plain word"
                raise yaml.MarkedYAMLError(problem=problem, problem_mark=key_node.start_mark)
            seen.add(key_node.value)
        return super().construct_mapping(node, deep)


for _tag, _regexp, _first in (
    ("tag:yaml.org,2002:null", r"^(?:~|null|)$", ["~", "n", ""]),
    ("tag:yaml.org,2002:bool", r"^(?:true|false)$", list("tf")),
    ("tag:yaml.org,2002:int", r"^[-+]?(?:0|[1-9][0-9]*)$", list("-+0123456789")),
    ("tag:yaml.org,2002:float", r"^[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?$", list("-+0123456789")),
):
    _StrictLoader.add_implicit_resolver(_tag, re.compile(_regexp), _first)


def keys_once(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """An object of JSON; ValueError: a key stands twice in it."""
    result: dict[str, Any] = {}
    for key, value in pairs:
        if key in result:
            raise ValueError(f"key {key[:60]!r} stands twice")
        result[key] = value
    return result


def parse_json(text: str, file: str, remedy: str = "") -> Any:
    """What a JSON text says.

    Raises:
        ConfigError: not JSON, or a key stands twice.
    """
    try:
        return json.loads(text, object_pairs_hook=keys_once)
    except (ValueError, RecursionError) as error:
        raise ConfigError(file, "", f"not JSON: {error}", remedy) from None


# The place of a row, and its cells by column.
Cells = tuple[str, dict[str, str]]


def csv_table(text: str, file: str, needed: Sequence[str], remedy: str) -> tuple[list[str], list[Cells]]:
    """Header and rows of comma-separated values; of each row its place, and its cells by column. Blank rows count for
    nothing.

    Args:
        needed: Columns that have to be there.
        remedy: What the header must be, for an error message.
    Raises:
        ConfigError: a column is missing, or a row is not as long as the header.
    """
    lines = enumerate(csv.reader(io.StringIO(text), skipinitialspace=True), 1)
    rows = [(f"row {number}", [cell.strip() for cell in row]) for number, row in lines if any(map(str.strip, row))]
    header = rows[0][1] if rows else []
    if missing := [name for name in needed if name not in header]:
        raise ConfigError(file, "header", f"no column {', '.join(missing)}", remedy)
    if odd := [(where, row) for where, row in rows if len(row) != len(header)]:
        raise ConfigError(file, odd[0][0], f"has {len(odd[0][1])} cells, the header {len(header)}")
    return header, [(where, dict(zip(header, row, strict=True))) for where, row in rows[1:]]


def finite(text: str, file: str, where: str) -> float:
    """The finite number in a cell; ConfigError: it is none."""
    with suppress(ValueError):
        if math.isfinite(value := float(text)):
            return value
    raise ConfigError(file, where, f"{text!r} is not a finite number")


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
            key = ".".join(str(part) for part in fault["loc"] if part not in ("a name", "a table"))
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
