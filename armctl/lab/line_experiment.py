"""The straight-line experiment: before any correction, with the sag model, corrected, repeated; and the GA beside it.

Round 0 is the plain plan on the arm as it is. Round 1 is the same one, corrected by the control step, with the arm's
sag model if there is one; in later rounds the plan is corrected by what the ones before showed. The plan that was kept
last is then run `repeats` times anew: those runs are the experiment's rows, so that one lucky run does not decide.
"""

import os
from collections.abc import Iterable, Sequence
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np

from armctl.commissioning import sag_file
from armctl.config import ArmConfig, Config
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.files import data_dir
from armctl.genetic.algorithm import PROFILES
from armctl.genetic.straight_line import optimize
from armctl.host.jobs import NICENESS, load_takes
from armctl.json_text import named
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab import correction, course, measured_tool, sag_identification
from armctl.lab.course import Via, courses, request_of
from armctl.lab.line_results import Outcome, as_json, drawn, rms_lever_m
from armctl.lab.rig import Rig, VirtualRig
from armctl.lab.stage import Progress, Stage, silent
from armctl.messages import LagModel
from armctl.recording import recordings
from armctl.report import experiment as page
from armctl.report.line import ExperimentReport
from armctl.sim.arm import SimulatedArm
from armctl.sim.spec import RANDOM_SPEC, put_together
from armctl.sim.twin import Twin
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.course import Course, Line
from armctl.trajectory.interpolate import columns_at
from armctl.trajectory.line_path import line_paths, onto
from armctl.trajectory.placement import Objective
from armctl.trajectory.preflight import preflight_motion
from armctl.trajectory.refinement import Round, best_of
from armctl.trajectory.straightness import mean_error

# Of the genetic algorithm.
Profile = Literal["default", "paper"]
AUTO_VIA = range(9)
TAKES = 5


@dataclass(frozen=True, eq=False)
class Budget:
    """How many runs an experiment may make."""

    # Corrections at most; 0: the plain plan alone.
    rounds: int = 0
    # Runs of the plan that was kept last.
    repeats: int = 1
    # Draws the simulated arm and everything else that is random.
    seed: int = 0
    # Mean error that `auto` asks for.
    tolerance_mm: float = 1.0


@dataclass(frozen=True, eq=False, kw_only=True)
class Wanted(Budget):
    """A line, and how it is to be followed."""

    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[Via, ...] = ()
    duration_s: float = 5.0
    objective: Objective = "mix"

    @property
    def line(self) -> Line:
        return Line(np.array(self.from_m), np.array(self.to_m), self.duration_s, self.objective)


@dataclass(frozen=True, eq=False, kw_only=True)
class Asked(Wanted):
    """What one call of `armctl experiment line` asks for."""

    recordings: tuple[str, ...]
    # "paper": the paper's operators and order, its genes are recorded ones and stay so.
    profile: Profile
    # An external measurement of the tool, and the recording of the run it was made during.
    measured: tuple[Path, str] | None
    # A page that shows what was found.
    report: Path | None
    # Of a virtual arm: how well it was put together, and how old its servos are (`GEOMETRIES`, `AGES`).
    geometry: str = "perfect"
    age: str = "new"
    # Whose twin it is.
    twin: Twin | None = None


def on_virtual_arm(arm: ArmConfig, asked: Asked, period_s: float, config: Config, stage: Stage) -> dict[str, Any]:
    """The experiment on a simulated arm. The seed draws the arm; its zero ticks are as after `calibrate`.

    The sag model is identified and the candidates are guided on the spot. From where the hand leaves the arm, low or
    at its joints' limits, there may be no way back to rest, nor to another line: it is carried to rest.
    """
    spec = put_together(RANDOM_SPEC, asked.geometry, asked.age, asked.twin)

    def at_rest() -> VirtualRig:
        return VirtualRig(SimulatedArm(arm, seed=asked.seed, spec=spec), period_s)

    rig = at_rest()
    line = _line(rig, asked, config)
    drawn_ways(rig, line, asked.seed)  # a line that cannot be followed is refused before anything moves
    takes = named_takes(config, arm, asked.recordings)
    if not takes:
        with suppress(UnreachableTarget):  # the hand cannot lead the arm along all of the line
            takes = guided_takes(rig, line, asked.seed, stage)
        back = approach_trajectory(rig.goals_rad, [joint.rest_rad for joint in arm.joints], rig, "to rest")
        if preflight_motion(np.array(back.positions_rad), rig):
            rig = at_rest()
    found = _report(rig, line, asked, identified(rig, asked.rounds, asked.seed, stage), takes, stage)
    return {**found, "geometry": asked.geometry, "age": asked.age}


