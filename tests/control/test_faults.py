"""Every fault that can latch has a card, and every card says what is true and what to type."""

import ast
from collections.abc import Callable
from pathlib import Path

import pytest

from armctl.control import faults
from armctl.dynamixel import ax12a
from armctl.messages import Clear, Connected, Fault, JointState, Mode, Problem
from tests.control.ideal_arm import IdealArm, holding, running
from tests.paired import paired_arm

ROOT = Path(__file__).resolve().parent.parent.parent
# Calls that name a fault, and which of their arguments does.
LATCHING = {"latch": 0, "latch_servo": 0, "Problem": 0, "problem": 0}


def joints(*powered: bool) -> list[JointState]:
    return [JointState(True, 0.0, 0.0, 0.0, 12.0, 30.0, torque, 0.0) for torque in powered]


def named_codes() -> dict[str, set[str]]:
    """Every fault code in the source, and the calls that name it."""
    found: dict[str, set[str]] = {}
    for path in [*(ROOT / "armctl" / "control").glob("*.py"), *(ROOT / "armctl" / "dynamixel").glob("*.py")]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        constants = {
            target.id: node.value
            for node in tree.body
            if isinstance(node, ast.Assign)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if isinstance(node, ast.Call) and (call := ast.unparse(node.func).split(".")[-1]) in LATCHING:
                code: ast.AST = node.args[LATCHING[call]]
                code = constants.get(code.id, code) if isinstance(code, ast.Name) else code
                if isinstance(code, ast.Constant):
                    found.setdefault(str(code.value), set()).add(call)
    return found


def test_every_code_in_the_source_has_a_row_and_every_row_a_code() -> None:
    assert set(named_codes()) == set(faults.CODES) == set(faults.KINDS)
    assert len(faults.CODES) == len(faults.FAULTS)


@pytest.mark.parametrize(("code", "calls"), named_codes().items())
def test_a_row_says_whether_one_servo_is_named(code: str, calls: set[str]) -> None:
    if latched := calls & {"latch", "latch_servo"}:
        assert latched == {"latch" if faults.KINDS[code].of == "bus" else "latch_servo"}


# What makes each cause persist.
SPOILT: dict[faults.Cause, Callable[[IdealArm], object]] = {
    faults.Cause.PORT: lambda arm: setattr(arm, "port_open", False),
    faults.Cause.PROBLEM: lambda arm: arm.run_tick(Connected((Problem("WRONG_MODEL", "still there"),))),
    faults.Cause.SILENCE: lambda arm: arm.silent.add(2),
    faults.Cause.HEAT: lambda arm: arm.put(2, ax12a.PRESENT_TEMPERATURE, 70),
    faults.Cause.SUPPLY: lambda arm: arm.put(2, ax12a.PRESENT_VOLTAGE, 80),
    faults.Cause.TORQUE: lambda arm: arm.put(2, ax12a.TORQUE_LIMIT, 0),
    faults.Cause.PAIR: lambda arm: arm.put(6, ax12a.PRESENT_POSITION, 1023 - arm.get(1, ax12a.PRESENT_POSITION) + 13),
    faults.Cause.GOAL: lambda arm: setattr(arm, "after_write", lambda arm: arm.put(2, ax12a.GOAL, 40)),
}


@pytest.mark.parametrize("cause", sorted({kind.until for kind in faults.FAULTS}))
def test_whatever_a_row_waits_for_keeps_a_fault_from_being_cleared_while_it_lasts(cause: faults.Cause) -> None:
    arm = holding(IdealArm(paired_arm()) if cause is faults.Cause.PAIR else None)
    arm.run_tick(Connected((Problem("BLOCKED", "found just now"),)))
    arm.run_tick(Connected())
    if cause is not faults.Cause.NONE:
        SPOILT[cause](arm)
        arm.run_ticks(3)
    assert arm.ask(Clear(7)).ok == (cause is faults.Cause.NONE)


@pytest.mark.parametrize("kind", faults.FAULTS, ids=lambda kind: kind.code)
def test_a_fault_does_to_a_run_what_its_row_says(kind: faults.FaultKind) -> None:
    arm = running(5)
    arm.run_tick(Connected((Problem(kind.code, "found just now"),)))
    assert arm.state.fault is not None
    assert (arm.state.fault.code, arm.mode()) == (kind.code, Mode.FAULTED)
    assert (arm.state.motion is None) == (kind.motion == "ends")
    arm.run_ticks(60)
    assert arm.replies[5].code == kind.code
    assert all(arm.get(i, ax12a.TORQUE_ENABLE) for i in range(6)), "nothing that lasts sends it to rest"


@pytest.mark.parametrize("code", faults.CODES)
def test_every_card_says_what_the_arm_does_and_what_to_type(code: str) -> None:
    for state in (joints(True, True), joints(False, False), joints(True, False)):
        for moving in (True, False):
            arm, following = faults.card(Fault(code, "", 0), state, moving)
            assert arm
            assert "`armctl " in following


def test_a_card_tells_a_limp_arm_from_a_holding_one_and_one_that_is_half_limp() -> None:
    fault = Fault("SERVO_SILENT", "", 0)
    told = [faults.card(fault, state, False)[0] for state in (joints(True, True), joints(False, False))]
    assert "holds the last goal" in told[0]
    assert told[1] == "limp"
    assert "partly limp" in faults.card(fault, joints(True, False), False)[0]
    for rest_in_s, what in ((2.0, "about to go to its rest pose (in 2 s)"), (0.0, "on its way to the rest pose")):
        assert what in faults.card(fault, joints(True, True), True, rest_in_s)[0]
