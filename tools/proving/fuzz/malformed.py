"""Requests, configurations and names that are almost right, from one generator of random numbers.

Rules.
1. Everything begins as something valid. Changes follow at random places of its structure (a value of another type or
   beyond every bound, a key that is gone, doubled or unknown, depth), then perhaps of its text (cut, damaged, doubled).
2. A request stays one line, because its answers are counted.
3. The same generator gives the same texts.
"""

import json
import random
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.strict_yaml import MAX_YAML_BYTES

# dict, list, scalar, `Raw`, or `Pairs` where a key stands twice.
Tree = Any


@dataclass(frozen=True)
class Raw:
    """Text that stands in the document as it is."""

    text: str


class Pairs(list[tuple[str, Tree]]):
    """An object as its pairs."""


NUMBERS: tuple[Tree, ...] = (
    *(0, 1, -1, 2, 254, 255, 1023, 1024, 2**31, 2**53 + 1, 2**63 - 1, 2**63, 2**64, -(2**63) - 1, 10**40),
    *(0.5, -0.0, 1e-9, 1e308, -1e308, 5e-324, 3.0, 1e16),
    *map(Raw, ("1e999", "-1e999", "NaN", "Infinity", "-Infinity", "01", "1.", ".5", "+1", "0x1F", "1_000")),
    *map(Raw, ("9" * 400, "9" * 4400, "0." + "3" * 400, "1e-400", "1E+2", "-", "1e")),
)
TEXTS: tuple[str, ...] = (
    *("", " ", "a", "a\n", "\0", "\x1b[31m", "null", "true", "NaN", "2.0", "x" * 64, "x" * 65, "x" * 5000),
    *("../a", "/etc/passwd", "a/b", ".", "..", "a\0b", "C:\\a", "~", "$HOME", "%s%n", "-rf", "CON", "a.mcap.part"),
    *("\ud800", "\udfff\ud800", "é", "e\u0301", "\u202egpj", "\ufeff", "\u2028", "𝔘", "\U0010ffff", "\uffff"),
)
SCALARS: tuple[Tree, ...] = (None, True, False, Raw("nul"), Raw("True"), Raw("undefined"), Raw("'a'"), Raw(""))
YAML_WORDS = tuple(
    map(
        Raw,
        (
            *(".nan", ".inf", "-.INF", "1:30", "0o17", "0x1F", "yes", "No", "~", "1_000", "2024-01-01", "12e03"),
            *("=", "<<", "&a 1", "*a", "&a [*a]", "!!python/object:os.system 1", "!!binary aGk=", "!!set {a}", "!a b"),
            *("!!int 'x'", "!!float ''", "!!map []", "? a", "- a", "a: b: c", "| x", "> x", "%YAML 9.9", "@x", "#"),
        ),
    )
)  # fmt: skip
DEPTHS = (1, 2, 15, 16, 17, 40, 400, 12000)
# Of what grows; only `flood` is longer.
MOST_BYTES = 20000


def request_line(rng: random.Random, valid: Sequence[tuple[str, dict[str, Any]]], request_id: int) -> bytes:
    """One request, without the end of its line."""
    method, params = rng.choice(valid)
    tree: Tree = {"jsonrpc": "2.0", "id": request_id, "method": method, "params": params}
    for _ in range(rng.choice((0, 0, 0, 0, 1, 1, 2, 3))):  # what is valid leads into every state
        # Mostly within the parameters: a broken envelope never gets as far as a method.
        if rng.random() < 0.8:
            tree = {**tree, "params": changed(rng, tree["params"])} if isinstance(tree, dict) else tree
        else:
            tree = changed(rng, tree)
            break
    text = json_text(tree, ascii_only=rng.random() < 0.7)
    line = text.encode("utf-8", "surrogatepass")
    if rng.random() < 0.1:
        line = damaged(rng, line)
    return line.replace(b"\n", b" ")[: MAX_LINE_BYTES - 1]


def flood(rng: random.Random) -> bytes:
    """A line just around or far beyond the longest that is allowed."""
    length = MAX_LINE_BYTES + rng.choice((-1, 0, 1, 7, MAX_LINE_BYTES))
    return rng.choice((b"[", b"{", b'"', b"1", b" ", b'{"a":')) * length