def on_daemon(rig: Rig, asked: Asked, config: Config, stage: Stage) -> dict[str, Any]:
    """The experiment on a daemon's arm. The sag model is the one stored beside the calibration, if there is one."""
    os.nice(NICENESS)  # planning between runs must not take the processor from who drives the arm
    line = _line(rig, asked, config)
    model, takes = sag_file.load(config, rig.arm), named_takes(config, rig.arm, asked.recordings)
    return _report(rig, line, asked, model, takes, stage)


def _line(rig: Rig, asked: Asked, config: Config) -> Line:
    if asked.measured is None:
        return asked.line
    file, name = asked.measured
    run = recordings.load(recordings.path_of(data_dir(config) / "recordings", name))
    return asked.line._replace(unseen_m=measured_tool.unseen_m(*measured_tool.read(file), run, rig.robot.chain))


def _report(
    rig: Rig, line: Line, asked: Asked, model: LagModel | None, takes: list[FloatArray], stage: Stage
) -> dict[str, Any]:
    """Run the experiment; its JSON, and its page where one is asked for."""
    ways, ga = drawn_ways(rig, line, asked.seed), None
    if takes:
        ga, path = genetic(takes, rig, line, asked)
        if asked.recordings:
            ways = _held_as_taught(rig, line, path, ways)
    outcomes = experiment(rig, line, asked.via, asked, model, ways, stage)
    if asked.report is not None:
        page.write(
            ExperimentReport(
                ends=(line.A, line.B),
                outcomes=[drawn(rig, outcome) for outcome in outcomes],
                best_cost_mm=[] if ga is None else ga["history"]["best_cost_mm"],
                exact_mean_mm=None if ga is None else ga["exact_mean_error_mm"],
                notes=(f"Arm {rig.arm.arm_id}, calibration {rig.arm.calibration_hash}.",),
            ),
            asked.report,
        )
    return {
        **as_json(rig, line, outcomes, model),
        "report": None if asked.report is None else str(asked.report),
        "ga": ga,
        "from_m": list(asked.from_m),
        "to_m": list(asked.to_m),
        "seed": asked.seed,
    }


def experiment(
    rig: Rig, line: Line, via: Sequence[Via], budget: Budget, model: LagModel | None, ways: FloatArray, stage: Stage
) -> list[Outcome]:
    """One outcome for each entry of `via`, in order.

    Args:
        ways: Joint positions along the line [rad], shape (ways, stations, n), such as `drawn_ways`.
    Raises:
        RequestRefused: the line cannot be followed, or the arm stopped.
    """
    outcomes = []
    for wanted in via:
        count = choose_via(rig, line, ways, budget.tolerance_mm) if wanted == "auto" else wanted
        points = None if count == "stream" else int(count)
        label = f"via {wanted}" if wanted != "auto" else f"via auto: {count}"
        with stage(label, 1 + budget.rounds + budget.repeats) as show:
            done = run_rounds(rig, courses(rig, line, points, ways), budget, model, show)
            best = best_of(done)
            runs = []
            for repeat in range(1, budget.repeats + 1):
                runs.append(rig.run(best.plan, corrected=best.corrected))
                show(1 + budget.rounds + repeat, f"repeat {repeat} of {budget.repeats}")
        outcomes.append(Outcome(count, done, best, runs))
    return outcomes


def run_rounds(
    rig: Rig, offered: Iterable[Course], budget: Budget, model: LagModel | None, show: Progress
) -> list[Round]:
    """Round 0, of the first of the courses that may run, and the corrected ones."""

    def tell(done: Round) -> None:
        show(done.number + 1, f"round {done.number}: {done.filtered_mm:.2f} mm")

    rounds, seed = budget.rounds, budget.seed
    before = correction.first_run(rig, offered, model, seed, corrected=False)
    tell(before)
    if rounds == 0:
        return [before._replace(kept=True)]
    if not rig.arm.correction:
        return correction.refine(rig, before, rounds, tell)
    if model is not None:
        rig.use(model)
    first = correction.run(rig, before.course, before.plan, 1)
    tell(first)
    if first.filtered_mm < before.filtered_mm:
        return [before, *correction.refine(rig, first, rounds - 1, tell)]
    # The correction does harm: its model is of another arm, or the arm has changed.
    start, *later = correction.refine(rig, before, rounds - 1, tell)
    return [start, first, *(one._replace(number=one.number + 1) for one in later)]


