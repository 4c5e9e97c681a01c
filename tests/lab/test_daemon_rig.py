"""The daemon's arm as a rig, seen through a client that answers as the daemon does."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import pytest

from armctl.client import Client
from armctl.errors import RequestRefused
from armctl.lab.daemon_rig import DaemonRig
from armctl.lab.rig import Measured
from armctl.recording import recordings
from armctl.recording.recordings import Recording
from armctl.trajectory.plan import Plan
from tests.genetic import hand
from tests.trajectory.test_plan import make_plan


class Answers:
    """What the daemon answers, and what it was asked."""

    def __init__(self, *durations_s: float) -> None:
        self.plans: list[Plan] = []
        self.durations_s = list(durations_s)

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        if method == "status":
            return {"period_s": 0.1, "joints": [{"position_rad": 0.1 * i} for i in range(6)]}
        if method == "run":
            self.plans.append(Plan.model_validate(params["plan"]))
            return {"recording": "run-1", "duration_s": self.durations_s.pop(0)}
        assert method == "recordings_show"
        assert params == {"name": "run-1"}
        return {"path": "run-1.mcap"}


TIME_S = np.arange(71) * np.float64(0.1)
Q = np.linspace(0.0, 1.0, 71)[:, None] * np.ones(6)


def load(path: Path) -> Recording:
    return Recording("run-1", path, "ax12-line", "h", hand.arm().joint_names, 0, TIME_S, Q, (1.0, 6.0), True)


@pytest.fixture(autouse=True)
def recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(recordings, "load", load)


def test_a_run_is_what_its_recording_holds_between_the_plans_begin_and_end() -> None:
    answers = Answers(5.0)
    rig = DaemonRig(cast(Client, answers), hand.arm())
    measured: Measured = rig.run(make_plan())
    assert answers.plans == [make_plan()]
    assert rig.period_s == 0.1
    assert list(rig.goals_rad) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert (measured.recording, measured.duration_s, measured.true_tool_m) == ("run-1", 5.0, None)
    np.testing.assert_allclose(measured.time_s, np.arange(51) * 0.1, atol=1e-9)
    np.testing.assert_array_equal(measured.positions_rad, Q[10:61])


def test_a_run_that_had_to_wait_for_a_servo_is_repeated_and_at_last_refused() -> None:
    answers = Answers(5.6, 5.3, 5.0)
    assert DaemonRig(cast(Client, answers), hand.arm()).run(make_plan()).duration_s == 5.0
    assert len(answers.plans) == 3
    with pytest.raises(RequestRefused, match=r"5\.20 s or so instead of 5\.00 s"):
        DaemonRig(cast(Client, Answers(5.6, 5.3, 5.2)), hand.arm()).run(make_plan())
