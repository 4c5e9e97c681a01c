"""Every fault that can latch has a card, and every card says what is true and what to type."""

from __future__ import annotations

import ast
from pathlib import Path

import pytest

from armctl.control import faults
from armctl.messages import Fault, JointState

ROOT = Path(__file__).resolve().parent.parent.parent
LATCHING = {"latch": 1, "latch_servo": 1, "Problem": 0}
"""Calls that name a fault, and which of their arguments does."""


def joints(*powered: bool) -> list[JointState]:
    return [JointState(True, 0.0, 0.0, 0.0, 12.0, 30.0, torque, 0.0) for torque in powered]


def named_codes() -> dict[str, str]:
    """Every fault code in the source, and where it stands."""
    found = {}
    for path in [*(ROOT / "armctl" / "control").glob("*.py"), *(ROOT / "armctl" / "dynamixel").glob("*.py")]:
        tree = ast.parse(path.read_text(encoding="utf-8"))
        constants = {
            target.id: node.value.value
            for node in tree.body
            if isinstance(node, ast.Assign) and isinstance(node.value, ast.Constant)
            for target in node.targets
            if isinstance(target, ast.Name)
        }
        for node in ast.walk(tree):
            if not (isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in LATCHING):
                continue
            code = node.args[LATCHING[node.func.id]]
            if isinstance(code, ast.Constant):
                found[str(code.value)] = f"{path.name}:{node.lineno}"
            elif isinstance(code, ast.Name) and code.id in constants:
                found[str(constants[code.id])] = f"{path.name}:{node.lineno}"
    return found


def test_every_code_in_the_source_has_a_card_and_every_card_a_code() -> None:
    assert set(named_codes()) == set(faults.CODES)


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
    assert "rest pose" in faults.card(Fault("HOT", "", 0), joints(True, True), True)[0]
