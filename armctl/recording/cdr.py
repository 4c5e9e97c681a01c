"""CDR, the bytes of ROS 2 messages (XCDR1, little endian), driven by the declarations of schemas.py.

Rules.
1. Four bytes `00 01 00 00` come first; alignment counts from after them.
2. A primitive is aligned to its own size. Strings are a uint32 length that includes the final NUL, then UTF-8.
3. A sequence is a uint32 count, then its elements; an empty one is followed by no padding.
4. A message is a dict with exactly the declared keys: a missing or misspelled one is an error, never a zero.

Messages of a shape that came before are decoded at one go (shapes.py), all others field by field.
"""

import struct
from collections.abc import Mapping
from functools import lru_cache
from typing import Any

from armctl.errors import LogError
from armctl.recording.schemas import MESSAGES, PRIMITIVES, fields, parse_schema, short_name
from armctl.recording.shapes import HEADER as HEADER
from armctl.recording.shapes import Shape, shape
from armctl.recording.shapes import Value as Value

# Bounds for schemas that came with a file from elsewhere.
MAX_DEPTH = 16
MAX_NESTED = 1000
MAX_FIELDS = 10_000
# Bounds on the shapes that are kept of a type: sizes of messages, and shapes of each size; and on the bytes of a
# message whose shape is looked for.
MAX_SIZES, MAX_SHAPES, MAX_BYTES = 64, 4, 2**14
_MISFITS = (struct.error, TypeError, AttributeError, ValueError, LookupError)
_STRING, _BYTES = "s", "B"
_COUNT = struct.Struct("<I").unpack_from
_SIZES = {code: struct.calcsize(code) for code in (*PRIMITIVES.values(), _STRING)}


class Codec:
    """Bytes of one message type, both ways."""

    def __init__(self, name: str, messages: Mapping[str, str]) -> None:
        """
        Args:
            name: Short name of the type.
            messages: Declarations of the types.
        Raises:
            LogError: it is nested too deeply, or too wide.
        """
        self.name, self._messages = name, messages
        self._type = _compile(name, messages, 0, {})
        # Shapes that were met in decoding, by the size of messages; None: one that is not worth it.
        self._decoded: dict[int, list[Shape | None]] = {}

    def encode(self, value: Value) -> bytes:
        """CDR bytes of a message.

        Raises:
            ValueError: a key is missing or unknown, or a value does not fit its field.
        """
        out = bytearray(HEADER)
        try:
            self._type.put(out, value)
        except _MISFITS as error:
            raise ValueError(f"{self.name}: {error}") from None
        return bytes(out)

    def shape(self, value: Value) -> Shape | None:
        """The shape of a message, if it is worth it."""
        return shape(self.name, value, self._messages)

    def decode(self, data: bytes) -> Value:
        """The message in `data`.

        Raises:
            LogError: the bytes are no such message.
        """
        shapes = self._decoded.get(len(data), ())
        for known in shapes:
            if known is not None and (value := known.decode(data)) is not None:
                return value
        if data[:4] != HEADER:
            raise LogError(f"{self.name}: not little-endian CDR (header {bytes(data[:4]).hex()})")
        try:
            message, _ = self._type.get(data, len(HEADER))
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise LogError(f"{self.name}: damaged message of {len(data)} bytes ({error})") from None
        if len(shapes) < MAX_SHAPES and len(self._decoded) < MAX_SIZES and len(data) <= MAX_BYTES:
            self._decoded.setdefault(len(data), []).append(self.shape(message))
        return message


@lru_cache(256)
def codec(name: str) -> Codec:
    """The codec of one of armctl's own types, by short or full name."""
    return Codec(short_name(name), MESSAGES)


@lru_cache(256)
def schema_codec(name: str, text: str) -> Codec:
    """The codec of a type as a file's schema declares it.

    Raises:
        LogError: the schema cannot be read.
    """
    return Codec(short_name(name), parse_schema(name, text))


