"""The way of one tick through the rooms of the house: few files, and few changes from one room to another."""

import sys
from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from types import FrameType

import armctl
from armctl.messages import Mode, Run
from tests.control.test_loop import Rig, holding

PACKAGE = Path(armctl.__file__).parent
FILES = 12
# Between two rooms; a return counts as well. A reading of the clock by the bus is two.
CHANGES = 60


@dataclass(frozen=True)
class Event:
    """One call of a Python function of the package, or its return."""

    kind: str
    file: str
    function: str

    @property
    def room(self) -> str:
        """A folder of the package, or a module at its root."""
        return self.file.split("/")[0]


def traced_tick(rig: Rig) -> list[Event]:
    """Every event of one tick in its order. The simulator, and whatever it calls, is left out."""
    path: list[Event] = []
    simulated = 0

    def see(frame: FrameType, kind: str, _argument: object) -> None:
        nonlocal simulated
        code = frame.f_code
        if kind not in ("call", "return") or not code.co_filename.startswith(f"{PACKAGE}/"):
            return
        event = Event(kind, code.co_filename.removeprefix(f"{PACKAGE}/"), code.co_qualname)
        if event.room == "sim":
            simulated += 1 if kind == "call" else -1
        elif not simulated:
            path.append(event)

    sys.setprofile(see)
    try:
        rig.loop.tick(())
    finally:
        sys.setprofile(None)
    return path


def told(path: list[Event]) -> str:
    """The path for a person: each stay in a room, and how often each pair of rooms followed each other."""
    stays: list[str] = []
    for before, event in pairwise([None, *path]):
        assert event is not None
        if before is None or before.room != event.room:
            stays.append(f"{event.room}: {event.function}")
        elif event.kind == "call":
            stays[-1] += f", {event.function.split('.')[-1]}"
    pairs = Counter((a.room, b.room) for a, b in pairwise(path) if a.room != b.room)
    return "\n".join([*stays, *(f"{often} x {a} -> {b}" for (a, b), often in pairs.most_common())])


def test_a_moving_tick_goes_through_few_files_and_few_rooms() -> None:
    rig = holding()
    rig.ticks(15, Run(2, rig.line()))
    path = traced_tick(rig)
    assert rig.mode() is Mode.MOVING
    files = sorted({event.file for event in path})
    changes = sum(a.room != b.room for a, b in pairwise(path))
    assert len(files) <= FILES, f"{len(files)} files: {', '.join(files)}\n{told(path)}"
    assert changes <= CHANGES, f"{changes} changes of room\n{told(path)}"
