"""The wire proof's short form: the real daemon, a real pty, four faults."""

import pytest

from proving import wire, wire_rows


def test_every_scenario_has_a_name_of_its_own_and_the_proof_is_long_enough() -> None:
    names = [scenario.name for scenario in wire_rows.SCENARIOS]
    assert len(names) == len(set(names)) >= 40
    assert set(wire_rows.SHORT) <= set(names)


@pytest.mark.pty
def test_four_faults_are_met_as_the_matrix_says() -> None:
    result = wire.prove(seed=1, names=wire_rows.SHORT)
    assert [scenario["violations"] for scenario in result["scenarios"]] == [[]] * len(wire_rows.SHORT)
    assert (result["runs"], result["violations"]) == (len(wire_rows.SHORT), 0)
