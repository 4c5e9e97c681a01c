"""Planted bugs: their patches fit, a few are caught, and what is not caught is told."""

from __future__ import annotations

import shutil
from pathlib import Path

import pytest

from proving import mutants
from proving.mutants import MUTANTS, ROOT, Mutant, StaleMutant

QUICK = ("speed 0 is written", "torque-on without a soft limit")


@pytest.mark.parametrize("mutant", MUTANTS, ids=lambda mutant: mutant.name)
def test_every_patch_fits_and_leaves_a_module_that_compiles(mutant: Mutant, tmp_path: Path) -> None:
    copy = tmp_path / mutant.file
    copy.parent.mkdir(parents=True)
    shutil.copy(ROOT / mutant.file, copy)
    mutants.plant(mutant, tmp_path)
    text = copy.read_text(encoding="utf-8")
    assert text != (ROOT / mutant.file).read_text(encoding="utf-8")
    compile(text, mutant.file, "exec")


def test_there_are_enough_with_names_of_their_own_and_none_in_the_simulator() -> None:
    assert len({mutant.name for mutant in MUTANTS}) == len(MUTANTS) >= 30
    assert not [mutant for mutant in MUTANTS if mutant.file.startswith(("sim/", "proving/"))]


def test_a_patch_that_no_longer_fits_is_an_error_before_anything_runs() -> None:
    stale = Mutant("stale", "control/tick.py", (("no such text", ""),))
    with pytest.raises(StaleMutant, match="'no such text' stands 0 times"):
        mutants.prove(mutants=(stale,))


def test_bugs_are_caught_and_what_the_soak_cannot_see_survives() -> None:
    chosen = [mutant for mutant in MUTANTS if mutant.name in QUICK]
    harmless = Mutant("a comment", "control/tick.py", (("clamped = min(", "clamped = 0 + min("),))
    result = mutants.prove(1, episodes=1, mutants=(*chosen, harmless))
    assert (result["runs"], result["caught"], result["survivors"]) == (3, 2, ["a comment"])
    assert result["tests"] == {"a comment": "nothing"}
    assert result["sound"] == ""
