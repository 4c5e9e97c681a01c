"""Edits by the shape of a syntax tree: what fits, what a placeholder stands for, what comes out."""

import ast

import pytest

from proving.syntax import Edit, apply, fits

CODE = """
def bounded(s, tick, low, high):
    if lost and s.fresh:
        send(s, tick)
        wait()
    s.goal = min(max(tick, low), high)
    first(1)
    second(2)
"""


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("min(max(__t, __low), __high)", "__t", "s.goal = tick"),
        (
            "if __a and __s.fresh:\n    ...",
            "if __s.fresh:\n    ...",
            "if s.fresh:\n        send(s, tick)\n        wait()",
        ),
        ("first(__x)\nsecond(__y)", "second(__y)", "    second(2)"),
        ("__s.goal = __value", "", "pass"),
        ("__s.__field = min(__a, __b)", "__s.__field = __b", "s.goal = high"),
        ("__f(1)", "__f(0)", "first(0)"),
    ],
)
def test_what_fits_once_is_replaced(old: str, new: str, expected: str) -> None:
    tree, edit = ast.parse(CODE), Edit(old, new)
    assert fits(tree, edit) == 1
    apply(tree, edit)
    assert expected in ast.unparse(tree)


@pytest.mark.parametrize(
    "old", ["min(max(__t, __t), __high)", "first(__x)\nsecond(__x)", "__s.goal = 1", "if __a:\n    wait()"]
)
def test_what_differs_does_not_fit(old: str) -> None:
    assert fits(ast.parse(CODE), Edit(old, "")) == 0
