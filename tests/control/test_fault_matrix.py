"""The fault matrix (`fault_matrix.yaml`): every row, its codes, and the tests that hold detection, bound and reaction.

A row without a test, a test that is not there, a code that nothing holds: each fails here. Where a test stands does not
matter, so that a module of tests can be divided.
"""

import re
from pathlib import Path

import pytest
import yaml

from armctl.control import faults

TESTS = Path(__file__).resolve().parent.parent
FUNCTIONS = {
    name
    for path in TESTS.rglob("test_*.py")
    for name in re.findall(r"^(?:async )?def (test_\w+)", path.read_text(encoding="utf-8"), re.MULTILINE)
}
MATRIX = yaml.safe_load(Path(__file__).with_name("fault_matrix.yaml").read_text(encoding="utf-8"))


@pytest.mark.parametrize("row", MATRIX)
def test_every_row_has_tests_that_exist(row: str) -> None:
    tests = set(MATRIX[row]["tests"])
    assert tests, f"{row}: nothing proves it"
    assert tests <= FUNCTIONS, f"{row}: {tests - FUNCTIONS} are not there"


def test_every_fault_that_can_latch_stands_in_a_row() -> None:
    assert set(faults.CODES) <= {code for row in MATRIX.values() for code in row["codes"]}
