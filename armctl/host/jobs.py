"""Long computations, in a process of their own so that the host keeps answering.

A task is a plain function `task(argument, progress) -> result` at the top of a module; offline callers call it
as it is. `run_job` runs it in a spawned process: progress and the outcome come back over a pipe, cancelling the
await ends the process, and an armctl error raised there is raised here with all its fields.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import multiprocessing
import os
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, TypeVar

from armctl.config import ArmConfig
from armctl.errors import ArmctlError, RequestRefused
from armctl.genetic.algorithm import DEFAULT, Settings
from armctl.genetic.straight_line import optimize
from armctl.kinematics import robots
from armctl.recording import recordings
from armctl.trajectory.interpolate import Interpolation
from armctl.trajectory.placement import Objective
from armctl.trajectory.plan import plan_to_text

PROGRESS_PERIOD_S = 0.1
NICENESS = 10
"""A computation must not take the processor from the control process."""

logger = logging.getLogger(__name__)

A = TypeVar("A")
R = TypeVar("R")
Progress = Callable[[int, float, float], None]
"""Called with generation, best and mean cost [mm]."""
Task = Callable[[A, Progress], R]


async def run_job(task: Task[A, R], argument: A, progress: Progress) -> R:
    """The task's result, computed in a spawned process; cancelling ends that process.

    Args:
        task: A function at the top of an importable module.
        progress: Called here, at most ten times a second.
    Raises:
        ArmctlError: what the task raised.
        RequestRefused: code JOB_FAILED, the task broke or its process died.
    """
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe(duplex=False)
    process = context.Process(target=_work, args=(theirs, task, argument), daemon=True)
    process.start()
    theirs.close()
    loop = asyncio.get_running_loop()
    outcome: asyncio.Future[R] = loop.create_future()

    def receive() -> None:
        try:
            kind, *values = ours.recv()
        except (EOFError, OSError):
            loop.remove_reader(ours.fileno())
            if not outcome.done():
                outcome.set_exception(RequestRefused("JOB_FAILED", "the job's process died before it was done"))
            return
        if kind == "progress":
            progress(*values)
        elif outcome.done():
            return
        elif kind == "result":
            outcome.set_result(values[0])
        elif kind == "refused":
            outcome.set_exception(values[0])
        else:
            logger.error("job %s failed\n%s", task.__name__, values[0])
            outcome.set_exception(RequestRefused("JOB_FAILED", "the job broke; the daemon's log has the traceback"))

    loop.add_reader(ours.fileno(), receive)
    try:
        return await outcome
    finally:
        loop.remove_reader(ours.fileno())
        ours.close()
        process.terminate()
        await asyncio.to_thread(process.join)
        process.close()


def _work(pipe: Connection, task: Task[A, R], argument: A) -> None:
    """Body of the job's process."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C in a terminal is the parent's to answer
    with contextlib.suppress(PermissionError):  # a sandbox may forbid it
        os.nice(NICENESS)
    due_s = 0.0

    def progress(generation: int, best: float, mean: float) -> None:
        nonlocal due_s
        if (now_s := time.monotonic()) >= due_s:
            due_s = now_s + PROGRESS_PERIOD_S
            pipe.send(("progress", generation, best, mean))

    try:
        pipe.send(("result", task(argument, progress)))
    except ArmctlError as error:
        pipe.send(("refused", error))
    except BrokenPipeError:
        pass  # nobody waits for the result any more
    except Exception:  # everything else is a defect: told where it can be read
        pipe.send(("broken", traceback.format_exc()))


# -------------------------------------------------------------------------------------------- optimisation


@dataclass(frozen=True, slots=True)
class OptimizeRequest:
    """One straight-line optimisation over recorded candidates."""

    arm: ArmConfig
    recordings: tuple[Path, ...]
    from_m: tuple[float, float, float]
    to_m: tuple[float, float, float]
    via: tuple[int, ...]
    duration_s: float
    seed: int
    settings: Settings = DEFAULT
    interpolation: Interpolation = "cubic"
    objective: Objective = "mean"
    free: bool = True
    """Whether genes may leave the recordings, and via points the path that was found."""


