"""The hang proof's short form, and that its judge would notice."""

import numpy as np
import pytest

from proving import hang

TIME_S = np.arange(0.0, 1.5, 0.01)


@pytest.mark.parametrize(("stops_s", "again_deg", "found_s"), [(0.4, 0.0, 0.4), (0.9, 0.0, 0.9), (0.3, 0.8, 1.2)])
def test_the_arm_stands_when_no_joint_moves_any_more(stops_s: float, again_deg: float, found_s: float) -> None:
    q = np.zeros((len(TIME_S), 6))
    q[:, 0] = np.radians(60.0 * np.minimum(TIME_S, stops_s))
    q[TIME_S >= 1.2, 3] = np.radians(again_deg)
    assert hang.stood_after_s(q, TIME_S) == pytest.approx(found_s, abs=0.021)


def test_every_state_meets_every_victim_in_the_full_form() -> None:
    assert hang.RUNS >= 200 == hang.RUNS // len(hang.STATES) * len(hang.STATES)
    assert set(hang.VICTIMS) == {"host", "control", "web", "simulator"}


@pytest.mark.pty
def test_a_hang_of_each_process_leaves_the_arm_safe() -> None:
    result = hang.prove(seed=1, runs=1)
    assert [one["runs"] for one in result["by_victim"]] == [1] * 4
    # How long things took is judged where nothing else runs.
    unsafe = ("torque", "told from", "STOP was answered b", "faults", "silent servos", "said to be")
    assert not [told for told in result["examples"] if any(part in told for part in unsafe)]
