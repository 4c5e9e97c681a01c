"""Edits of Python source by the shape of its syntax tree: names of files, layout and local names do not matter.

A pattern is Python. In it a name that begins with two underscores stands for anything of its kind, the same thing
wherever it comes again: an expression (`__goal`), an attribute (`s.__field`), a keyword, the name of a function. The
statement `...` stands for any run of statements. A pattern of one expression fits an expression; one of several
statements fits those statements in a row. The replacement may use what the pattern found.
"""

import ast
import copy
import functools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

# A field of a node that holds an expression, or a list.
Field = tuple[ast.AST, str, ast.expr | list[Any]]
# What each placeholder of a pattern stands for: a node, a run of statements, or a name.
Found = dict[str, object]
IGNORED = frozenset({"ctx", "type_comment", "kind", "lineno", "col_offset", "end_lineno", "end_col_offset"})


@dataclass(frozen=True, slots=True)
class Edit:
    """Replace what fits `old` by `new`; an empty `new` leaves statements out."""

    old: str
    new: str


@dataclass(frozen=True, slots=True)
class _Place:
    """Where a pattern fits: `count` items of a list, or one field, of `parent`."""

    parent: ast.AST
    field: str
    index: int | None
    count: int
    found: Found


def fields(tree: ast.Module) -> list[Field]:
    """What of a module an edit may fit."""
    return [
        (parent, name, value)
        for parent in ast.walk(tree)
        for name, value in ast.iter_fields(parent)
        if isinstance(value, ast.expr) or (isinstance(value, list) and value)
    ]


def fits(among: list[Field], edit: Edit) -> int:
    """At how many places of a module, of which these are the fields, an edit fits."""
    return sum(1 for _ in _places(among, edit))


def apply(tree: ast.Module, edit: Edit) -> None:
    """Carry out an edit at the first place that it fits."""
    place = next(_places(fields(tree), edit))
    new = [_Fill(place.found).visit(node) for node in ast.parse(edit.new).body]
    statements = _statements(edit.old) is not None
    if statements:
        filled: list[ast.AST] = []
        for node in new:
            run = place.found.get("...") if _is_dots(node) else None
            filled += run if isinstance(run, list) else [node]
        assert place.index is not None
        getattr(place.parent, place.field)[place.index : place.index + place.count] = filled or [ast.Pass()]
    else:
        [node] = new
        assert isinstance(node, ast.Expr), "an expression is replaced by an expression"
        if place.index is None:
            setattr(place.parent, place.field, node.value)
        else:
            getattr(place.parent, place.field)[place.index] = node.value
    ast.fix_missing_locations(tree)


@functools.cache
def _expression(old: str) -> ast.expr:
    return ast.parse(old, mode="eval").body


@functools.cache
def _statements(old: str) -> list[ast.stmt] | None:
    """The statements of a pattern; None where it is one expression."""
    body = ast.parse(old).body
    return None if len(body) == 1 and isinstance(body[0], ast.Expr) else body


def _places(among: list[Field], edit: Edit) -> Iterator[_Place]:
    statements = _statements(edit.old)
    for parent, field, value in among:
        if statements is None:
            yield from _expressions(parent, field, value, _expression(edit.old))
        elif isinstance(value, list) and isinstance(value[0], ast.stmt):
            yield from _runs(parent, field, value, statements)


def _expressions(parent: ast.AST, field: str, value: object, wanted: ast.expr) -> Iterator[_Place]:
    """Every place of a field at which the wanted expression stands."""
    items = enumerate(value) if isinstance(value, list) else [(None, value)]
    for index, item in items:
        found: Found = {}
        if isinstance(item, ast.expr) and _same(wanted, item, found):
            yield _Place(parent, field, index, 1, found)


def _runs(parent: ast.AST, field: str, body: list[ast.stmt], wanted: list[ast.stmt]) -> Iterator[_Place]:
    """Every place of a list of statements at which the wanted ones stand in a row."""
    for begin in range(len(body) - len(wanted) + 1):
        found: Found = {}
        if all(_same(want, have, found) for want, have in zip(wanted, body[begin:], strict=False)):
            yield _Place(parent, field, begin, len(wanted), found)


def _is_placeholder(name: object) -> bool:
    return isinstance(name, str) and name.startswith("__") and not name.endswith("__")


def _is_dots(node: object) -> bool:
    return isinstance(node, ast.Expr) and isinstance(node.value, ast.Constant) and node.value.value is ...


def _bound(name: str, value: object, found: Found) -> bool:
    """Whether a placeholder may stand for a value: it stands for no other."""
    if name in found:
        return _text(found[name]) == _text(value)
    found[name] = value
    return True


def _text(value: object) -> str:
    return ast.unparse(value) if isinstance(value, ast.AST) else repr(value)  # whether read or assigned to


def _same(want: object, have: object, found: Found) -> bool:
    """Whether a part of a pattern fits a part of a tree; fills in what its placeholders stand for."""
    if isinstance(want, ast.Name) and _is_placeholder(want.id):
        return isinstance(have, ast.expr) and _bound(want.id, have, found)
    if _is_placeholder(want):
        return isinstance(have, str) and _bound(str(want), have, found)
    if isinstance(want, list):
        return isinstance(have, list) and _same_list(want, have, found)
    if not isinstance(want, ast.AST):
        return type(want) is type(have) and want == have
    return type(want) is type(have) and all(
        _same(value, getattr(have, field, None), found)
        for field, value in ast.iter_fields(want)
        if field not in IGNORED
    )


def _same_list(want: list[object], have: list[object], found: Found) -> bool:
    if len(want) and _is_dots(want[-1]):  # the rest, whatever it is
        found["..."] = have[len(want) - 1 :]
        want, have = want[:-1], have[: len(want) - 1]
    return len(want) == len(have) and all(_same(a, b, found) for a, b in zip(want, have, strict=True))


class _Fill(ast.NodeTransformer):
    """Puts what was found in the place of the placeholders."""

    def __init__(self, found: Found) -> None:
        self._found = found

    def generic_visit(self, node: ast.AST) -> ast.AST:
        super().generic_visit(node)
        for field, value in ast.iter_fields(node):
            if field != "id" and _is_placeholder(value):
                setattr(node, field, self._found[value])
            elif isinstance(value, list) and any(_is_dots(item) for item in value):
                run = self._found["..."]
                assert isinstance(run, list)
                at = next(i for i, item in enumerate(value) if _is_dots(item))
                value[at : at + 1] = copy.deepcopy(run)
        return node

    def visit_Name(self, node: ast.Name) -> ast.AST:
        found = self._found.get(node.id)
        return copy.deepcopy(found) if isinstance(found, ast.AST) else node
