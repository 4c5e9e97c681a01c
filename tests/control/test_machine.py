"""The machine's table is complete, and an illegal trigger changes nothing."""

from __future__ import annotations

import dataclasses

import pytest

from armctl.control.machine import TRANSITIONS, Jogging, Motion, Settle, State, Trigger, replace, transition
from armctl.errors import IllegalTransition
from armctl.messages import Fault, JointTrajectory, Mode, Problem, from_json, to_json


@pytest.mark.parametrize("mode", list(Mode))
@pytest.mark.parametrize("trigger", list(Trigger))
def test_every_pair_is_either_a_row_or_refused_with_a_reason(mode: Mode, trigger: Trigger) -> None:
    state = State(mode=mode, phase=7)
    if (mode, trigger) in TRANSITIONS:
        assert transition(state, trigger) == replace(state, mode=TRANSITIONS[mode, trigger], phase=0)
    else:
        with pytest.raises(IllegalTransition, match=r"not possible now: .+"):
            transition(state, trigger)
        assert state == State(mode=mode, phase=7)


def test_every_mode_can_fault_and_only_clearing_leaves_a_fault() -> None:
    for mode in set(Mode) - {Mode.FAULTED}:
        assert TRANSITIONS[mode, Trigger.FAULT] is Mode.FAULTED
    leaving = {t for (mode, t), target in TRANSITIONS.items() if mode is Mode.FAULTED and target is not Mode.FAULTED}
    assert leaving == {Trigger.CLEAR_LIMP, Trigger.CLEAR_POWERED}


def test_torque_comes_on_only_through_energising_or_adoption() -> None:
    into_holding = {(m, t) for (m, t), target in TRANSITIONS.items() if target is Mode.HOLDING}
    assert into_holding == {
        (Mode.OFF, Trigger.ADOPT_POWERED),
        (Mode.ENERGISING, Trigger.ENERGISED),
        (Mode.MOVING, Trigger.STOPPED),
        (Mode.JOGGING, Trigger.STOPPED),
        (Mode.PARKING, Trigger.STOPPED),
        (Mode.FAULTED, Trigger.CLEAR_POWERED),
    }


def test_state_survives_json_bit_for_bit() -> None:
    state = State(
        mode=Mode.FAULTED,
        connected=True,
        problems=(Problem("EEPROM_MISMATCH", "servo 3: …", 3),),
        fault=Fault("BLOCKED", "stuck", 123456789, 4),
        goal=(1, 2, 3),
        settle=Settle.VERIFY,
        settings=(1 << 59, 7),
        motion=Motion(
            JointTrajectory(0.1, ((0.1 + 0.2, -0.0), (1e-300, 1 / 3)), label="x"),
            9,
            progress_s=1 / 7,
            wanted_rate=0.1,
            paused=True,
        ),
        jog=Jogging((0.1,), (1 / 3,), (), (0.1, 0.0, -0.2), 77, rate=0.3, stop_code="LATE"),
        error_since_ns=(0, 5),
    )
    assert from_json(State, to_json(state)) == state


def test_a_replaced_state_is_what_dataclasses_make_of_it_and_leaves_the_first_as_it_was() -> None:
    motion = Motion(JointTrajectory(0.1, ((0.0,), (1.0,))), None)
    for before, changes in (
        (State(), {"mode": Mode.HOLDING, "goal": (512,)}),
        (motion, {"rate": 0.5}),
        (Jogging((0.0,), (0.0,), (1.0,), (), 5), {"stop_code": "LATE"}),
    ):
        text = repr(before)
        after = replace(before, **changes)
        assert after == dataclasses.replace(before, **changes)
        assert type(after) is type(before)
        assert repr(before) == text
    with pytest.raises(TypeError, match="no such_field"):
        replace(State(), such_field=1)  # type: ignore[call-arg]
    with pytest.raises(dataclasses.FrozenInstanceError):
        replace(State(), phase=2).phase = 3  # type: ignore[misc]
