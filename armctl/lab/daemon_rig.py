"""The arm of a daemon as an experiment's rig: its runs are read back from the recordings that the daemon makes."""

from collections.abc import Sequence
from pathlib import Path

from armctl.client import Client
from armctl.config import ArmConfig
from armctl.errors import RequestRefused
from armctl.kinematics import robots
from armctl.lab.rig import Measured
from armctl.recording import recordings
from armctl.recording.recordings import Recording
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
        """Where the arm is, by its encoders."""
        return [joint["position_rad"] for joint in self._client.call("status")["joints"]]

    def run(self, plan: Plan) -> Measured:
        """As `Rig.run`. A run that waited for a silent servo took longer than the plan; it is repeated."""
        for _ in range(TRIES):
            answer = self._client.call("run", plan=plan.model_dump(mode="json"))
            path = Path(self._client.call("recordings_show", name=answer["recording"])["path"])
            measured = measured_run(recordings.load(path), float(answer["duration_s"]))
            if abs(measured.duration_s - plan.duration_s) < self.period_s / 2.0:
                return measured
        raise RequestRefused(
            "DISTURBED",
            f"{TRIES} runs in a row took {measured.duration_s:.2f} s or so instead of {plan.duration_s:.2f} s: servos "
            "miss readings and the arm waits for them; see `armctl doctor`",
        )


def measured_run(run: Recording, duration_s: float) -> Measured:
    """What a recorded run measured between the begin and the end of its plan.

    Raises:
        RequestRefused: RECORDS_LOST, the plan's begin or end is missing.
    """
    if run.plan_s is None:
        raise RequestRefused("RECORDS_LOST", f"{run.path}: the plan's begin or end is missing in the recording")
    begin_s, end_s = run.plan_s
    inside = (run.time_s >= begin_s - 1e-6) & (run.time_s <= end_s + 1e-6)
    return Measured(run.time_s[inside] - begin_s, run.positions_rad[inside], duration_s, run.name)
