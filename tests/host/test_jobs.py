"""Jobs in a process of their own: results, progress, errors with their fields, cancelling; and the optimisation."""

import asyncio
import os
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from armctl.errors import ConfigError, LogError, RequestRefused
from armctl.genetic.algorithm import DEFAULT
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import Progress
from armctl.host.jobs import INDIVIDUAL_BYTES, JOB_BYTES, OptimizeJob, optimize_task, run_job
from armctl.trajectory.plan import plan_from_text
from tests.genetic import hand
from tests.host.doubles import refused, write_take

PATIENCE_S = 60.0

# What a job does, by its argument; tasks must be found by name in the spawned process.


def task(what: str, progress: Progress) -> dict[str, Any]:
    for generation in range(1, 2000):
        progress(generation, 2.0, 3.0)
    match what:
        case "result":
            return {"pid": os.getpid(), "session": os.getsid(0)}
        case "refuse":
            raise RequestRefused("BAD_LINE", ["too short", "too low"])
        case "misconfigure":
            raise ConfigError("plan", "via", "too many", "take fewer")
        case "break":
            raise ZeroDivisionError("a defect")
        case "die":
            os.kill(os.getpid(), signal.SIGKILL)
        case "swallow":
            return {"filled": len(bytearray(2 * JOB_BYTES))}
        case "hang":
            signal.pause()
    raise AssertionError(what)


async def test_a_job_runs_elsewhere_and_its_progress_is_rare() -> None:
    seen: list[tuple[int, float, float]] = []
    async with asyncio.timeout(PATIENCE_S):
        result = await run_job(task, "result", lambda *values: seen.append(values))
    assert result["pid"] != os.getpid()
    assert result["session"] == result["pid"], "the daemon's session goes before others, and no job with it"
    assert seen[0] == (1, 2.0, 3.0)
    assert len(seen) < 50


@pytest.mark.parametrize(
    ("what", "kind", "fields"),
    [
        ("refuse", RequestRefused, {"code": "BAD_LINE", "reasons": ("too short", "too low")}),
        ("misconfigure", ConfigError, {"file": "plan", "key": "via", "remedy": "take fewer"}),
        ("break", RequestRefused, {"code": "JOB_FAILED"}),
        ("die", RequestRefused, {"code": "JOB_FAILED"}),
        ("swallow", RequestRefused, {"code": "TOO_LARGE"}),
    ],
)
async def test_a_job_s_error_is_raised_with_its_fields(
    what: str, kind: type[Exception], fields: dict[str, Any]
) -> None:
    with pytest.raises(kind) as caught:
        async with asyncio.timeout(PATIENCE_S):
            await run_job(task, what, lambda *_: None)
    assert vars(caught.value) | fields == vars(caught.value)
    assert str(caught.value)


async def test_cancelling_ends_the_process() -> None:
    """A process that was not ended and joined would leave a ResourceWarning, an error here."""
    begun = asyncio.Event()
    work = asyncio.create_task(run_job(task, "hang", lambda *_: begun.set()))
    async with asyncio.timeout(PATIENCE_S):
        await begun.wait()
        work.cancel()
        with pytest.raises(asyncio.CancelledError):
            await work


# -------------------------------------------------------------------------------------------- optimisation

SETTINGS = replace(DEFAULT, population=40, generations=12)


def job(folder: Path, count: int = 3, duration_s: float = 6.0) -> OptimizeJob:
    paths = []
    for number, samples in enumerate(hand.recordings(count, seed=1)):
        paths.append(folder / f"take-{number}.mcap")
        if not paths[-1].exists():
            write_take(paths[-1], samples, hand.arm())
    from_m, to_m = tuple(hand.A.tolist()), tuple(hand.B.tolist())
    request = OptimizeRequest(from_m=from_m, to_m=to_m, via=(0, 2), duration_s=duration_s, seed=3, settings=SETTINGS)
    return OptimizeJob(hand.arm(), tuple(paths), request)


def test_an_optimisation_says_everything_the_contract_names(tmp_path: Path) -> None:
    asked = job(tmp_path)
    seen: list[tuple[int, float, float]] = []
    result = optimize_task(asked, lambda *values: seen.append(values))
    assert [generation for generation, _, _ in seen] == list(range(1, 13))
    assert [entry["name"] for entry in result["baseline"]] == ["take-0", "take-1", "take-2"]
    assert result["ga"]["generations"] == 12
    assert result["ga"]["evaluations"] > 0
    assert result["ga"]["evaluations_per_s"] > 0.0
    assert result["ga"]["mean_error_mm"] < min(entry["mean_error_mm"] for entry in result["baseline"])
    assert result["best_take_mm"] == min(entry["mean_error_mm"] for entry in result["baseline"])
    assert result["gap_ratio"] >= 0.0
    for entry in result["plans"]:
        assert entry["sag_model"] is False
        assert (
            0.95 * entry["predicted_mean_error_mm"] < entry["expected_mean_error_mm"] < entry["expected_max_error_mm"]
        )
    assert result["exact"]["mean_error_mm"] > 0.0
    assert [entry["via"] for entry in result["plans"]] == [0, 2]
    for entry in result["plans"]:
        plan = plan_from_text(entry["text"], "plan")
        assert (plan.via, plan.seed, plan.duration_s) == (entry["via"], 3, 6.0)
        assert plan.predicted_mean_error_mm == entry["predicted_mean_error_mm"]
    assert len(result["history"]["best_cost_mm"]) == len(result["history"]["mean_cost_mm"]) == 12


async def test_an_optimisation_repeats_itself_elsewhere(tmp_path: Path) -> None:
    asked = job(tmp_path)
    here = optimize_task(asked, lambda *_: None)
    async with asyncio.timeout(PATIENCE_S):
        there = await run_job(optimize_task, asked, lambda *_: None)
    del here["ga"]["evaluations_per_s"], there["ga"]["evaluations_per_s"]
    assert here == there


def test_an_optimisation_that_cannot_fit_is_refused_before_it_reads_anything(tmp_path: Path) -> None:
    most = JOB_BYTES // INDIVIDUAL_BYTES
    asked = job(tmp_path)
    settings = replace(asked.request.settings, population=most + 1)
    asked = asked._replace(paths=(), request=asked.request.model_copy(update={"settings": settings}))
    with refused("TOO_LARGE", str(most)):
        optimize_task(asked, lambda *_: None)


def test_recordings_of_another_arm_are_refused_each_by_name(tmp_path: Path) -> None:
    asked = job(tmp_path, count=2)
    other = asked._replace(arm=asked.arm.model_copy(update={"arm_id": "other"}))
    with refused("FOREIGN_LOG") as caught:
        optimize_task(other, lambda *_: None)
    assert [reason.split()[1] for reason in caught.value.reasons] == ["take-0", "take-1"]


def test_a_missing_recording_is_a_log_error(tmp_path: Path) -> None:
    asked = job(tmp_path, count=1)._replace(paths=(tmp_path / "none.mcap",))
    with pytest.raises(LogError):
        optimize_task(asked, lambda *_: None)


def test_limits_that_contradict_the_duration_are_refused_with_one_that_does_not(tmp_path: Path) -> None:
    asked = job(tmp_path, duration_s=0.6)
    with refused("LIMITS", r"in 0\.6 s; give (\d+\.\d) s or more") as caught:
        optimize_task(asked, lambda *_: None)
    least_s = float(str(caught.value).split("give ")[1].split()[0])
    assert optimize_task(job(tmp_path, duration_s=least_s), lambda *_: None)["ga"]["mean_error_mm"] > 0.0
