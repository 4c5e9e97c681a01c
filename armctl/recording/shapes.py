"""Shapes of messages: those of one type with the same texts and counts differ in their numbers alone.

Such messages are one `struct`, whose bytes between the numbers are known, and Python expressions that put the numbers
into bytes and make a message of them. A codec (cdr.py) keeps the shapes that it reads, and who encodes what comes every
tick (channels.py) those of its rows: nearly all messages of a log have one that came before, and take a tenth of the
time then.
"""

import struct
from collections.abc import Callable, Mapping, Sequence
from operator import itemgetter
from typing import Any, NamedTuple

from armctl.recording.schemas import PRIMITIVES, fields

HEADER = b"\x00\x01\x00\x00"
Value = dict[str, Any]
# Bounds of what is worth it: so many parts, and so many bytes for each one that is the same, as those of texts are.
MAX_PARTS, MAX_SAME = 256, 1.5


class Shape(NamedTuple):
    """Messages of one type with the same texts and counts."""

    # None for a message of another shape.
    decode: Callable[[bytes], Value | None]
    # Bytes of a message's numbers in order, a uint8[] being one of them, of bytes; trusted to be of this shape.
    pack: Callable[[Sequence[Any]], bytes]


def shape(name: str, example: Value, messages: Mapping[str, str]) -> Shape | None:
    """The shape of a message; None where it is too long, or mostly text.

    Args:
        name: Short name of its type.
        messages: Declarations of the types.
    """
    walk = _Walk(messages)
    made = walk.message(name, example)
    walk.end()
    packer = struct.Struct(walk.format)
    if len(walk.packed) > MAX_PARTS or packer.size <= walk.same_bytes * MAX_SAME:
        return None
    known = {"pack": packer.pack, "unpack": packer.unpack}
    fits = " and ".join([f"len(data) == {packer.size}", "(v := unpack(data))", *walk.expected])
    decode, pack = f"lambda data: {made} if {fits} else None", f"lambda s: pack({', '.join(walk.packed)})"
    # Texts and names are written as Python writes them; names of fields have been checked (schemas.py).
    return Shape(eval(decode, known), eval(pack, known))


class _Walk:
    """One way through a message: the format of its bytes, and expressions about `v`, what its bytes are unpacked to,
    and `s`, its numbers.
    """

    def __init__(self, messages: Mapping[str, str]) -> None:
        self.format, self.same_bytes = "<", 0
        # What is packed; what holds of the bytes of every message of the shape.
        self.packed: list[str] = []
        self.expected: list[str] = []
        self._messages = messages
        # How many bytes there are, the last ones that are the same in every message, how many values, and numbers.
        self._at, self._same, self._values, self._numbers = -len(HEADER), b"", 0, 0
        self._add_same(HEADER, 1)

    def message(self, name: str, value: Value) -> str:
        """Walk through a message; how such a one is made, with the messages in it first, as the codec has it."""
        made = []
        for item in fields(name, self._messages):
            walk = self._list if item.is_array else self._one
            part = f"{item.name!r}: {walk(item.type, value[item.name])}"
            made.append((item.is_array or item.type in PRIMITIVES or item.type == "string", part))
        return f"{{{', '.join(part for _, part in sorted(made, key=itemgetter(0)))}}}"

    def end(self) -> None:
        """What comes next is not the same in every message."""
        if self._same:
            same = repr(self._same)
            self.expected.append(f"v[{self._values}] == {same}")
            self.format += f"{len(self._same)}s"
            self.packed.append(same)
            self._same = b""
            self._values += 1

    def _one(self, kind: str, content: Any) -> str:
        if kind in PRIMITIVES:
            return f"v[{self._add(PRIMITIVES[kind], 1)}]"
        if kind != "string":
            return self.message(kind, content)
        data = content.encode() + b"\0"
        self._add_same(struct.pack("<I", len(data)) + data, 4)
        return repr(data[:-1].decode())

    def _list(self, kind: str, content: Any) -> str:
        count = len(content)
        self._add_same(struct.pack("<I", count), 4)
        if kind in ("byte", "uint8"):
            return f"v[{self._add(f'{count}s', 1)}]"
        if kind not in PRIMITIVES:
            return f"[{', '.join(self._one(kind, one) for one in content)}]"
        first = self._add(PRIMITIVES[kind], count) if count else 0
        return f"[*v[{first}:{first + count}]]"

    def _add_same(self, data: bytes, alignment: int) -> None:
        data = bytes(-self._at % alignment) + data
        self._same, self._at, self.same_bytes = self._same + data, self._at + len(data), self.same_bytes + len(data)

    def _add(self, code: str, count: int) -> int:
        """Numbers of one format behind what there is; the place of the first one among the values."""
        size = struct.calcsize(code)
        self._add_same(b"", 1 if code.endswith("s") else size)
        self.end()
        self._at += size * count
        self.format += code if count == 1 else f"{count}{code}"
        self.packed.append(f"s[{self._numbers}]" if count == 1 else f"*s[{self._numbers}:{self._numbers + count}]")
        self._values, self._numbers = self._values + count, self._numbers + count
        return self._values - count
