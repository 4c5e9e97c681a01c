"""The arm behind a daemon as an experiment's rig."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from armctl.client import Client
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.lab.rig import Measured
from armctl.recording import recordings
from armctl.trajectory.plan import Plan

TRIES = 3


class DaemonRig:
    """A daemon's arm; every run is a recording of its own, kept."""

    def __init__(self, client: Client, arm: ArmConfig) -> None:
        """
        Raises:
            RequestRefused: the daemon's arm is another one, or another calibration of it.
        """
        self._client = client
        self.arm = arm
        self.robot = robots.get(arm.robot, arm.lengths_m)
        self.period_s = float(client.call("status")["period_s"])

    @property
    def goals_rad(self) -> Sequence[float]:
        """Where the arm is, as near as its encoders tell."""
        return [joint["position_rad"] for joint in self._client.call("status")["joints"]]

    def run(self, plan: Plan) -> Measured:
        """As `Rig.run`; a run that had to wait for a silent servo did not keep the plan's time, and is repeated."""
        for _ in range(TRIES):
            measured = self._run(plan)
            if abs(measured.duration_s - plan.duration_s) < self.period_s / 2.0:
                return measured
        raise RequestRefused(
            "DISTURBED",
            f"{TRIES} runs in a row took {measured.duration_s:.2f} s or so instead of {plan.duration_s:.2f} s: servos "
            "miss readings and the arm waits for them; see `armctl doctor`",
        )

    def _run(self, plan: Plan) -> Measured:
        answer = self._client.call("run", plan=plan.model_dump(mode="json"))
        path = Path(self._client.call("recordings_show", name=answer["recording"])["path"])
        take = recordings.load(path)
        if take.plan_s is None:
            raise RequestRefused("RECORDS_LOST", f"{path}: the plan's begin or end is missing in the recording")
        begin_s, end_s = take.plan_s
        inside = (take.time_s >= begin_s - 1e-6) & (take.time_s <= end_s + 1e-6)
        return Measured(
            time_s=take.time_s[inside] - begin_s,
            positions_rad=take.positions_rad[inside],
            duration_s=float(answer["duration_s"]),
            recording=answer["recording"],
        )
