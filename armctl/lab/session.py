"""One call of `armctl experiment line`: the rig, the sag model, the recordings and the outcome."""

from __future__ import annotations

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from armctl.config import ArmConfig, Config
from armctl.errors import RequestRefused
from armctl.files import data_dir
from armctl.host.jobs import NICENESS
from armctl.kinematics.transform import FloatArray
from armctl.lab import calibrate_sag, line, refine, stored, tool_points
from armctl.lab.evidence import outcome
from armctl.lab.line import Profile, Stage, Via
from armctl.lab.rig import Rig, VirtualRig
from armctl.lab.sag_model import SagModel
from armctl.recording import recordings
from armctl.report import experiment as page
from armctl.report.line import ExperimentReport
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC
from armctl.trajectory.line_path import onto


@dataclass(frozen=True)
class Asked:
    """What the command line asks for."""

    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[Via, ...]
    repeats: int
    duration_s: float
    rounds: int
    tolerance_mm: float
    objective: Literal["mean", "mix", "max"]
    seed: int
    recordings: tuple[str, ...]
    profile: Profile
    measured: tuple[Path, str] | None
    """An external measurement of the tool, and the recording of the run it was made during."""
    report: Path | None = None
    """A page that shows what was found."""


def virtual(arm: ArmConfig, asked: Asked, period_s: float, config: Config, stage: Stage) -> dict[str, Any]:
    """The experiment on a simulated arm, one of many: drawn by the seed, its zero ticks as after `calibrate`.

    The sag model is identified and the candidates are guided on the spot.
    """
    rig = VirtualRig(SimulatedArm(arm, seed=asked.seed, spec=RANDOM_SPEC), period_s)
    wanted = _wanted(rig, asked, config)
    line.drawn_ways(rig, wanted, asked.seed)  # a line that cannot be followed is refused before anything moves
    takes: list[FloatArray] | None = _load(config, arm, asked.recordings)
    if not takes:
        with stage("guiding by hand", line.TAKES) as show:
            takes = line.guided_takes(rig, wanted, asked.seed)
            show(line.TAKES, "")
    model = None
    if asked.rounds:
        with stage("calibration lines", calibrate_sag.LINES) as show:
            model = calibrate_sag.identify(rig, np.random.default_rng(asked.seed), show=lambda done: show(done, ""))
    return _experiment(rig, wanted, asked, model, takes, stage)


def on_daemon(rig: Rig, asked: Asked, config: Config, stage: Stage) -> dict[str, Any]:
    """The experiment on a daemon's arm, with the sag model stored beside its calibration, if one is."""
    os.nice(NICENESS)  # planning between runs must not take the processor from who drives the arm
    wanted = _wanted(rig, asked, config)
    return _experiment(
        rig, wanted, asked, stored.load(config, rig.arm), _load(config, rig.arm, asked.recordings), stage
    )


def _wanted(rig: Rig, asked: Asked, config: Config) -> refine.Line:
    line.check_via(asked.via)
    unseen = None
    if asked.measured is not None:
        file, name = asked.measured
        unseen = tool_points.unseen_m(*tool_points.read(file), _found(config, name), rig.robot.chain)
    return refine.Line(np.array(asked.from_m), np.array(asked.to_m), asked.duration_s, asked.objective, unseen)


def _experiment(
    rig: Rig,
    wanted: refine.Line,
    asked: Asked,
    model: SagModel | None,
    takes: list[FloatArray] | None,
    stage: Stage,
) -> dict[str, Any]:
    ways, ga = line.drawn_ways(rig, wanted, asked.seed), None
    if takes:
        ga, path = line.genetic(takes, rig, wanted, asked.via, asked.seed, asked.profile)
        if asked.recordings:
            ways = _held_as_taught(rig, wanted, path, ways)
    outcomes = line.experiment(
        rig,
        wanted,
        asked.via,
        repeats=asked.repeats,
        rounds=asked.rounds,
        seed=asked.seed,
        model=model,
        stage=stage,
        tolerance_mm=asked.tolerance_mm,
        ways=ways,
    )
    if asked.report is not None:
        _write_page(asked.report, rig, wanted, outcomes, ga)
    return {
        **line.as_json(rig, wanted, outcomes, model),
        "report": None if asked.report is None else str(asked.report),
        "ga": ga,
        "from_m": list(asked.from_m),
        "to_m": list(asked.to_m),
        "seed": asked.seed,
    }


def _write_page(
    path: Path, rig: Rig, wanted: refine.Line, outcomes: Sequence[line.Outcome], ga: dict[str, Any] | None
) -> None:
    page.write(
        ExperimentReport(
            from_m=wanted.A,
            to_m=wanted.B,
            outcomes=[outcome(rig, one) for one in outcomes],
            best_cost_mm=[] if ga is None else ga["history"]["best_cost_mm"],
            exact_mean_mm=None if ga is None else ga["exact_mean_error_mm"],
            notes=(f"Arm {rig.arm.arm_id}, calibration {rig.arm.calibration_hash}.",),
        ),
        path,
    )


def _held_as_taught(rig: Rig, wanted: refine.Line, path: FloatArray, ways: FloatArray) -> FloatArray:
    """The way whose posture is the recordings', put onto the line; shape (1, stations, n).

    Raises:
        RequestRefused: it does not reach all of the line.
    """
    s = np.linspace(0.0, 1.0, ways.shape[1])
    q = np.stack([np.interp(s, np.linspace(0.0, 1.0, len(path)), column) for column in path.T], axis=1)
    limits = np.array([joint.limits_rad for joint in rig.arm.joints[: rig.robot.chain.n]])
    way, missed = onto(rig.robot.chain, wanted.A + s[:, None] * (wanted.B - wanted.A), q, limits, 20)
    if missed.max() > 1e-4:
        raise RequestRefused("LINE", "the recordings' posture does not reach all of the line; record nearer to it")
    return way[None]


def _found(config: Config, name: str) -> recordings.Recording:
    return recordings.load(Path(name) if "/" in name else recordings.find(data_dir(config) / "recordings", name))


def _load(config: Config, arm: ArmConfig, names: tuple[str, ...]) -> list[FloatArray]:
    loaded = [_found(config, name) for name in names]
    foreign = [
        f"recording {one.name} was made with arm {one.arm_id}, calibration {one.calibration_hash}; this is "
        f"{arm.arm_id}, {arm.calibration_hash}"
        for one in loaded
        if (one.arm_id, one.calibration_hash) != (arm.arm_id, arm.calibration_hash)
    ]
    if foreign:
        raise RequestRefused("FOREIGN_LOG", foreign)
    return [one.positions_rad for one in loaded]
