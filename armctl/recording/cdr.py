"""CDR, the bytes of ROS 2 messages (XCDR1, little endian), driven by the declarations of schemas.py.

Rules.
1. Four bytes `00 01 00 00` come first; alignment counts from after them.
2. A primitive is aligned to its own size. Strings are a uint32 length that includes the final NUL, then UTF-8.
3. A sequence is a uint32 count, then its elements; an empty one is followed by no padding.
4. A message is a dict with exactly the declared keys: a missing or misspelled one is an error, never a zero.

A type is compiled once into a list of steps. Neighbouring primitives, across nested messages, become one
precompiled `struct` for each of the eight positions its first byte can have.
"""

import struct
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

from armctl.errors import LogError
from armctl.recording.schemas import MESSAGES, PRIMITIVES, Field, fields, parse_schema, short_name

HEADER = b"\x00\x01\x00\x00"
# Bounds for schemas that came with a file from elsewhere.
MAX_DEPTH = 16
MAX_NESTED = 1000
MAX_FIELDS = 10_000

Value = dict[str, Any]
_Place = tuple[int, str]  # which of the message's (flattened) dicts, and the key in it
_Encode = Callable[[bytearray, list[Value]], None]
_Decode = Callable[[bytes, int, list[Value]], int]
_Put = Callable[[bytearray, Any], None]  # the same for one value alone
_Get = Callable[[bytes, int], tuple[Any, int]]


@dataclass
class _Layout:
    """A compiled type: the dicts its nested messages live in, and the steps over them."""

    keys: frozenset[str]
    nested: list[tuple[_Place, frozenset[str]]] = field(default_factory=list)
    encoders: list[_Encode] = field(default_factory=list)
    decoders: list[_Decode] = field(default_factory=list)

    def encode(self, out: bytearray, value: Value) -> None:
        _check(value, self.keys)
        dicts = [value]
        for (owner, key), keys in self.nested:
            child = dicts[owner][key]
            _check(child, keys)
            dicts.append(child)
        for step in self.encoders:
            step(out, dicts)

    def decode(self, data: bytes, at: int) -> tuple[Value, int]:
        dicts: list[Value] = [{}]
        for (owner, key), _ in self.nested:
            child: Value = {}
            dicts[owner][key] = child
            dicts.append(child)
        for step in self.decoders:
            at = step(data, at, dicts)
        return dicts[0], at


@dataclass(frozen=True)
class Codec:
    """Bytes of one message type, both ways."""

    name: str
    _layout: _Layout

    def encode(self, value: Value) -> bytes:
        """CDR bytes of a message.

        Raises:
            ValueError: a key is missing or unknown, or a value does not fit its field.
        """
        out = bytearray(HEADER)
        try:
            self._layout.encode(out, value)
        except (struct.error, TypeError, AttributeError, ValueError) as error:
            raise ValueError(f"{self.name}: {error}") from None
        return bytes(out)

    def decode(self, data: bytes) -> Value:
        """The message in `data`.

        Raises:
            LogError: the bytes are no such message.
        """
        if data[:4] != HEADER:
            raise LogError(f"{self.name}: not little-endian CDR (header {bytes(data[:4]).hex()})")
        try:
            return self._layout.decode(data, 4)[0]
        except (struct.error, UnicodeDecodeError, IndexError) as error:
            raise LogError(f"{self.name}: damaged message of {len(data)} bytes ({error})") from None


@lru_cache(256)
def codec(name: str) -> Codec:
    """The codec of one of armctl's own types, by short or full name."""
    return Codec(short_name(name), _compile(short_name(name), MESSAGES, 0, {}))


@lru_cache(256)
def schema_codec(name: str, text: str) -> Codec:
    """The codec of a type as a file's schema declares it.

    Raises:
        LogError: the schema cannot be read.
    """
    return Codec(short_name(name), _compile(short_name(name), parse_schema(name, text), 0, {}))


def _check(value: Value, keys: frozenset[str]) -> None:
    if value.keys() != keys:
        wrong = sorted(keys ^ value.keys())
        raise ValueError(f"missing or unknown fields: {', '.join(wrong)}")


def _compile(name: str, messages: Mapping[str, str], depth: int, known: dict[str, _Layout]) -> _Layout:
    if name in known:
        return known[name]
    layout = _Layout(_keys(name, messages))
    run: list[tuple[_Place, str]] = []
    count = 0

    def add(steps: tuple[_Encode, _Decode]) -> None:
        layout.encoders.append(steps[0])
        layout.decoders.append(steps[1])

    def flush() -> None:
        if run:
            add(_run(tuple(run)))
            run.clear()

    def visit(current: str, index: int, level: int) -> None:
        if level > MAX_DEPTH or len(layout.nested) > MAX_NESTED:
            raise LogError(f"message type {current}: nested deeper than {MAX_DEPTH} or wider than {MAX_NESTED}")
        nonlocal count
        for item in fields(current, messages):
            count += 1
            if count > MAX_FIELDS:
                raise LogError(f"message type {current}: over {MAX_FIELDS} fields")
            place = index, item.name
            if not item.is_array and item.type in PRIMITIVES:
                run.append((place, PRIMITIVES[item.type]))
            elif not item.is_array and item.type != "string":
                layout.nested.append((place, _keys(item.type, messages)))
                visit(item.type, len(layout.nested), level + 1)
            else:
                flush()
                add(_field(place, *value_of(item, level)))

    def value_of(item: Field, level: int) -> tuple[_Put, _Get]:
        if item.type == "string":
            return _list(_put_string, _get_string) if item.is_array else (_put_string, _get_string)
        if item.type in ("byte", "uint8"):
            return _put_blob, _get_blob
        if item.type in PRIMITIVES:
            return _numbers(PRIMITIVES[item.type])
        layout = _compile(item.type, messages, level + 1, known)
        return _list(layout.encode, layout.decode)

    visit(name, 0, depth)
    flush()
    known[name] = layout
    return layout


def _keys(name: str, messages: Mapping[str, str]) -> frozenset[str]:
    return frozenset(item.name for item in fields(name, messages))


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


def _run(run: tuple[tuple[_Place, str], ...]) -> tuple[_Encode, _Decode]:
    places = tuple(place for place, _ in run)
    packers = _packers("".join(character for _, character in run))

    def encode(out: bytearray, dicts: list[Value]) -> None:
        out += packers[len(out) & 7].pack(*[dicts[index][key] for index, key in places])

    def decode(data: bytes, at: int, dicts: list[Value]) -> int:
        packer = packers[at & 7]
        for (index, key), value in zip(places, packer.unpack_from(data, at), strict=True):
            dicts[index][key] = value
        return at + packer.size

    return encode, decode


def _field(place: _Place, put: _Put, get: _Get) -> tuple[_Encode, _Decode]:
    """The step of a field that is no plain number."""
    index, key = place

    def encode(out: bytearray, dicts: list[Value]) -> None:
        put(out, dicts[index][key])

    def decode(data: bytes, at: int, dicts: list[Value]) -> int:
        dicts[index][key], at = get(data, at)
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
    length, at = _get_count(data, at)
    end = at + length
    if end > len(data):
        raise IndexError(f"a string of {length} bytes ends beyond the message")
    return str(data[at : max(at, end - 1)], "utf-8"), end


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