def yaml_text(rng: random.Random, valid: Sequence[tuple[str, dict[str, Any]]]) -> tuple[str, str]:
    """What it began as, and a YAML text: in flow style changed by structure, or in block style by its text."""
    import yaml

    kind, tree = rng.choice(valid)
    if rng.random() < 0.6:
        for _ in range(rng.choice((0, 1, 1, 2, 3))):
            tree = changed(rng, tree, YAML_WORDS)
        text = json_text(tree, ascii_only=False)
    else:
        text = yaml.safe_dump(tree, sort_keys=False)
        for _ in range(rng.choice((1, 1, 2, 5))):
            lines = text.split("\n")
            at = rng.randrange(len(lines))
            word = rng.choice(YAML_WORDS).text
            lines[at] = rng.choice(
                (f"{lines[at]} {word}", word, "\t" + lines[at], lines[at] * 2, " " + lines[at], f"{word}: 1", "")
            )
            text = "\n".join(lines)
    if rng.random() < 0.15:
        text = damaged(rng, text.encode("utf-8", "surrogatepass")).decode("utf-8", rng.choice(("replace", "ignore")))
    if rng.random() < 0.002:
        word = rng.choice(("[", "- ", "{a: ", "a, ", "[1,1],", "? ", "'x' ", "a\n", "- a\n", "&a ", "!a "))
        text = word * ((MAX_YAML_BYTES - 10) // len(word))
    return kind, text


def name(rng: random.Random) -> str:
    """A recording's name, or what somebody would like to pass for one."""
    if rng.random() < 0.5:
        return rng.choice(TEXTS)
    alphabet = "aZ09._-" if rng.random() < 0.5 else "a0._-/\\\0\n\r\t :*?é\ud800\u202e𝔘~|"
    return "".join(rng.choices(alphabet, k=rng.choice((1, 2, 3, 8, 63, 64, 65, 300))))


def changed(rng: random.Random, tree: Tree, words: Sequence[Tree] = ()) -> Tree:
    """The tree with one change somewhere in it; `tree` itself stays as it is."""
    if isinstance(tree, dict) and tree and rng.random() < 0.75:
        key = rng.choice(list(tree))
        match rng.randrange(8):
            case 0:
                return {other: value for other, value in tree.items() if other != key}
            case 1:
                return {**tree, rng.choice(TEXTS): odd(rng, words)}
            case 2:
                return Pairs([*tree.items(), (key, rng.choice((tree[key], odd(rng, words))))])
            case 3:
                return {(rng.choice(TEXTS) if other == key else other): value for other, value in tree.items()}
            case _:
                return {**tree, key: changed(rng, tree[key], words)}
    if isinstance(tree, list | tuple) and tree and rng.random() < 0.8:
        at = rng.randrange(len(tree))
        match rng.randrange(6):
            case 0:
                return [*tree[:at], *tree[at + 1 :]]
            case 1:
                return [*tree[:at], *([tree[at]] * rng.choice((2, 7, 33, 300)))]
            case _:
                return [*tree[:at], changed(rng, tree[at], words), *tree[at + 1 :]]
    if isinstance(tree, int | float) and not isinstance(tree, bool) and rng.random() < 0.5:
        return rng.choice((-tree, tree + 1, tree * 1000, tree / 3, float(tree), str(tree), [tree], tree + 1e-12))
    if rng.random() < 0.1:
        return nested(rng, tree)
    return odd(rng, words)


def odd(rng: random.Random, words: Sequence[Tree] = ()) -> Tree:
    """A value that hardly anything expects."""
    pools: tuple[Sequence[Tree], ...] = (NUMBERS, TEXTS, SCALARS, *([words] * bool(words)))
    if rng.random() < 0.9:
        return rng.choice(rng.choice(pools))
    return rng.choice(([], {}, [[]], {"": {}}, [0.0] * 6, [1e308] * 6, [None] * 1000, {str(i): i for i in range(300)}))


def nested(rng: random.Random, tree: Tree) -> Raw:
    """The tree deep inside of arrays or objects, not always closed."""
    depth = rng.choice(DEPTHS)
    begin, end = rng.choice((("[", "]"), ('{"a":', "}"), ("[[", "]]")))
    closed = rng.random() < 0.8
    inner = json_text(tree)
    depth = min(depth, max(1, (MOST_BYTES - len(inner)) // (len(begin) + len(end))))
    return Raw(begin * depth + inner + end * depth * closed)


def json_text(tree: Tree, ascii_only: bool = True) -> str:
    """JSON as it is told to be, valid or not."""
    if isinstance(tree, Raw):
        return tree.text
    if isinstance(tree, Pairs):
        return "{" + ",".join(f"{json.dumps(k)}:{json_text(v, ascii_only)}" for k, v in tree) + "}"
    if isinstance(tree, dict):
        # A blank after the colon: flow-style YAML wants it.
        pairs = (f"{json.dumps(k, ensure_ascii=ascii_only)}: {json_text(v, ascii_only)}" for k, v in tree.items())
        return "{" + ", ".join(pairs) + "}"
    if isinstance(tree, list | tuple):
        return "[" + ", ".join(json_text(value, ascii_only) for value in tree) + "]"
    return json.dumps(tree, ensure_ascii=ascii_only)


def damaged(rng: random.Random, data: bytes) -> bytes:
    """The bytes cut off, or with some of them changed, lost, doubled or foreign."""
    for _ in range(rng.choice((1, 1, 2, 4))):
        at = rng.randrange(len(data) + 1)
        match rng.randrange(6):
            case 0:
                data = data[:at]
            case 1:
                data = data[:at] + bytes((rng.randrange(256),)) + data[at + 1 :]
            case 2:
                data = (
                    data[:at] + rng.choice((b"\0", b"\xff\xfe", b"\xed\xa0\x80", b"\r", b'"', b"}", b",")) + data[at:]
                )
            case 3:
                data = data[:at] + data[at + rng.randrange(20) :]
            case 4:
                data = data[:at] + data[max(0, at - 40) : at] * 2 + data[at:]
            case _:
                data = data + data[:at]
    return data[:MOST_BYTES]
