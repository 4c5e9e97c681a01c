"""The wire proof's short form: the real daemon, a real pty, four faults."""

from dataclasses import replace
from unittest.mock import Mock

import numpy as np
import pytest

from armctl.files import load_arm
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


@pytest.mark.parametrize(("least_deg", "most_deg", "told"), [(-2.6, 1.9, False), (-4.2, 0.0, True), (0.0, 4.2, True)])
def test_a_joint_is_judged_by_how_far_it_is_from_its_place(least_deg: float, most_deg: float, told: bool) -> None:
    scenario, arm = replace(wire_rows.SCENARIOS[0], state="holding", act=None, settles=False), load_arm("ax12-line")
    joints_rad = np.zeros((60, len(arm.joints)))
    joints_rad[20:30, 2], joints_rad[40:50, 2] = np.radians((least_deg, most_deg))
    truth = Mock(time_ns=np.arange(60) * 10_000_000, joints_rad=joints_rad)
    running = Mock(arm=arm, **{"simulator.truth.return_value": truth})
    wire._judge_motion(running, scenario, result := wire.Result("holding"), wire._Motion(), 0, 600_000_000)
    assert bool(result.violations) is told