def identified(rig: Rig, rounds: int, seed: int, stage: Stage = silent) -> LagModel | None:
    """The sag model of the rig's arm; None if there are no rounds of correction, which alone need it.

    Raises:
        RequestRefused: the arm cannot run enough calibration lines, or stopped.
    """
    if not rounds:
        return None
    with stage("calibration lines", sag_identification.LINES) as show:
        return sag_identification.identify(rig, np.random.default_rng(seed), show=lambda done: show(done, ""))


def drawn_ways(rig: Rig, line: Line, seed: int) -> FloatArray:
    """Joint positions along the line [rad], shape (ways, stations, n).

    Raises:
        RequestRefused: the line cannot be followed.
    """
    return line_paths(rig, line, np.random.default_rng(seed), most=course.DRAWN_WAYS)


def _held_as_taught(rig: Rig, line: Line, path: FloatArray, ways: FloatArray) -> FloatArray:
    """The way whose posture is the recordings', put onto the line; shape (1, stations, n).

    Raises:
        RequestRefused: it does not reach all of the line.
    """
    s = np.linspace(0.0, 1.0, ways.shape[1])
    q = columns_at(s, np.linspace(0.0, 1.0, len(path)), path)
    limits = np.array([joint.limits_rad for joint in rig.arm.joints[: rig.robot.chain.n]])
    way, missed = onto(rig.robot.chain, line.A + s[:, None] * (line.B - line.A), q, limits, 20)
    if missed.max() > 1e-4:
        raise RequestRefused("LINE", "the recordings' posture does not reach all of the line; record nearer to it")
    return way[None]


def choose_via(rig: Rig, line: Line, ways: FloatArray, tolerance_mm: float) -> int:
    """The fewest via points whose predicted error is within the tolerance; if none is, the most that are tried."""
    for count in AUTO_VIA:
        q = next(courses(rig, line, count, ways)).expected_rad
        # What whole ticks and friction leave at the tool, whatever the plan.
        floor_mm = course.SERVO_ERROR_RAD * rms_lever_m(rig.robot.chain, q, line.A, line.B) * 1e3
        if float(mean_error(tool_position(rig.robot.chain, q), line.A, line.B)) * 1e3 + floor_mm <= tolerance_mm:
            return count
    return AUTO_VIA[-1]


def genetic(takes: Sequence[FloatArray], rig: Rig, line: Line, asked: Asked) -> tuple[dict[str, Any], FloatArray]:
    """What the genetic algorithm makes of recorded candidates, and its path [rad], shape (stations, n).

    Raises:
        RequestRefused: the recordings are unfit; every reason.
    """
    counts = tuple(sorted({count for count in asked.via if isinstance(count, int)}))
    settings, free = PROFILES[asked.profile], asked.profile == "default"
    request = request_of(line, asked.seed, via=counts, settings=settings, objective="mean", free=free)
    result = optimize(takes, rig.arm, rig.robot, request)
    ga, exact = result.ga, result.exact
    return {
        "profile": asked.profile,
        **named(ga.path, "mean_error_mm", "max_error_mm", "feasible"),
        **named(ga, "generations", "evaluations"),
        "exact_mean_error_mm": exact.mean_error_mm,
        "gap_ratio": result.gap_ratio,
        "history": {"best_cost_mm": list(ga.best_cost_mm)},
        "baseline": [asdict(one) for one in result.baseline],
        "plans": [named(plan, "via", "predicted_mean_error_mm", "predicted_max_error_mm") for plan in result.plans],
    }, ga.path.positions_rad[:, : rig.robot.chain.n]


def guided_takes(rig: VirtualRig, line: Line, seed: int, stage: Stage) -> list[FloatArray]:
    """Recordings of the simulated hand that guides the limp arm along the line, as `VirtualRig.teach`."""
    takes = []
    with stage("guiding by hand", TAKES) as show:
        for take in range(TAKES):
            takes.append(rig.teach(line.A, line.B, seed * 1000 + take))
            show(take + 1, "")
    return takes


def named_takes(config: Config, arm: ArmConfig, names: Sequence[str]) -> list[FloatArray]:
    """Joint positions [rad] of the recordings of this arm, each shape (samples, joints).

    Raises:
        LogError: a recording cannot be read.
        RequestRefused: a recording is another arm's; names each.
    """
    folder = data_dir(config) / "recordings"
    return [take.positions_rad for take in load_takes(arm, [recordings.path_of(folder, name) for name in names])]
