"""The proof of programs: its judge sees what it is there for, and a few programs live through what happens."""

import itertools
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

from armctl.host.programs import Site
from proving import programs

MOVE = {"move": programs._move(0.3)}
TAUGHT = {"play": programs._taught(0.42)}


def trial(steps: programs.Steps, *happenings: tuple[int, str], thing: bool = False) -> programs.Trial:
    return programs.Trial((1, 1), steps, thing, happenings)


def test_what_is_to_be_done_follows_from_what_is_gripped() -> None:
    steps: programs.Steps = [
        {"grip": "close"},
        {"repeat": {"times": 2, "steps": [MOVE, {"if_gripped": {"then": [TAUGHT], "otherwise": [{"grip": "open"}]}}]}},
    ]
    assert programs.wanted(steps, thing=True) == ["close", 0.3, 0.42, 0.3, "open"]
    assert programs.wanted(steps, thing=False) == ["close", 0.3, "open", 0.3, "open"]
    assert programs._opens("2.2.then.1@1", steps)
    assert not programs._opens("2.1@2", steps)


def test_a_seed_and_a_number_draw_the_same_program_and_places_that_can_be_told_apart() -> None:
    assert programs.drawn(3, 7) == programs.drawn(3, 7) != programs.drawn(3, 8)
    steps = programs._steps(np.random.default_rng(1), 2, itertools.count(1))
    places = [what for what in programs.wanted(steps, thing=True) if not isinstance(what, str)]
    apart = np.diff(sorted(set(places)))
    assert len(apart) == 0 or apart.min() > programs.APART_RAD - 0.011


def test_programs_go_on_whatever_happens() -> None:
    result = programs.prove(4, lambda _: None, runs=6, workers=1)
    assert result["violations"] == []
    assert sum(result["happened"].values()) > 8
    assert result["resumed"] > 2


@pytest.mark.parametrize("happening", programs.KINDS)
def test_each_that_happens_ends_the_program_which_then_goes_on(happening: str) -> None:
    told = programs.run(trial([{"wait_s": 0.5}, MOVE, TAUGHT], (30, happening)))
    assert (told["happened"], told["resumed"], told["broken"]) == ([happening], 1, [])


Keep = Callable[..., None]


def _leaves_one_out(site: Site, program: Any, index: int, **more: Any) -> None:
    KEPT(site, program, index + (index == 1), **more)


def _never_goes_on(site: Site, program: Any, index: int, **more: Any) -> None:
    KEPT(site, program, 0, **more)


KEPT: Keep = Site.keep


@pytest.mark.parametrize(("keep", "after"), [(_leaves_one_out, 60), (_never_goes_on, 220)])
def test_a_step_that_is_left_out_or_done_without_need_is_told(
    keep: Keep, after: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop comes while the second step is done, or the last."""
    steps: programs.Steps = [{"wait_s": 0.5}, MOVE, TAUGHT, {"move": programs._move(0.0)}]
    assert programs.run(trial(steps, (after, "stop")))["broken"] == []
    monkeypatch.setattr(Site, "keep", keep)
    [told] = programs.run(trial(steps, (after, "stop")))["broken"]
    assert "wanted" in told


def test_a_motion_that_ends_elsewhere_is_told(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(programs, "THERE_RAD", 0.0)
    assert any("ended at" in text for text in programs.run(trial([MOVE]))["broken"])
