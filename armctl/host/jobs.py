"""Long computations, in a process of their own so that the host keeps answering.

A task is a plain function `task(argument, progress) -> result` at the top of a module; offline callers call it
as it is. `run_job` runs it in a spawned process: progress and the outcome come back over a pipe, cancelling the
await ends the process, and an armctl error raised there is raised here with all its fields.
"""

import asyncio
import contextlib
import logging
import multiprocessing
import os
import resource
import signal
import time
import traceback
from collections.abc import Callable, Sequence
from dataclasses import asdict
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Annotated, Any, NamedTuple, TypeVar, cast

from pydantic import Field

from armctl.config import ArmConfig, Name
from armctl.errors import ArmctlError, RequestRefused
from armctl.genetic.request import OptimizeRequest, ViaCounts
from armctl.genetic.straight_line import Progress, optimize
from armctl.json_text import named
from armctl.kinematics import robots
from armctl.kinematics.chain import SerialChain
from armctl.messages import LagModel
from armctl.recording import recordings
from armctl.trajectory.expectation import expected_mm
from armctl.trajectory.plan import Plan, plan_to_text

PROGRESS_PERIOD_S = 0.1
# A computation must not take the processor from the control process.
NICENESS = 10
# Most memory that a job takes beyond what it starts with. An optimisation that would need more is refused before it
# begins: 100,000 individuals took 2.5 GB in their first seconds.
JOB_BYTES = 768 * 2**20
INDIVIDUAL_BYTES = 25_000
# Where memory runs out all the same, a job ends before its daemon does.
OOM_SCORE = "700"

logger = logging.getLogger(__name__)

A = TypeVar("A")
R = TypeVar("R")
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
    said: asyncio.Queue[tuple[Any, ...]] = asyncio.Queue()

    def receive() -> None:
        try:
            said.put_nowait(ours.recv())
        except (EOFError, OSError):
            loop.remove_reader(ours.fileno())
            said.put_nowait(("died",))

    loop.add_reader(ours.fileno(), receive)
    try:
        while True:
            match await said.get():
                case "progress", *values:
                    progress(*values)
                case "result", result:
                    return cast(R, result)
                case "refused", error:
                    raise error
                case "broken", text:
                    logger.error("job %s failed\n%s", task.__name__, text)
                    raise RequestRefused("JOB_FAILED", "the job broke; the daemon's log has the traceback")
                case _:
                    raise RequestRefused("JOB_FAILED", "the job's process died before it was done")
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
        os.setsid()  # the daemon's session goes before others, a job's does not
        os.nice(NICENESS)
    with contextlib.suppress(OSError, ValueError):
        taken = int(Path("/proc/self/statm").read_text().split()[5]) * resource.getpagesize()
        resource.setrlimit(resource.RLIMIT_DATA, (taken + JOB_BYTES,) * 2)
        Path("/proc/self/oom_score_adj").write_text(OOM_SCORE)
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
    except MemoryError:
        pipe.send(("refused", RequestRefused("TOO_LARGE", f"the job needs more than {JOB_BYTES >> 20} MiB of memory")))
    except BrokenPipeError:
        pass  # nobody waits for the result any more
    except Exception:  # everything else is a defect: told where it can be read
        pipe.send(("broken", traceback.format_exc()))


# -------------------------------------------------------------------------------------------- optimisation


class RecordedRequest(OptimizeRequest):
    """An optimisation as clients of the daemon ask for it: over recordings of its own, and for at least one plan."""

    recordings: Annotated[tuple[Name, ...], Field(min_length=1, max_length=40, strict=False)]
    via: Annotated[ViaCounts, Field(min_length=1)]


class OptimizeJob(NamedTuple):
    """One optimisation with what it needs besides: where the recordings lie, and whose they are."""

    arm: ArmConfig
    paths: tuple[Path, ...]
    request: OptimizeRequest
    # The arm's own lag model, if there is one.
    model: LagModel | None = None


def load_takes(arm: ArmConfig, paths: Sequence[Path]) -> list[recordings.Recording]:
    """Recordings of this arm with its present calibration.

    Raises:
        LogError: a recording cannot be read.
        RequestRefused: code FOREIGN_LOG, a recording is another arm's; names each.
    """
    loaded = [recordings.load(path) for path in paths]
    this = arm.arm_id, arm.calibration_hash
    if foreign := [take for take in loaded if (take.arm_id, take.calibration_hash) != this]:
        made = "recording {0.name} was made with arm {0.arm_id}, calibration {0.calibration_hash}; this is {1}, {2}"
        raise RequestRefused("FOREIGN_LOG", [made.format(take, *this) for take in foreign])
    return loaded


def optimize_task(job: OptimizeJob, progress: Progress) -> dict[str, Any]:
    """Load the recordings, optimise, and say the result in JSON's terms.

    Raises:
        LogError: a recording cannot be read.
        RequestRefused: a recording is another arm's (FOREIGN_LOG), or the optimisation refuses the request, or no path
            keeps the joints' limits in its duration (LIMITS).
    """
    arm, request = job.arm, job.request
    if (most := JOB_BYTES // INDIVIDUAL_BYTES) < request.settings.population:
        size = request.settings.population
        raise RequestRefused("TOO_LARGE", f"a population of {size} does not fit into a job's memory; at most {most}")
    loaded = load_takes(arm, job.paths)
    times_s = [time.monotonic()]

    def timed(generation: int, best: float, mean: float) -> None:
        times_s.append(time.monotonic())
        progress(generation, best, mean)

    robot = robots.get(arm.robot, arm.lengths_m)
    result = optimize([recording.positions_rad for recording in loaded], arm, robot, request, timed)
    if not result.feasible:
        least_s = result.least_duration_s
        remedy = f"give {least_s:.1f} s or more" if least_s is not None else "record steadier takes"
        what = "no path through these recordings keeps the joints' speed and acceleration limits"
        raise RequestRefused("LIMITS", f"{what} in {request.duration_s:g} s; {remedy}")
    ga, exact, free = result.ga, result.exact, result.free
    return {
        "baseline": [{"name": take.name, **asdict(error)} for take, error in zip(loaded, result.baseline, strict=True)],
        "best_take_mm": min(error.mean_error_mm for error in result.baseline),
        "ga": {
            **named(ga.path, "mean_error_mm", "max_error_mm"),
            **named(ga, "generations", "evaluations"),
            "evaluations_per_s": ga.evaluations / max(times_s[-1] - times_s[0], 1e-9),
            **named(ga.path, "feasible", "tool_m"),
        },
        "exact": named(exact, "mean_error_mm", "max_error_mm", "tool_m"),
        "gap_ratio": result.gap_ratio,
        "free": free and named(free, "mean_error_mm", "max_error_mm", "largest_offset_rad", "feasible", "tool_m"),
        "plans": [
            named(plan, "via", "predicted_mean_error_mm", "predicted_max_error_mm", "duration_s")
            | _expected(job, robot.chain, plan)
            | {"text": plan_to_text(plan)}
            for plan in result.plans
        ],
        "history": {key: list(getattr(ga, key)) for key in ("best_cost_mm", "mean_cost_mm")},
    }


def _expected(job: OptimizeJob, chain: SerialChain, plan: Plan) -> dict[str, Any]:
    """What the arm will make of a plan; `sag_model`: whether its own lag is foreseen, not that of a new arm."""
    mean_mm, max_mm = expected_mm(job.arm, chain, plan, job.model)
    known = job.model is not None and job.arm.correction
    return {"sag_model": known, "expected_mean_error_mm": mean_mm, "expected_max_error_mm": max_mm}
