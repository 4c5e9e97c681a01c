"""Does the soak notice? Bugs planted one at a time in a copy of the package, each run through short soak episodes.

A mutant is an edit of the syntax tree, see `syntax.py`; `planted.py` lists them. It counts as caught when the judge of
`invariants.py` reports a violation in a scene or an episode that the sound copy, which is played first, plays without
one. Only what survives is also given to the unit tests of the control package, which is told beside it and does not
count. A bug in what is logged or replayed moves no arm: it counts as caught when the tests that it names fail. A
pattern that no longer fits one place is an error, so that mutants do not rot. None is in the simulator, nor in
`proving`.
"""

import ast
import concurrent.futures
import json
import os
import shutil
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armctl.errors import ArmctlError
from proving.scenes import SCENES, SCENES_FROM, named
from proving.syntax import Edit, apply, fields, fits

SEED = 1
# At most so many for each mutant, until one fails, behind every scene in so many drawings.
EPISODES = 8
ROUNDS = 3
TIMEOUT_S = 240.0
# A program that ends with one of these was not changed as the mutant's name says, but broken.
NO_BUG = ("crash: AttributeError", "crash: NameError")
TOOLS = Path(__file__).resolve().parents[1]
ROOT = TOOLS.parent / "armctl"


@dataclass(frozen=True, slots=True)
class Mutant:
    """One planted bug."""

    name: str
    # The folder of the package, or the module at its root, in which it is looked for.
    room: str
    # Each fits one place of the room.
    edits: tuple[Edit, ...]
    # The tests that are to notice it, where no episode can.
    tests: str = ""


class StaleMutant(ArmctlError):
    """A mutant one of whose patterns fits nowhere any more, or at several places."""

    def __init__(self, mutant: Mutant, old: str, count: int) -> None:
        where = f"{old!r} fits {count} places in {mutant.room}, not one"
        super().__init__(f"mutant {mutant.name!r}: {where}; bring its pattern up to date")


# CPython counts the depth of all syntax trees that are being built as one: two threads at it end in a SystemError.
_parsing = threading.Lock()


def plant(mutant: Mutant, package: Path) -> set[Path]:
    """Put the bug into a copy of the package; which files have changed.

    Raises:
        StaleMutant: a pattern does not fit, or fits more than once.
    """
    room = package / mutant.room
    trees = {path: ast.parse(path.read_text(encoding="utf-8")) for path in sorted(room.rglob("*.py"))}
    changed: set[Path] = set()
    for edit in mutant.edits:
        counts = {path: fits(fields(tree), edit) for path, tree in trees.items()}
        if sum(counts.values()) != 1:
            raise StaleMutant(mutant, edit.old, sum(counts.values()))
        [path] = [path for path, count in counts.items() if count]
        apply(trees[path], edit)
        changed.add(path)
    for path in changed:
        path.write_text(ast.unparse(trees[path]) + "\n", encoding="utf-8")
    return changed


@dataclass(frozen=True, slots=True)
class Result:
    """What the soak said of one copy."""

    name: str
    # Empty: it noticed nothing.
    violation: str
    seconds: float
    # What the unit tests said of a survivor.
    tests: str = ""


def check(mutant: Mutant) -> None:
    """See whether a mutant can be planted.

    Raises:
        StaleMutant: it cannot.
    """
    with tempfile.TemporaryDirectory(prefix="armctl-mutant-") as folder:
        shutil.copytree(ROOT / mutant.room, Path(folder) / mutant.room)
        plant(mutant, Path(folder))


def numbers(episodes: int) -> list[int]:
    """What is played, and in which order: scenes are short, and each is drawn for one kind of bug."""
    return [*range(SCENES_FROM, SCENES_FROM + ROUNDS * len(SCENES)), *range(episodes)]


def judge(mutant: Mutant | None, seed: int, played: Sequence[int]) -> tuple[Result, list[int]]:
    """Play episodes on a copy with the mutant planted, until one fails; on a sound one (None) all.

    Returns:
        Also which ones failed.
    """
    begin_s = time.monotonic()
    name = "none" if mutant is None else mutant.name
    with tempfile.TemporaryDirectory(prefix="armctl-mutant-") as folder:
        shutil.copytree(ROOT, Path(folder) / "armctl", ignore=shutil.ignore_patterns("__pycache__"))
        if (calibration := ROOT.parent / "calibration").is_dir():
            shutil.copytree(calibration, Path(folder) / "calibration")
        if mutant is not None:
            with _parsing:
                plant(mutant, Path(folder) / "armctl")
        asked = "" if mutant is None else mutant.tests
        found = [] if asked else _soak(folder, seed, played, mutant is None)
        tests = "" if found or mutant is None else _unit_tests(folder, asked or "tests/control")
    violation = found[0][1] if found else ""
    if any(error in violation for error in NO_BUG):
        violation, tests = "", f"its edit does not run: {violation}"
    if asked and tests == "caught":
        violation, tests = f"{asked} fails", ""
    return Result(name, violation, time.monotonic() - begin_s, tests), [number for number, _ in found]


