"""The paper's three experiments as it made them: five recorded runs each, its genetic algorithm, its Table II.

Experiments 1, 2 and 3 move the arm from A to B through 0, 1 and 2 points on the line, joints interpolated, and record
every servo each 100 ms. The genetic algorithm takes the five recordings of an experiment as individuals. Nothing is
corrected; the arm is a simulated one, drawn by the seed.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from armctl.config import ArmConfig
from armctl.genetic.algorithm import PAPER, Settings
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import optimize
from armctl.kinematics.transform import FloatArray
from armctl.lab.rig import Measured, VirtualRig
from armctl.recording.disk import new_file
from armctl.recording.export import missing_extra
from armctl.report.line import PAPER_ROWS
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory.interpolate import joint_path
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan

RUNS = 5
PERIOD_S = 0.1
"""The paper's recorder wrote every 100 ms."""


@dataclass(frozen=True, eq=False)
class Case:
    """One experiment."""

    arm: ArmConfig
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: int
    duration_s: float
    seed: int
    settings: Settings = PAPER


@dataclass(frozen=True, eq=False)
class Experiment:
    """One row of the table, and the recordings it was made from."""

    row: dict[str, Any]
    runs: list[Measured]


def work(case: Case) -> Experiment:
    """Run the experiment.

    Raises:
        RequestRefused: the line cannot be followed, or the recordings are too far from it.
    """
    rig = VirtualRig(SimulatedArm(case.arm, seed=case.seed, spec=RANDOM_SPEC), PERIOD_S)
    plan = _through_points(rig, case)
    runs = [rig.run(plan) for _ in range(RUNS)]
    result = optimize(
        [run.positions_rad for run in runs],
        case.arm,
        rig.robot,
        OptimizeRequest(
            from_m=case.from_m,
            to_m=case.to_m,
            via=(),
            duration_s=case.duration_s,
            seed=case.seed,
            settings=case.settings,
            free=False,
        ),
    )
    mean_mm, max_mm, time_s = PAPER_ROWS[case.via]
    row = {
        "experiment": case.via + 1,
        "via": case.via,
        "mean_error_mm": result.ga.mean_error_mm,
        "max_error_mm": result.ga.path.max_error_mm,
        "duration_s": float(np.mean([run.duration_s for run in runs])),
        "recorded_mean_error_mm": float(np.mean([one.mean_error_mm for one in result.baseline])),
        "spread_mm": float(np.std([one.mean_error_mm for one in result.baseline])),
        "exact_mean_error_mm": result.exact.mean_error_mm,
        "gap_ratio": result.gap_ratio,
        "paper": {"mean_error_mm": mean_mm, "max_error_mm": max_mm, "duration_s": time_s},
    }
    return Experiment(row, runs)


def _through_points(rig: VirtualRig, case: Case) -> Plan:
    A, B = np.array(case.from_m), np.array(case.to_m)
    rng = np.random.default_rng(case.seed)
    way = line_paths(case.arm, rig.robot, A, B, case.duration_s, rng, most=1)[0]
    knots = np.linspace(0.0, 1.0, case.via + 2)
    waypoints = np.tile([joint.rest_rad for joint in case.arm.joints], (len(knots), 1))
    waypoints[:, : rig.robot.chain.n] = joint_path(way, np.linspace(0.0, 1.0, len(way)), knots, "cubic")
    return Plan(
        arm_id=case.arm.arm_id,
        calibration_hash=case.arm.calibration_hash,
        from_m=case.from_m,
        to_m=case.to_m,
        duration_s=case.duration_s,
        via=case.via,
        interpolation="linear",
        waypoints_rad=tuple(map(tuple, waypoints.tolist())),
        waypoint_progress=tuple(knots.tolist()),
        predicted_mean_error_mm=0.0,
        predicted_max_error_mm=0.0,
        seed=case.seed,
    )


def write_angles(path: Path, joint_names: Sequence[str], experiments: Sequence[Experiment]) -> None:
    """The recorded angles in degrees, one sheet a recording, one row a sample, as an Excel file.

    Raises:
        LogError: the file exists or cannot be written.
        ArmctlError: openpyxl is not installed; names the extra that brings it.
    """
    try:
        import openpyxl
    except ImportError:
        raise missing_extra("Excel files", "openpyxl") from None
    # The file first: a book whose sheets are begun has to be saved.
    with new_file(path) as stream:
        book = openpyxl.Workbook(write_only=True)
        for experiment in experiments:
            for number, run in enumerate(experiment.runs, 1):
                sheet = book.create_sheet(f"experiment {experiment.row['experiment']} run {number}")
                sheet.append(["time_s", *(f"{name}_deg" for name in joint_names)])
                degrees: FloatArray = np.degrees(run.positions_rad)
                for time_s, angles in zip(run.time_s.tolist(), degrees.tolist(), strict=True):
                    sheet.append([time_s, *angles])
        book.save(stream)
