"""The wire proof's short form: the real daemon, a real pty, four faults."""

import pytest

from proving import wire, wire_damage, wire_rows


def test_every_scenario_has_a_name_of_its_own_and_the_proof_is_long_enough() -> None:
    names = [scenario.name for scenario in wire_rows.SCENARIOS]
    assert len(names) == len(set(names)) >= 40
    assert set(wire_rows.SHORT) <= set(names)


@pytest.mark.pty
def test_four_faults_are_met_as_the_matrix_says() -> None:
    result = wire.prove(seed=1, names=wire_rows.SHORT)
    assert [scenario["violations"] for scenario in result["scenarios"]] == [[]] * len(wire_rows.SHORT)
    assert (result["runs"], result["violations"]) == (len(wire_rows.SHORT), 0)


def test_damage_both_ways_of_a_hundredth_of_all_packets_is_told_to_be_nothing_else() -> None:
    told = wire_damage.Told()
    for seed in range(3):
        wire_damage.trial(seed, 0.01, told)
    assert (told.runs, told.done, told.wrong) == (3, 3, [])


def test_a_wrong_word_about_a_damaged_line_is_counted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(wire_damage, "RED", frozenset())
    monkeypatch.setattr(wire_damage, "SHARES", (0.0,))
    monkeypatch.setattr("armctl.control.stillness.STILL_TICKS", -1)  # no servo lies still enough
    result = wire_damage.prove(1, 1)
    assert result["violations"] == 1
    assert "JUMP_REFUSED" in result["damage"][0]["codes"]