def _soak(folder: str, seed: int, played: Sequence[int], every: bool) -> list[tuple[int, str]]:
    command = [sys.executable, "-m", "proving.mutants", str(seed), json.dumps(list(played)), str(int(every))]
    try:
        done = subprocess.run(
            command,
            cwd=folder,
            env=_environment(folder),
            capture_output=True,
            text=True,
            timeout=TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return []
    if done.returncode:
        raise ArmctlError(f"the episodes of a mutant ended with {done.returncode}: {done.stderr[-500:]}")
    return [(number, text) for number, text in json.loads(done.stdout)["violations"]]


def _unit_tests(folder: str, which: str = "tests/control") -> str:
    """What the package's own tests say; they lie beside the package, where it is not installed."""
    tests = ROOT.parent / "tests"
    if not tests.is_dir():
        return "none here"
    shutil.copytree(tests, Path(folder) / "tests", ignore=shutil.ignore_patterns("__pycache__"))
    command = [sys.executable, "-m", "pytest", "-q", "-x", "-p", "no:cacheprovider", which]
    done = subprocess.run(command, cwd=folder, env=_environment(folder), capture_output=True, check=False)
    return "caught" if done.returncode == 1 else "nothing" if done.returncode == 0 else "did not run"


def _environment(folder: str) -> dict[str, str]:
    return os.environ | {"PYTHONPATH": os.pathsep.join((folder, str(TOOLS))), "PYTHONDONTWRITEBYTECODE": "1"}


def prove(
    seed: int = SEED,
    *,
    workers: int = 2,
    episodes: int = EPISODES,
    mutants: Sequence[Mutant] | None = None,
    tell: Callable[[str], None] = lambda line: None,
) -> dict[str, Any]:
    """Plant every mutant in turn.

    Raises:
        StaleMutant: a pattern does not fit any more; told before anything runs.
    """
    from proving.planted import MUTANTS  # which are Mutants

    mutants = MUTANTS if mutants is None else mutants
    for mutant in mutants:
        check(mutant)
    begin_s = time.monotonic()
    results: list[Result] = []
    with concurrent.futures.ThreadPoolExecutor(workers) as pool:
        played = numbers(episodes)
        sound = list(pool.map(lambda k: judge(None, seed, played[k::workers]), range(workers)))
        unfit = [number for _, failed in sound for number in failed]
        violation = "; ".join(result.violation for result, _ in sound if result.violation)
        if violation:
            tell(f"the sound copy fails as well, so {len(unfit)} of {len(played)} episodes prove nothing: {violation}")
        played = [number for number in played if number not in unfit]
        waiting = [pool.submit(judge, mutant, seed, played) for mutant in mutants]
        for future in concurrent.futures.as_completed(waiting):
            result, _ = future.result()
            results.append(result)
            said = result.violation or f"NOTHING; unit tests: {result.tests}"
            tell(f"{len(results)} of {len(mutants)}, {result.seconds:.0f} s: {result.name}: {said}")
    survivors = [result for result in results if not result.violation]
    return {
        "runs": len(results),
        "caught": len(results) - len(survivors),
        "survivors": sorted(result.name for result in survivors),
        "tests": {result.name: result.tests for result in survivors},
        "violations": int(bool(violation)) + len(survivors),
        "sound": violation,
        "seconds": round(time.monotonic() - begin_s, 1),
        "mutants": [
            {"name": result.name, "violation": result.violation, "seconds": round(result.seconds, 1)}
            for result in sorted(results, key=lambda result: result.name)
        ],
        "seed": seed,
    }


def main(seed: int, played: Sequence[int], every: bool) -> None:
    """The first violation of some episodes, or of every one that has any, as JSON: what runs inside a copy."""
    import logging

    from proving.episode import Episode
    from proving.soak import drawn_by

    logging.disable(logging.CRITICAL)
    violations = []
    for number in played:
        on, story = drawn_by(seed, number)
        found = Episode(story, on).play().violations
        if found:
            where = named(number) or f"episode {number}"
            violations.append((number, f"{where}, invariant {found[0].invariant}: {found[0].text}"))
            if not every:
                break
    sys.stdout.write(json.dumps({"violations": violations}))


if __name__ == "__main__":
    main(int(sys.argv[1]), json.loads(sys.argv[2]), sys.argv[3] == "1")
