"""A daemon in this process: it runs plans on a rig, such as a simulated arm, and keeps what it measured by name."""

from pathlib import Path
from typing import Any, Self

import numpy as np
import pytest

import armctl.client
from armctl.kinematics.transform import FloatArray
from armctl.lab.rig import Rig
from armctl.recording import recordings
from armctl.recording.recordings import Recording
from armctl.trajectory.plan import Plan
from armctl.trajectory.refinement import Measured

# From a recording's begin to its plan's.
BEGIN_S = 1.0


def true_path(run: Measured) -> tuple[FloatArray, FloatArray]:
    """When the simulator looked at the tool [s], and where it was [m]."""
    assert run.true_time_s is not None
    assert run.true_tool_m is not None
    return run.true_time_s, run.true_tool_m


class SimulatedDaemon:
    """Answers the calls of an experiment; `install` puts it where clients and recordings are looked for."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig
        self.plans: list[Plan] = []
        self.runs: list[Measured] = []

    def install(self, patch: pytest.MonkeyPatch) -> None:
        patch.setattr(armctl.client, "Client", lambda _socket: self)
        patch.setattr(recordings, "load", self.load)
        patch.setattr("os.nice", lambda _more: 0)  # nobody drives a real arm beside the tests

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        match method:
            case "status":
                joints = [{"position_rad": position} for position in self.rig.goals_rad]
                told = {"arm_id": self.rig.arm.arm_id, "calibration_hash": self.rig.arm.calibration_hash}
                return told | {"period_s": self.rig.period_s, "joints": joints}
            case "run":
                self.plans.append(Plan.model_validate(params["plan"]))
                self.runs.append(self.rig.run(self.plans[-1], corrected=params["corrected"]))
                return {"recording": f"run-{len(self.runs)}", "duration_s": self.runs[-1].duration_s}
            case "recordings_show":
                return {"path": f"takes/{params['name']}.mcap"}
        raise AssertionError(method)

    def load(self, path: Path) -> Recording:
        """A recording as the daemon makes it: it begins before the plan, and ends after it."""
        run, arm = self.runs[int(path.stem.removeprefix("run-")) - 1], self.rig.arm
        return Recording(
            name=path.stem,
            path=path,
            arm_id=arm.arm_id,
            calibration_hash=arm.calibration_hash,
            joint_names=arm.joint_names,
            start_ns=0,
            time_s=np.concatenate([[0.0], BEGIN_S + run.time_s, [BEGIN_S + run.duration_s + 1.0]]),
            positions_rad=np.pad(run.positions_rad, ((1, 1), (0, 0)), mode="edge"),
            plan_s=(BEGIN_S, BEGIN_S + run.duration_s),
            complete=True,
            waited_s=np.zeros(len(run.time_s) + 2),
        )
