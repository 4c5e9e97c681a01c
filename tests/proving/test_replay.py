"""The proof of replay finds what a check passes over."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from rosbags.typesys import Stores, get_typestore

from armctl.recording.replay import ReplayResult, check
from proving import replay
from proving.scenes import SCENES_FROM

# A short one.
SCENE = SCENES_FROM + 3


def test_a_sound_check_judges_every_tick_catches_every_change_and_no_cut_is_clean() -> None:
    tally, wrong, caught = replay.judged(1, SCENE)
    assert wrong == []
    assert tally["judged"] > 100
    assert tally["caught"] == sum(caught.values()) == replay.MUTANTS
    assert (tally["cuts"], tally["clean"]) == (replay.CUTS, 0)


@pytest.mark.parametrize(
    ("blind", "found"),
    [
        (lambda result: replace(result, mismatches=0), "and nobody noticed"),
        (lambda result: replace(result, gaps=(), skipped=0), "it is given a clean bill"),
        (lambda result: replace(result, ticks=result.ticks - 1), "judged, "),
        (lambda result: replace(result, gaps=({"from_s": 0.0, "to_s": 1.0},)), "1 gaps, and"),
    ],
)
def test_a_check_that_passes_something_over_is_found_out(
    blind: Callable[[ReplayResult], ReplayResult], found: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def blinded(path: Path) -> ReplayResult:
        return blind(check(path))

    monkeypatch.setattr("proving.replay.replay.check", blinded)
    _, wrong, _ = replay.judged(1, SCENE)
    assert any(found in text for text in wrong), wrong


def test_constants_of_a_message_are_no_leaves() -> None:
    types = get_typestore(Stores.ROS2_JAZZY).types
    stamp = types["builtin_interfaces/msg/Time"](sec=1, nanosec=2)
    line = types["rcl_interfaces/msg/Log"](stamp=stamp, level=40, name="a", msg="b", file="", function="c", line=3)
    leaves = "level", "name", "msg", "file", "function", "line", "stamp.sec", "stamp.nanosec"
    assert {where for where, *_ in replay.leaves(line, "/rosout", ())} == {f"/rosout.{leaf}" for leaf in leaves}


def test_every_leaf_of_a_message_that_was_read_can_be_changed_and_no_other_changes_with_it() -> None:
    store = get_typestore(Stores.ROS2_JAZZY)
    name = "sensor_msgs/msg/JointState"
    header = store.types["std_msgs/msg/Header"](store.types["builtin_interfaces/msg/Time"](1, 2), "base")
    state = store.types[name](header, ["a", "b"], *(np.array([value, 2.0]) for value in (0.5, 0.0, -1.0)))
    data = store.serialize_cdr(state, name)
    count = len(list(replay.leaves(state, "", ())))
    assert count == 11
    made = set()
    for index in range(count):
        other = store.deserialize_cdr(data, name)
        _, put, leaf = list(replay.leaves(other, "", ()))[index]
        put(replay.another(leaf))
        made.add(bytes(store.serialize_cdr(other, name)))
    assert len(made - {bytes(data)}) == count


def test_every_leaf_of_a_message_can_be_changed() -> None:
    changed = [replay.another(leaf) for leaf in (True, 0, 255, -3, 1.5, "x", "", "data}")]
    assert changed == [False, 1, 254, -2, 1.5000000000000002, "y", "x", "datax"]
