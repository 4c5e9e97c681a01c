"""Edits by the shape of a syntax tree: what fits, what a placeholder stands for, what comes out."""

import ast
from pathlib import Path

import pytest
import yaml

from proving.syntax import Edit, apply, fields, fits

CODE = """
def bounded(s, tick, low, high):
    if lost and s.fresh:
        send(s, tick)
        wait()
    s.goal = min(max(tick, low), high)
    first(1)
    second(2)
"""


EDITS = yaml.safe_load(Path(__file__).with_name("syntax.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("edit", EDITS, ids=lambda edit: str(edit["old"]))
def test_what_fits_once_is_replaced(edit: dict[str, str]) -> None:
    tree, change = ast.parse(CODE), Edit(edit["old"], edit["new"])
    assert fits(fields(tree), change) == 1
    apply(tree, change)
    assert edit["expected"] in ast.unparse(tree)


@pytest.mark.parametrize(
    "old", ["min(max(__t, __t), __high)", "first(__x)\nsecond(__x)", "__s.goal = 1", "if __a:\n    wait()"]
)
def test_what_differs_does_not_fit(old: str) -> None:
    assert fits(fields(ast.parse(CODE)), Edit(old, "")) == 0
