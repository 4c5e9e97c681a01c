"""The daemon's arm as a rig, seen through a client that answers as the daemon does."""

from typing import cast

import numpy as np
import pytest

from armctl.client import Client
from armctl.errors import RequestRefused
from armctl.lab.rig import DaemonRig
from armctl.messages import LagModel
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import Measured
from tests.genetic import hand
from tests.lab.daemon import SimulatedDaemon
from tests.trajectory.test_plan import make_plan

TIME_S = np.arange(51) * np.float64(0.1)
Q = np.linspace(0.0, 1.0, 51)[:, None] * np.ones(6)


class Timed:
    """An arm that moves evenly, and takes as long for each run as the test says."""

    arm, robot, period_s = hand.arm(), hand.robot(), 0.1
    goals_rad = tuple(0.1 * i for i in range(6))

    def __init__(self, *durations_s: float) -> None:
        self.durations_s = list(durations_s)

    def use(self, model: LagModel) -> None:
        raise NotImplementedError

    def run(self, plan: Plan, *, corrected: bool = True) -> Measured:
        return Measured(TIME_S, Q, self.durations_s.pop(0), "")


def served(patch: pytest.MonkeyPatch, *durations_s: float) -> tuple[SimulatedDaemon, DaemonRig]:
    daemon = SimulatedDaemon(Timed(*durations_s))
    daemon.install(patch)
    return daemon, DaemonRig(cast(Client, daemon), hand.arm())


def test_a_run_is_what_its_recording_holds_between_the_plans_begin_and_end(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, rig = served(monkeypatch, 5.0)
    measured = rig.run(make_plan())
    assert (daemon.plans, rig.period_s) == ([make_plan()], 0.1)
    assert list(rig.goals_rad) == pytest.approx([0.0, 0.1, 0.2, 0.3, 0.4, 0.5])
    assert (measured.recording, measured.duration_s, measured.true_tool_m) == ("run-1", 5.0, None)
    np.testing.assert_allclose(measured.time_s, TIME_S, atol=1e-9)
    np.testing.assert_array_equal(measured.positions_rad, Q)


def test_a_run_that_waited_long_is_repeated_and_at_last_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    daemon, rig = served(monkeypatch, 5.6, 5.5, 5.2)
    assert rig.run(make_plan()).duration_s == 5.2
    assert len(daemon.plans) == 3
    with pytest.raises(RequestRefused, match=r"5\.50 s or so instead of 5\.00 s"):
        served(monkeypatch, 5.6, 5.5, 5.5)[1].run(make_plan())
