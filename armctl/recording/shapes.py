"""Shapes of messages: those of one type with the same texts and counts differ in their numbers alone.

Such messages are one `struct`, whose bytes between the numbers are known. templates.py writes them so, cdr.py reads
them so; what has another shape goes the way of the codec.
"""

import struct
from collections.abc import Callable, Iterator, Mapping
from operator import itemgetter
from typing import Any

from armctl.recording.schemas import MESSAGES, PRIMITIVES, Field, fields

HEADER = b"\x00\x01\x00\x00"
Value = dict[str, Any]
# The format of a number and what it is (`_items`); an empty format and the bytes of what lies between two numbers.
Piece = tuple[str, Any]
_TIME = "builtin_interfaces/Time"
_PLAIN = {*PRIMITIVES, "string"}


class Shape:
    """Messages of one type with the same texts and counts: one struct, and one expression that makes them.

    Args:
        name: Short name of the type.
        example: One of them.
        messages: Declarations of the types.
    """

    def __init__(self, name: str, example: Value, messages: Mapping[str, str]) -> None:
        found = pieces(name, example, messages)
        self._unpack = packer(found).unpack
        self._texts = itemgetter(*[place for place, (code, _) in enumerate(found) if not code])
        self._expected = self._texts([content for _, content in found])
        arguments = [f"_{place}" for place in range(len(found))]
        numbers = iter([name for name, (code, _) in zip(arguments, found, strict=True) if code])
        # Texts and names are written as Python writes them; names of fields have been checked (schemas.py).
        made = _expression(name, example, messages, numbers)
        self._make: Callable[..., Value] = eval(f"lambda {', '.join(arguments)}: {made}", {})

    def decode(self, data: bytes) -> Value | None:
        """The message in bytes of the example's size; None where it has another shape."""
        values = self._unpack(data)
        return self._make(*values) if self._texts(values) == self._expected else None


def packer(found: list[Piece]) -> struct.Struct:
    """What puts pieces together, and takes them apart."""
    return struct.Struct("<" + "".join(code or f"{len(content)}s" for code, content in found))


def pieces(name: str, example: Value, messages: Mapping[str, str] = MESSAGES) -> list[Piece]:
    """What messages of the example's shape consist of; the first and the last piece are bytes."""
    found: list[Piece] = [("", HEADER)]
    at = 0
    for alignment, size, code, content in _items(name, example, messages):
        constant = bytes(-at % alignment)
        at += len(constant) + size
        if not code:
            constant += content
        if constant:
            before = b"" if found[-1][0] else found.pop()[1]
            found.append(("", before + constant))
        if code:
            found.append((code, content))
    return [*found, ("", b"")]


def _items(name: str, value: Value, messages: Mapping[str, str]) -> Iterator[tuple[int, int, str, Any]]:
    """Alignment, size, struct format and content of everything in a message.

    The content is the bytes of what never changes, and of a number its name, if it is a part of a stamp.
    """
    for item in fields(name, messages):
        content = value[item.name]
        if item.is_array:
            yield 4, 4, "", struct.pack("<I", len(content))
        if item.is_array and item.type in ("byte", "uint8"):
            yield 1, len(content), f"{len(content)}s", ""
            continue
        for element in content if item.is_array else [content]:
            if item.type == "string":
                text = element.encode() + b"\0"
                yield 4, 4 + len(text), "", struct.pack("<I", len(text)) + text
            elif item.type in PRIMITIVES:
                code = PRIMITIVES[item.type]
                size = struct.calcsize(code)
                yield size, size, code, f"stamp.{item.name}" if name == _TIME else ""
            else:
                yield from _items(item.type, element, messages)


def _expression(name: str, example: Value, messages: Mapping[str, str], numbers: Iterator[str]) -> str:
    """A message as a Python expression, with what `numbers` gives in the place of each number."""

    def of(item: Field, element: Any) -> str:
        if item.type == "string":
            return repr(element)
        return next(numbers) if item.type in PRIMITIVES else _expression(item.type, element, messages, numbers)

    parts = []
    for item in fields(name, messages):
        content, listed = example[item.name], item.is_array and item.type not in ("byte", "uint8")
        made = f"[{', '.join(of(item, element) for element in content)}]" if listed else of(item, content)
        parts.append((item.is_array or item.type in _PLAIN, f"{item.name!r}: {made}"))
    parts.sort(key=itemgetter(0))  # messages come first, as the steps have it
    return f"{{{', '.join(part for _, part in parts)}}}"