def _compile(name: str, messages: Mapping[str, str], depth: int, known: dict[str, "_Type"]) -> "_Type":
    if name in known:
        return known[name]
    if depth > MAX_DEPTH:
        raise LogError(f"message type {name}: nested deeper than {MAX_DEPTH}")
    members: list[tuple[str, Any, bool]] = []
    for item in fields(name, messages):
        plain = PRIMITIVES.get(item.type, _STRING if item.type == "string" else "")
        members.append((item.name, plain or _compile(item.type, messages, depth + 1, known), item.is_array))
    made = known[name] = _Type(members)
    if made.nested > MAX_NESTED or made.count > MAX_FIELDS:
        raise LogError(f"message type {name}: wider than {MAX_NESTED} messages or {MAX_FIELDS} fields")
    return made


class _Type:
    """A compiled type; of each field: name, kind (a format of `struct`, `_STRING`, or a type), if it is a list."""

    def __init__(self, members: list[tuple[str, Any, bool]]) -> None:
        self._fields, self._keys = members, frozenset(name for name, _, _ in members)
        # Messages in it come first in what is decoded, then all other fields.
        self._single = {name: kind for name, kind, is_list in members if isinstance(kind, _Type) and not is_list}
        # Messages and fields inside it; those in lists do not count.
        self.nested: int = sum(1 + kind.nested for kind in self._single.values())
        self.count: int = len(members) + sum(kind.count for kind in self._single.values())

    def put(self, out: bytearray, value: Value) -> None:
        """Add a message to bytes."""
        if value.keys() != self._keys:
            raise ValueError(f"missing or unknown fields: {', '.join(sorted(self._keys ^ value.keys()))}")
        for name, kind, is_list in self._fields:
            content: Any = value[name] if is_list else (value[name],)
            if is_list:
                content = memoryview(content).tobytes() if kind == _BYTES else content
                _pack(out, "I", len(content))
            if isinstance(kind, _Type):
                for part in content:
                    kind.put(out, part)
            elif kind == _STRING:
                for text in content:
                    data = text.encode() + b"\0"
                    out += bytes(-len(out) & 3) + len(data).to_bytes(4, "little") + data
            elif len(content):
                _pack(out, kind, *content)

    def get(self, data: bytes, at: int) -> tuple[Value, int]:
        """The message that begins at a byte, and where it ends."""
        value: Value = dict.fromkeys(self._single)
        for name, kind, is_list in self._fields:
            if kind is _STRING and not is_list:  # most of the fields of messages that have no shape
                at += (-at & 3) + 4
                begin, at = at, at + _COUNT(data, at - 4)[0]
                value[name] = data[begin : at - 1].decode()
                continue
            found: list[Any] = []
            count = 1
            if is_list:
                at += (-at & 3) + 4
                (count,) = _COUNT(data, at - 4)
            if isinstance(kind, _Type):
                for _ in range(count):
                    part, at = kind.get(data, at)
                    found.append(part)
            elif kind is _STRING:
                for _ in range(count):
                    at += (-at & 3) + 4
                    begin, at = at, at + _COUNT(data, at - 4)[0]
                    found.append(data[begin : at - 1].decode())
            elif kind == _BYTES and is_list:
                (found,), at = _unpack(data, at, _STRING, count)
            elif count:
                found, at = _unpack(data, at, kind, count)
            value[name] = found if is_list else found[0]
        if at > len(data):
            raise IndexError("a text ends beyond it")
        return value, at


def _pack(out: bytearray, code: str, *numbers: Any) -> None:
    """Add numbers of one format, behind what aligns them."""
    out += bytes(-(len(out) - len(HEADER)) % _SIZES[code]) + struct.pack(f"<{len(numbers)}{code}", *numbers)


def _unpack(data: bytes, at: int, code: str, count: int = 1) -> tuple[list[Any], int]:
    """Numbers of one format from a byte on, or behind what aligns them; and where they end."""
    size = _SIZES[code]
    at += -(at - len(HEADER)) % size
    if at + size * count > len(data):
        raise IndexError(f"{count} values end beyond it")
    return [*struct.unpack_from(f"<{count}{code}", data, at)], at + size * count
