"""Programs as text, and written out."""

import json
from typing import Any

import pytest
import yaml
from hypothesis import given
from hypothesis import strategies as st

from armctl.config import validate
from armctl.errors import ConfigError
from armctl.host import jsonrpc
from armctl.trajectory.program import MOST_STEPS, Program, ProgramRequest, place_of, program_from_text, written_out
from tests.host.doubles import refused

NESTED = """
steps:
- {move: {point_m: [0.18, 0.0, 0.15]}, name: above}
- repeat:
    times: 2
    steps:
    - grip: close
    - if_gripped: {then: [{wait_s: 1.0}], otherwise: [{grip: open}, {wait_s: 2.0}]}
- {repeat: {times: 2, steps: [{wait_s: 0.5}]}, name: twice}
"""


def test_every_time_that_something_is_done_has_a_name_of_its_own() -> None:
    found = written_out(program_from_text(NESTED, "p.yaml", "p"))
    once = ["2.1@{}", "2.2@{}", "2.2.then.1@{}", "", "2.2.otherwise.1@{}", "2.2.otherwise.2@{}"]
    turns = [name.format(turn) for turn in (1, 2) for name in once]
    assert [one.at for one in found] == ["above", *turns, "twice.1@1", "twice.1@2"]


@pytest.mark.parametrize(
    ("name", "index"),
    [("above", 0), ("1", 0), ("2.1", 1), ("2", 1), ("2.2.then.1@2", 9), ("twice", 13), ("twice.1@2", 14)],
)
def test_a_step_is_found_by_its_name_its_turn_or_one_that_it_holds(name: str, index: int) -> None:
    assert place_of(written_out(program_from_text(NESTED, "p.yaml", "p")), name) == index


@pytest.mark.parametrize("name", ["3", "", "2.1@3", "abov", "@1"])
def test_a_step_that_there_is_not_is_refused_with_those_there_are(name: str) -> None:
    with refused("NO_STEP", r"steps: above, 2\.1, 2\.2, 2\.2\.then\.1"):
        place_of(written_out(program_from_text(NESTED, "p.yaml", "p")), name)


LEAVES: st.SearchStrategy[dict[str, Any]] = st.sampled_from(
    [{"wait_s": 1.0}, {"grip": "close"}, {"move": {"joints_rad": [0.0]}}]
)


def _holders(inner: st.SearchStrategy[dict[str, Any]]) -> st.SearchStrategy[dict[str, Any]]:
    some = st.lists(inner, max_size=3)
    repeats = st.builds(lambda times, steps: {"repeat": {"times": times, "steps": steps}}, st.integers(1, 3), some)
    branches = st.builds(lambda a, b: {"if_gripped": {"then": a, "otherwise": b}}, some, some)
    return repeats | branches


def nested(depth: int) -> st.SearchStrategy[dict[str, Any]]:
    """Steps of which at most so many stand in one another."""
    return LEAVES | _holders(nested(depth - 1)) if depth else LEAVES


def done(steps: list[dict[str, Any]], gripped: bool) -> list[dict[str, Any]]:
    """The leaves of steps in the order in which they are to be done, by their definition."""
    found = []
    for step in steps:
        if "repeat" in step:
            found += done(step["repeat"]["steps"], gripped) * step["repeat"]["times"]
        elif "if_gripped" in step:
            found += done(step["if_gripped"]["then" if gripped else "otherwise"], gripped)
        else:
            found.append(step)
    return found


@given(st.lists(nested(3), min_size=1, max_size=4).filter(lambda steps: bool(done(steps, True))), st.booleans())
def test_what_is_written_out_is_what_is_to_be_done_and_only_leads_onwards(
    steps: list[dict[str, Any]], gripped: bool
) -> None:
    out = written_out(validate(Program, {"name": "p", "steps": steps}, "p"))
    names = [one.at for one in out if one.at]
    assert len(set(names)) == len(names)
    index, found = 0, []
    while index < len(out):
        one = out[index]
        branch = one.step is None or one.step.if_gripped is not None
        if not branch:
            assert one.step is not None
            found.append(one.step.model_dump(exclude_none=True, mode="json"))
        onwards = one.other if one.step is None or (branch and not gripped) else index + 1
        assert onwards > index
        index = onwards
    assert json.loads(json.dumps(found)) == done(steps, gripped)


@pytest.mark.parametrize(
    ("steps", "said"),
    [
        ("[]", "p.yaml: steps: 0 with every repeat, 1 to 1000"),
        ("[{wait_s: 5000.0}]", "p.yaml: step 1: wait_s: Input should be less than or equal to 3600 (found '5000.0')"),
        ("[{wait_s: 1.0}, {}]", "p.yaml: step 2: give just one of move, play, path, grip, wait_s, repeat, if_gripped"),
        ("[{wait_s: 1.0, grip: open}]", "(found grip, wait_s)"),
        ("[{repeat: {times: 2, steps: [{move: {}}]}}]", "p.yaml: step 1.1: move: joints_rad, point_m, pose: give just"),
        ("[{if_gripped: {otherwise: [{grip: shut}]}}]", "p.yaml: step 1.otherwise.1: grip: Input should be 'close' or"),
        ("[{repeat: {times: 1000, steps: [{wait_s: 1.0}, {wait_s: 1.0}]}}]", "2000 with every repeat"),
        ("[{name: a, wait_s: 1.0}, {name: a, wait_s: 1.0}]", "name 'a' stands twice"),
        ("[{name: 1.2, wait_s: 1.0}]", "step 1: name: Input should be a valid string"),
        ("[{wait_s: 1.0}, {colour: red}]", "step 2: colour: unknown key (found 'red')"),
        ("[{play: {name: a, rate: 9.0}}, {wait_s: 0.0}]", "\n  step 2: wait_s: Input should be greater than or equal"),
        ("[{", "p.yaml: line 1, column"),
    ],
)
def test_a_mistake_is_named_with_file_step_key_value_and_bound(steps: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        program_from_text(f"steps: {steps}", "p.yaml", "p")
    assert said in str(caught.value)
    assert str(caught.value).endswith("; `armctl help programs` has every key")


def deep(times: int, leaf: dict[str, Any]) -> dict[str, Any]:
    return {"repeat": {"times": 1, "steps": [deep(times - 1, leaf)]}} if times else leaf


PATH = {"path": {"points_m": [[0.1, 0.0, 0.1], [0.2, 0.0, 0.1]]}}


def test_steps_stand_in_one_another_three_deep_in_a_file_and_on_the_socket() -> None:
    data = {"name": "p", "steps": [deep(3, PATH)]}
    line = {"jsonrpc": "2.0", "id": 1, "method": "program_run", "params": {**data, "from_step": "1"}}
    sent = jsonrpc.decode(json.dumps(line).encode()).params
    assert program_from_text(yaml.safe_dump(data), "p.yaml", "other") == validate(Program, data, "p")
    assert validate(ProgramRequest, sent, "p").steps == validate(Program, data, "p").steps
    with pytest.raises(ConfigError, match="nested more than 16 deep"):
        program_from_text(yaml.safe_dump({"steps": [deep(4, PATH)]}), "p.yaml", "p")


def test_a_program_is_counted_without_being_written_out() -> None:
    inner = {"repeat": {"times": MOST_STEPS, "steps": [{"wait_s": 1.0}]}}
    with pytest.raises(ConfigError, match="1000000000 with every repeat"):
        validate(
            Program,
            {
                "name": "p",
                "steps": [{"repeat": {"times": 1000, "steps": [{"repeat": {"times": 1000, "steps": [inner]}}]}}],
            },
            "p",
        )
