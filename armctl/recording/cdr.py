"""CDR, the bytes of ROS 2 messages (XCDR1, little endian), driven by the declarations of schemas.py.

Rules.
1. Four bytes `00 01 00 00` come first; alignment counts from after them.
2. A primitive is aligned to its own size. Strings are a uint32 length that includes the final NUL, then UTF-8.
3. A sequence is a uint32 count, then its elements; an empty one is followed by no padding.
4. A message is a dict with exactly the declared keys: a missing or misspelled one is an error, never a zero.

A type is compiled once into a list of steps. Neighbouring primitives become one precompiled `struct` for each of the
eight positions its first byte can have. Messages of one `Shape` are read at one go, without the steps.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import groupby
from typing import Any, NamedTuple

from armctl.errors import LogError
from armctl.recording.schemas import MESSAGES, PRIMITIVES, Field, fields, parse_schema, short_name
from armctl.recording.shapes import HEADER as HEADER
from armctl.recording.shapes import Shape, packer, pieces
from armctl.recording.shapes import Value as Value

# Bounds for schemas that came with a file from elsewhere.
MAX_DEPTH = 16
MAX_NESTED = 1000
MAX_FIELDS = 10_000
_SIMPLE = {*PRIMITIVES, "string"}
# Bounds on the shapes that are kept of a type: sizes of messages, shapes of each, and pieces of a shape, which has more
# than so many bytes for each one of its texts.
MAX_SIZES, MAX_SHAPES, MAX_PIECES, MAX_TEXT = 64, 4, 256, 1.5

# What puts a value behind the bytes so far, and what gets one from its place on: the value, and where it ends.
_Put = Callable[[bytearray, Any], None]
_Get = Callable[[bytes, int], tuple[Any, int]]
# The same for some fields of a message; decoding enters them into it.
_Encode = Callable[[bytearray, Value], None]
_Decode = Callable[[bytes, int, Value], int]


class _Type(NamedTuple):
    """A compiled type, with the number of messages and fields inside it; those in lists do not count."""

    put: _Put
    get: _Get
    nested: int
    fields: int


@dataclass(frozen=True)
class Codec:
    """Bytes of one message type, both ways."""

    name: str
    _type: _Type
    _messages: Mapping[str, str] = field(repr=False, compare=False)
    # Shapes that were met, by the size of their messages; None: one that is not worth it.
    _shapes: dict[int, list[Shape | None]] = field(default_factory=dict, repr=False, compare=False)

    def encode(self, value: Value) -> bytes:
        """CDR bytes of a message.

        Raises:
            ValueError: a key is missing or unknown, or a value does not fit its field.
        """
        out = bytearray(HEADER)
        try:
            self._type.put(out, value)
        except (struct.error, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{self.name}: {error}") from None
        return bytes(out)

    def decode(self, data: bytes) -> Value:
        """The message in `data`.

        Raises:
            LogError: the bytes are no such message.
        """
        shapes = self._shapes.get(len(data), ())
        for shape in shapes:
            if shape is not None and (known := shape.decode(data)) is not None:
                return known
        if data[:4] != HEADER:
            raise LogError(f"{self.name}: not little-endian CDR (header {bytes(data[:4]).hex()})")
        try:
            message: Value = self._type.get(data, len(HEADER))[0]
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise LogError(f"{self.name}: damaged message of {len(data)} bytes ({error})") from None
        if len(shapes) < MAX_SHAPES and len(self._shapes) < MAX_SIZES:
            self._shapes.setdefault(len(data), []).append(self._shape(message, len(data)))
        return message

    def _shape(self, message: Value, size: int) -> Shape | None:
        """The shape of a message; None where it is too long, or mostly text, which seldom comes again."""
        found = pieces(self.name, message, self._messages)
        texts = sum(len(content) for code, content in found if not code)
        fits = len(found) <= MAX_PIECES and packer(found).size == size > texts * MAX_TEXT
        return Shape(self.name, message, self._messages) if fits else None


@lru_cache(256)
def codec(name: str) -> Codec:
    """The codec of one of armctl's own types, by short or full name."""
    return Codec(short_name(name), _compile(short_name(name), MESSAGES, 0, {}), MESSAGES)


@lru_cache(256)
def schema_codec(name: str, text: str) -> Codec:
    """The codec of a type as a file's schema declares it.

    Raises:
        LogError: the schema cannot be read.
    """
    messages = parse_schema(name, text)
    return Codec(short_name(name), _compile(short_name(name), messages, 0, {}), messages)


