"""The machine's table is complete, an illegal trigger changes nothing, and the memory survives JSON."""

from collections.abc import Iterable
from copy import deepcopy

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.control import machine
from armctl.control.machine import ENERGISING, LATCHED, MODE, TO_REST, TRANSITIONS, Motion, Phase, State, Trigger
from armctl.errors import IllegalTransition
from armctl.json_text import from_json, to_json
from armctl.messages import Fault, JointTrajectory, Mode, Problem

EDGES = {(phase, trigger): after for phase, row in TRANSITIONS.items() for trigger, after in row.items()}


@pytest.mark.parametrize("phase", list(Phase))
def test_every_trigger_has_an_entry_in_the_row_or_is_refused_with_a_reason_and_changes_nothing(phase: Phase) -> None:
    for trigger in Trigger:
        state = State(phase, ticks=7)
        if trigger in TRANSITIONS[phase]:
            state.go(trigger)
            assert state == State(TRANSITIONS[phase][trigger], ticks=0)
        else:
            with pytest.raises(IllegalTransition, match=r"not possible now: .+"):
                state.go(trigger)
            assert state == State(phase, ticks=7)


@given(st.lists(st.sampled_from(list(Trigger))))
def test_after_any_story_the_machine_is_where_the_triggers_with_an_entry_lead(story: list[Trigger]) -> None:
    state, phase = State(), Phase.FOUND
    for trigger in story:
        before = deepcopy(state)
        try:
            state.go(trigger)
        except IllegalTransition:
            assert state == before
        phase = EDGES.get((phase, trigger), phase)
    assert (state.phase, state.mode) == (phase, MODE[phase])


def reached(begin: Phase, edges: Iterable[tuple[Phase, Phase]]) -> set[Phase]:
    """Every phase that a chain of edges leads to."""
    found, edges = {begin}, list(edges)
    while more := {after for before, after in edges if before in found} - found:
        found |= more
    return found


def test_every_phase_has_a_row_shows_as_a_mode_and_can_be_reached_and_left_for_off() -> None:
    assert set(TRANSITIONS) == set(MODE) == set(Phase)
    assert set(MODE.values()) == set(Mode)
    there = [(before, after) for (before, _), after in EDGES.items()]
    back = [(after, before) for before, after in there]
    assert reached(Phase.FOUND, there) == reached(Phase.OFF, back) == set(Phase)


def test_every_trigger_stands_in_the_table() -> None:
    assert {trigger for _, trigger in EDGES} == set(Trigger)


def test_every_phase_can_fault_and_only_clearing_leaves_a_fault() -> None:
    for phase in set(Phase) - LATCHED:
        assert EDGES[phase, Trigger.FAULT] is Phase.FAULTED
    leaving = {trigger for (phase, trigger), after in EDGES.items() if phase in LATCHED and after not in LATCHED}
    assert leaving == {Trigger.CLEAR_LIMP, Trigger.CLEAR_POWERED}
    still = {Phase.FAULTED, Phase.FAULT_STOPPING}
    assert {phase for phase, trigger in EDGES if trigger in leaving} == still, "not on the way to rest"


def test_torque_comes_on_only_through_energising_or_adoption() -> None:
    into_holding = {edge for edge, after in EDGES.items() if after is Phase.HOLDING}
    assert into_holding == {
        (Phase.FOUND, Trigger.ADOPT_POWERED),
        (Phase.CONFIRMING, Trigger.ENERGISED),
        (Phase.MOVING, Trigger.STOPPED),
        (Phase.JOGGING, Trigger.STOPPED),
        (Phase.PARK_ENDING, Trigger.STOPPED),
        (Phase.FAULTED, Trigger.CLEAR_POWERED),
        (Phase.FAULT_STOPPING, Trigger.CLEAR_POWERED),
    }
    assert {edge for edge, after in EDGES.items() if after in ENERGISING and edge[0] not in ENERGISING} == {
        (Phase.OFF, Trigger.TORQUE_ON)
    }


def test_the_way_to_rest_is_the_same_for_parking_and_under_a_fault() -> None:
    for way, end in (
        ((Phase.PARK_STARTING, Phase.PARK_GOING, Phase.PARK_CHECKING), Phase.RELEASING),
        ((Phase.FAULT_STOPPING, Phase.FAULT_GOING, Phase.FAULT_CHECKING), Phase.FAULTED),
    ):
        assert TO_REST.issuperset(way)
        state = State(way[0])
        for trigger, after in zip((Trigger.SET_OFF, Trigger.ARRIVED, Trigger.PARKED), (*way[1:], end), strict=True):
            state.go(trigger)
            assert state.phase is after


def test_state_survives_json_bit_for_bit() -> None:
    state = State(
        Phase.FAULT_CHECKING,
        connected=True,
        problems=(Problem("EEPROM_MISMATCH", "servo 3: …", 3),),
        faults=(Fault("TRIPPED", "weak", 123456789, 4, "HOT"), Fault("HOT", "66 degC", 5, 4)),
        goal=(1, 2, 3),
        settings=(1 << 59, 7),
        motion=Motion(
            JointTrajectory(0.1, ((0.1 + 0.2, -0.0), (1e-300, 1 / 3)), label="x"),
            9,
            progress_s=1 / 7,
            wanted_rate=0.1,
            paused=True,
        ),
        jog=machine.Jogging((0.1,), (1 / 3,), (), (0.1, 0.0, -0.2), 77, rate=0.3, stop_code="LATE"),
        error_since_ns=(0, 5),
        sent=((1, 2, 3), (1, 2, 2)),
        heard_since=(1, 2),
        letting_go=machine.LettingGo(17, (0, 2), (8,)),
        looks=(machine.Look(2, 17, True),),
        borne_ratio=(0.1, 1 / 3, 0.0),
    )
    assert from_json(State, to_json(state)) == state
