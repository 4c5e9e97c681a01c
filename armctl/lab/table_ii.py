"""Table II of Raharjo et al., made on simulated arms: experiments 1, 2, 3 move the tool from A to B by 0, 1, 2 points.

`run` does what the paper did: five recorded runs of a plan that goes through the points, joints interpolated, a servo
reading each 100 ms; its genetic algorithm takes the five recordings as individuals. Nothing is corrected. What the
paper prints is `PRINTED`, in `report/line.py`.
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from armctl.genetic.algorithm import PAPER
from armctl.json_text import named
from armctl.kinematics.transform import FloatArray
from armctl.lab.rig import VirtualRig
from armctl.lab.study.case import Case, Found
from armctl.recording.disk import new_file
from armctl.recording.export import extra
from armctl.report.line import PRINTED
from armctl.trajectory.interpolate import joint_path
from armctl.trajectory.line_path import line_paths
from armctl.trajectory.plan import Plan, plan_through
from armctl.trajectory.refinement import Measured

# A line of the paper's kind; the paper does not print its ends.
FROM_M = (0.18, -0.125, 0.10)
TO_M = (0.18, 0.125, 0.10)
# Points on the line, by experiment.
VIA = (0, 1, 2)
RUNS = 5
# The paper's recorder wrote every 100 ms.
PERIOD_S = 0.1


def every_experiment(case: Case) -> list[Case]:
    """The case as experiments 1, 2 and 3, with the paper's genetic algorithm and clock."""
    paper = replace(case, settings=PAPER, objective="mean", period_s=PERIOD_S)
    return [replace(paper, via=(via,)) for via in VIA]


def recorded(case: Case) -> tuple[Plan, list[Measured], Case]:
    """The plan of one experiment, what was measured in each run, and the case with that as takes.

    Raises:
        RequestRefused: the line cannot be followed.
    """
    rig = case.rig()
    plan = through_points(rig, case)
    runs = [rig.run(plan, corrected=False) for _ in range(RUNS)]
    return plan, runs, replace(case, takes=tuple(run.positions_rad for run in runs))


def run(case: Case) -> Found:
    """One experiment as the paper made it: its row, and as evidence what was measured in each run.

    Raises:
        RequestRefused: the line cannot be followed, or the recordings are too far from it.
    """
    plan, runs, taken = recorded(case)
    result = taken.optimum()
    recorded_mm = [take.mean_error_mm for take in result.baseline]
    row = {
        "experiment": plan.via + 1,
        "via": plan.via,
        **named(result.ga.path, "mean_error_mm", "max_error_mm"),
        "duration_s": float(np.mean([run.duration_s for run in runs])),
        "recorded_mean_error_mm": float(np.mean(recorded_mm)),
        "spread_mm": float(np.std(recorded_mm)),
        "exact_mean_error_mm": result.exact.mean_error_mm,
        "gap_ratio": result.gap_ratio,
        "paper": PRINTED[plan.via]._asdict(),
    }
    return Found([row], runs)


def through_points(rig: VirtualRig, case: Case) -> Plan:
    """A plan that passes the case's points on the line, joints interpolated linearly in between."""
    (via,) = case.via
    assert isinstance(via, int)
    way = line_paths(rig, case.line, np.random.default_rng(case.seed), most=1)[0]
    knots = np.linspace(0.0, 1.0, via + 2)
    waypoints = np.tile([joint.rest_rad for joint in case.arm.joints], (len(knots), 1))
    waypoints[:, : rig.robot.chain.n] = joint_path(way, np.linspace(0.0, 1.0, len(way)), knots, "cubic")
    asked = {"from_m": case.from_m, "to_m": case.to_m, "duration_s": case.duration_s, "seed": case.seed}
    return plan_through(case.arm, waypoints, knots, (0.0, 0.0), interpolation="linear", **asked)


def write(path: Path, cases: Sequence[Case], experiments: Sequence[Found], *_: object) -> None:
    """The recorded angles in degrees, one sheet a recording, one row a sample, as an Excel file.

    Raises:
        LogError: the file exists or cannot be written.
        ArmctlError: openpyxl is not installed; names the extra that brings it.
    """
    openpyxl = extra("Excel files", "openpyxl")
    joints = [f"{name}_deg" for name in cases[0].arm.joint_names]
    # The file first: a book whose sheets are begun has to be saved.
    with new_file(path) as stream:
        book = openpyxl.Workbook(write_only=True)
        for found in experiments:
            for number, run in enumerate(found.evidence, 1):
                sheet = book.create_sheet(f"experiment {found.rows[0]['experiment']} run {number}")
                sheet.append(["time_s", *joints])
                degrees: FloatArray = np.degrees(run.positions_rad)
                for time_s, angles in zip(run.time_s.tolist(), degrees.tolist(), strict=True):
                    sheet.append([time_s, *angles])
        book.save(stream)