def _compile(name: str, messages: Mapping[str, str], depth: int, known: dict[str, _Type]) -> _Type:
    if name in known:
        return known[name]
    too_much = LogError(f"message type {name}: nested deeper than {MAX_DEPTH} or wider than {MAX_NESTED}")
    if depth > MAX_DEPTH:
        raise too_much
    members = fields(name, messages)
    keys = frozenset(item.name for item in members)
    inside = {item: _compile(item.type, messages, depth + 1, known) for item in members if item.type not in _SIMPLE}
    single = {item.name: part for item, part in inside.items() if not item.is_array}
    nested = sum(1 + part.nested for part in single.values())
    count = len(members) + sum(part.fields for part in single.values())
    if nested > MAX_NESTED:
        raise too_much
    if count > MAX_FIELDS:
        raise LogError(f"message type {name}: over {MAX_FIELDS} fields")
    steps: list[tuple[_Encode, _Decode]] = []
    for are_numbers, group in groupby(members, lambda item: item.type in PRIMITIVES and not item.is_array):
        if are_numbers:
            steps.append(_run(list(group)))
        else:
            steps += [_field(item.name, *_value_of(item, inside.get(item))) for item in group]

    def put(out: bytearray, value: Value) -> None:
        if value.keys() != keys:
            raise ValueError(f"missing or unknown fields: {', '.join(sorted(keys ^ value.keys()))}")
        for encode, _ in steps:
            encode(out, value)

    def get(data: bytes, at: int) -> tuple[Value, int]:
        value: Value = dict.fromkeys(single)  # messages come first, then all other fields
        for _, decode in steps:
            at = decode(data, at, value)
        return value, at

    known[name] = _Type(put, get, nested, count)
    return known[name]


def _value_of(item: Field, part: _Type | None) -> tuple[_Put, _Get]:
    """How the value of a field that is no plain number goes into bytes; `part`: its type, if that is a message."""
    if item.is_array and item.type in ("byte", "uint8"):
        return _put_blob, _get_blob
    if item.type in PRIMITIVES:
        return _numbers(PRIMITIVES[item.type])
    put, get = (_put_string, _get_string) if part is None else part[:2]
    return _list(put, get) if item.is_array else (put, get)


def _packers(formats: str) -> tuple[struct.Struct, ...]:
    """One struct for each (position in the message) mod 8, with its padding inside; the header shifts by 4."""
    found = []
    for begin in range(8):
        at, text = begin - 4, "<"
        for character in formats:
            size = struct.calcsize(character)
            text += "x" * (-at % size) + character
            at += -at % size + size
        found.append(struct.Struct(text))
    return tuple(found)


_COUNT = _packers("I")


def _run(items: list[Field]) -> tuple[_Encode, _Decode]:
    """The step of neighbouring numbers."""
    keys = [item.name for item in items]
    packers = _packers("".join(PRIMITIVES[item.type] for item in items))

    def encode(out: bytearray, message: Value) -> None:
        out += packers[len(out) & 7].pack(*[message[key] for key in keys])

    def decode(data: bytes, at: int, message: Value) -> int:
        packer = packers[at & 7]
        message.update(zip(keys, packer.unpack_from(data, at), strict=True))
        return at + packer.size

    return encode, decode


def _field(key: str, put: _Put, get: _Get) -> tuple[_Encode, _Decode]:
    """The step of a field that is no plain number."""

    def encode(out: bytearray, message: Value) -> None:
        put(out, message[key])

    def decode(data: bytes, at: int, message: Value) -> int:
        message[key], at = get(data, at)
        return at

    return encode, decode


def _put_count(out: bytearray, count: int) -> None:
    out += _COUNT[len(out) & 7].pack(count)


def _get_count(data: bytes, at: int) -> tuple[int, int]:
    packer = _COUNT[at & 7]
    return packer.unpack_from(data, at)[0], at + packer.size


def _put_string(out: bytearray, text: str) -> None:
    # Names and frame ids come again in every message, texts do not.
    out += _known_string(text, len(out) & 7) if len(text) < 32 else _string_bytes(text, len(out) & 7)


def _string_bytes(text: str, position: int) -> bytes:
    data = text.encode()
    return _COUNT[position].pack(len(data) + 1) + data + b"\0"


_known_string = lru_cache(1024)(_string_bytes)


def _get_string(data: bytes, at: int) -> tuple[str, int]:
    at += (-at & 3) + 4
    end = at + int.from_bytes(data[at - 4 : at], "little")
    if end > len(data):
        raise IndexError(f"a string of {end - at} bytes ends beyond the message")
    return data[at : end - 1].decode(), end


def _put_blob(out: bytearray, value: Any) -> None:
    blob = bytes(memoryview(value))
    _put_count(out, len(blob))
    out += blob


def _get_blob(data: bytes, at: int) -> tuple[bytes, int]:
    count, at = _get_count(data, at)
    if at + count > len(data):
        raise IndexError(f"{count} bytes end beyond the message")
    return bytes(data[at : at + count]), at + count


def _numbers(character: str) -> tuple[_Put, _Get]:
    """A sequence of numbers of one format."""
    size = struct.calcsize(character)

    def put(out: bytearray, values: Any) -> None:
        _put_count(out, len(values))
        if values:
            out += bytes(-(len(out) - 4) % size)
            out += struct.pack(f"<{len(values)}{character}", *values)

    def get(data: bytes, at: int) -> tuple[list[Any], int]:
        count, at = _get_count(data, at)
        if not count:
            return [], at
        at += -(at - 4) % size
        if at + count * size > len(data):
            raise IndexError(f"{count} values end beyond the message")
        return list(struct.unpack_from(f"<{count}{character}", data, at)), at + count * size

    return put, get


def _list(put: _Put, get: _Get) -> tuple[_Put, _Get]:
    """A sequence of strings or messages."""

    def put_all(out: bytearray, values: Any) -> None:
        _put_count(out, len(values))
        for value in values:
            put(out, value)

    def get_all(data: bytes, at: int) -> tuple[list[Any], int]:
        count, at = _get_count(data, at)
        values = []
        for _ in range(count):
            value, at = get(data, at)
            values.append(value)
        return values, at

    return put_all, get_all