def load_takes(arm: ArmConfig, paths: Sequence[Path]) -> list[recordings.Recording]:
    """Recordings of this arm with its present calibration.

    Raises:
        LogError: a recording cannot be read.
        RequestRefused: code FOREIGN_LOG, a recording is another arm's; names each.
    """
    loaded = [recordings.load(path) for path in paths]
    foreign = [
        f"recording {recording.name} was made with arm {recording.arm_id}, calibration {recording.calibration_hash}; "
        f"this is {arm.arm_id}, {arm.calibration_hash}"
        for recording in loaded
        if (recording.arm_id, recording.calibration_hash) != (arm.arm_id, arm.calibration_hash)
    ]
    if foreign:
        raise RequestRefused("FOREIGN_LOG", foreign)
    return loaded


def optimize_task(request: OptimizeRequest, progress: Progress) -> dict[str, Any]:
    """Load the recordings, optimise, and say the result in JSON's terms.

    Raises:
        LogError: a recording cannot be read.
        RequestRefused: a recording is another arm's (FOREIGN_LOG), or the optimisation refuses the request, or no path
            keeps the joints' limits in its duration (LIMITS).
    """
    arm = request.arm
    loaded = load_takes(arm, request.recordings)
    generations_s: list[float] = []

    def timed(generation: int, best: float, mean: float) -> None:
        generations_s.append(time.monotonic())
        progress(generation, best, mean)

    started_s = time.monotonic()
    result = optimize(
        [recording.positions_rad for recording in loaded],
        arm,
        robots.get(arm.robot, arm.lengths_m),
        request.from_m,
        request.to_m,
        via=request.via,
        duration_s=request.duration_s,
        seed=request.seed,
        settings=request.settings,
        interpolation=request.interpolation,
        objective=request.objective,
        free=request.free,
        progress=timed,
    )
    if not result.feasible:
        least_s = result.least_duration_s
        remedy = f"give {least_s:.1f} s or more" if least_s is not None else "record steadier takes"
        raise RequestRefused(
            "LIMITS",
            f"no path through these recordings keeps the joints' speed and acceleration limits in "
            f"{request.duration_s:g} s; {remedy}",
        )
    ga, exact, free = result.ga, result.exact, result.free
    return {
        "baseline": [
            {"name": recording.name, **asdict(error)} for recording, error in zip(loaded, result.baseline, strict=True)
        ],
        "ga": {
            "mean_error_mm": ga.path.mean_error_mm,
            "max_error_mm": ga.path.max_error_mm,
            "generations": ga.generations,
            "evaluations": ga.evaluations,
            "evaluations_per_s": ga.evaluations / max(generations_s[-1] - started_s, 1e-9),
            "feasible": ga.path.feasible,
            "tool_m": ga.path.tool_m.tolist(),
        },
        "exact": {
            "mean_error_mm": exact.mean_error_mm,
            "max_error_mm": exact.max_error_mm,
            "tool_m": exact.tool_m.tolist(),
        },
        "gap_ratio": result.gap_ratio,
        "free": None
        if free is None
        else {
            "mean_error_mm": free.mean_error_mm,
            "max_error_mm": free.max_error_mm,
            "largest_offset_rad": free.largest_offset_rad,
            "feasible": free.feasible,
            "tool_m": free.tool_m.tolist(),
        },
        "plans": [
            {
                "via": plan.via,
                "predicted_mean_error_mm": plan.predicted_mean_error_mm,
                "predicted_max_error_mm": plan.predicted_max_error_mm,
                "duration_s": plan.duration_s,
                "text": plan_to_text(plan),
            }
            for plan in result.plans
        ],
        "history": {"best_cost_mm": list(ga.best_cost_mm), "mean_cost_mm": list(ga.mean_cost_mm)},
    }
