"""When a take begins and ends: the tool followed through snapshots."""

import math
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

import pytest

from armctl import client
from armctl.cli.output import Output
from armctl.cli.teach import Tool
from armctl.client import Client
from armctl.errors import LogError, RequestRefused
from armctl.sim import control
from armctl.sim.hand import Guided
from tests.cli.conftest import Answer, StandIn, Typed
from tests.words import missing

Place = tuple[float, float, float]
START: Place = (0.18, -0.12, 0.1)


class Snapshots:
    """A watcher that has seen the tool at these places; ends like a daemon whose teaching ended."""

    def __init__(self, places: list[Place], limit_m_s: float) -> None:
        self.left = len(places)
        self._places = places
        self._same = {"fault": None, "period_s": 0.1, "tool_speed_limit_m_s": limit_m_s}

    def subscribe(self) -> Iterator[dict[str, Any]]:
        for before, place in pairwise([self._places[0], *self._places]):
            self.left -= 1
            tool = {"position_m": list(place), "speed_m_s": math.dist(place, before) / 0.1}
            yield {**self._same, "state": "teaching", "tool": tool}
        yield {**self._same, "state": "off", "tool": None}


def follow(places: list[Place], keys: str = "", limit_m_s: float = 0.25) -> tuple[Tool, Snapshots]:
    """A tool at these places; `keys` is what was pressed in each tick, `.` for nothing."""
    snapshots = Snapshots(places, limit_m_s)
    pressed = iter(keys.ljust(len(places), "."))
    return Tool(Output(), cast("Client", snapshots), lambda: next(pressed).strip(".")), snapshots


def rest(place: Place, ticks: int) -> list[Place]:
    return [place] * ticks


def way(a: Place, b: Place, ticks: int) -> list[Place]:
    return [(a[0], a[1] + (b[1] - a[1]) * k / ticks, a[2]) for k in range(1, ticks + 1)]


END: Place = (0.18, 0.12, 0.1)


@pytest.mark.parametrize(("named", "ticks"), [(START, 36), (None, 20)])
def test_a_take_begins_once_the_tool_rests_at_its_start_or_where_it_was_moved(named: Place | None, ticks: int) -> None:
    tool, snapshots = follow(rest(END, 20) + way(END, START, 20) + rest(START, ticks))
    assert tool.settle(named) == START
    assert snapshots.left == ticks - 4  # half a second, the arrival included


def test_resting_elsewhere_begins_nothing() -> None:
    tool, _ = follow(rest(END, 50))
    with pytest.raises(RequestRefused, match="teaching ended"):
        tool.settle(START)


def test_a_take_ends_when_the_tool_rests_after_it_went_along() -> None:
    tool, snapshots = follow(rest(START, 25) + way(START, END, 40) + rest(END, 15))
    tool.guided(START, lambda: None)
    assert 3 <= snapshots.left <= 7


@pytest.mark.parametrize(
    ("limit_m_s", "said", "times"), [(0.25, "slower than 250", 1), (0.1, "slower than 100", 1), (2.0, "slower than", 0)]
)
def test_only_a_hand_faster_than_the_arm_s_limit_is_warned_and_once(
    capsys: pytest.CaptureFixture[str], limit_m_s: float, said: str, times: int
) -> None:
    there, back = way(START, END, 4), way(END, START, 4)
    tool, _ = follow(rest(START, 5) + there + back + there + rest(END, 12), limit_m_s=limit_m_s)
    tool.guided(START, lambda: None)
    assert capsys.readouterr().out.count(said) == times


MIDDLE: Place = (0.18, 0.0, 0.1)


def marked(places: list[Place], keys: str = "") -> tuple[list[int], Place]:
    """How many ticks were left at each mark, and where the take ended."""
    tool, snapshots = follow(places, keys)
    marks: list[int] = []
    return marks, tool.guided(START, lambda: marks.append(snapshots.left))


def test_a_dwell_on_the_way_marks_one_via_point_and_does_not_end_the_take() -> None:
    places = rest(START, 5) + way(START, MIDDLE, 20) + rest(MIDDLE, 7) + way(MIDDLE, END, 20) + rest(END, 15)
    (first, _), end = marked(places)  # the second one where it came to rest for good
    assert first == 38  # half a second after the arrival
    assert end == END


def test_a_key_marks_a_via_point_where_the_tool_is_and_enter_ends_the_take() -> None:
    places = rest(START, 5) + way(START, END, 40)
    assert marked(places, "." * 20 + "v" + "." * 9 + "\n") == ([24], places[30])


def test_what_a_hand_does_is_told_as_it_goes(monkeypatch: pytest.MonkeyPatch) -> None:
    said: list[str] = []
    monkeypatch.setattr(Output, "live", lambda _, text: said.append(text))
    places = rest(END, 2) + way(END, START, 10) + rest(START, 6) + way(START, END, 20) + rest(END, 11)
    tool, _ = follow(places)
    tool._line = START, END
    tool.guided(tool.settle(START), lambda: None)
    told = [text for text in said if text]
    assert told[0] == "tool 180, 120, 100 mm  0 mm/s  from the start 240 mm"
    assert told[15] == "tool 180, -120, 100 mm  0 mm/s  from the start 0 mm"
    assert told[27].endswith("from the start 120 mm  off the line 0 mm  covered 50%")
    assert told[-1].endswith("from the start 240 mm  off the line 0 mm  covered 100%")


class FullDisk(StandIn):
    """A daemon that has made the arm limp, and cannot record."""

    def call(self, method: str, **_: object) -> dict[str, Any]:
        return {"recordings": []}

    def subscribe(self, *_: object, **__: object) -> Iterator[dict[str, Any]]:
        raise LogError("take f2: cannot be recorded now: NO_SPACE")


def test_whatever_ends_a_teaching_the_limp_arm_is_told(typed: Typed, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Client", FullDisk)
    told = typed("teach", "f2", "--yes", status=1).err
    assert not missing(told, "NO_SPACE", "next: the arm stays limp, so support it;", "`armctl torque on`")


GUIDED = Guided(1e-9, 0.0, 1e-9)


class NoHand:
    """A simulator whose hand is done at once."""

    def __init__(self, _: object) -> None: ...

    def __enter__(self) -> "NoHand":
        return self

    def __exit__(self, *_: object) -> None: ...

    def let_go(self) -> None: ...

    def guide(self, *_: object, seed: int) -> Guided:
        return GUIDED


@pytest.mark.usefixtures("own_folders")
def test_a_hand_that_nobody_records_is_told_to_a_person_and_leads_the_arm_all_the_same(
    typed: Typed, answer: Answer, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(control, "SimulatorClient", NoHand)
    told = typed("hand", "--socket", tmp_path / "none.sock").err.replace("\n", " ")
    wanted = "warning: nobody records where the hand leads the arm: no daemon answers on"
    assert not missing(told, wanted, str(tmp_path / "none.sock"), "start it with `armctl daemon")
    assert answer("hand") == GUIDED._asdict()
    assert "warning" not in typed("hand", "--let-go").err
    monkeypatch.setattr(client, "Client", StandIn)
    assert "warning" not in typed("hand").err
