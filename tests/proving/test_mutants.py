"""Planted bugs: their edits fit, a few are caught, and what is not caught is told."""

import ast
import copy
import functools
from collections.abc import Iterator

import pytest

from proving import mutants
from proving.mutants import ROOT, Mutant, StaleMutant
from proving.planted import MUTANTS
from proving.syntax import Edit, Field, apply, fields, fits

QUICK = ("speed 0 is written", "torque-on without a soft limit")


class Renamed(ast.NodeTransformer):
    """Every name that a function binds becomes another one, in that function."""

    def visit_FunctionDef(self, node: ast.FunctionDef) -> ast.FunctionDef:
        stored = {n.id for n in ast.walk(node) if isinstance(n, ast.Name) and isinstance(n.ctx, ast.Store)}
        bound = stored | {n.arg for n in ast.walk(node) if isinstance(n, ast.arg)}
        for inner in ast.walk(node):
            if isinstance(inner, ast.Name) and inner.id in bound:
                inner.id += "_renamed"
            elif isinstance(inner, ast.arg):
                inner.arg += "_renamed"
        return node


Statements = list[tuple[ast.Module, list[Field]]]


@functools.cache
def statements(room: str) -> tuple[Statements, Statements]:
    """The outermost statements of a room of the package as they are, and with every local name another one."""

    def parsed() -> Iterator[ast.Module]:
        for path in sorted((ROOT / room).rglob("*.py")):
            yield from (ast.Module([node], []) for node in ast.parse(path.read_text()).body)

    renamed = map(Renamed().visit, parsed())
    return [(one, fields(one)) for one in parsed()], [(one, fields(one)) for one in renamed]


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_every_edit_fits_one_place_whatever_files_and_local_names_are_called(mutant: Mutant) -> None:
    for room in statements(mutant.room):
        for edit in mutant.edits:
            [tree] = [one for one, among in room for _ in range(fits(among, edit))]
            changed = copy.deepcopy(tree)
            apply(changed, edit)
            assert ast.dump(changed) != ast.dump(tree)


def test_there_are_enough_with_names_of_their_own_and_none_in_the_simulator() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 77
    assert not [mutant for mutant in MUTANTS if mutant.room.startswith("sim")]


def test_an_edit_that_no_longer_fits_is_an_error_before_anything_runs() -> None:
    stale = Mutant("stale", "control", (Edit("no_such_name = 1", ""),))
    with pytest.raises(StaleMutant, match="'no_such_name = 1' fits 0 places"):
        mutants.prove(mutants=(stale,))


def test_bugs_are_caught_and_what_the_soak_cannot_see_survives(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("PYTEST_ADDOPTS", "-k machine")  # of the unit tests, asked about a survivor
    monkeypatch.setattr(mutants, "ROUNDS", 0)
    chosen = [mutant for mutant in MUTANTS if mutant.name in QUICK]
    harmless = Mutant("no bug", "control", (Edit("IN_TIME = 0.9", "IN_TIME = 0.9 + 0.0"),))
    broken = Mutant("no program", "control", (Edit("__s.go(Trigger.ADOPT_LIMP)", "__s.no_such()"),))
    result = mutants.prove(1, episodes=1, mutants=(*chosen, harmless, broken))
    assert (result["runs"], result["caught"], result["survivors"]) == (4, 2, ["no bug", "no program"])
    assert result["tests"]["no bug"] == "nothing"
    assert "its edit does not run: " in result["tests"]["no program"]
    assert result["sound"] == ""
