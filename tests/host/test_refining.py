"""Runs that correct a plan, on an arm that serves people."""

import asyncio
import json
from collections.abc import Callable, Coroutine
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl.errors import LogError
from armctl.host.motions import move, run
from armctl.host.refining import measured, refine, refine_path
from armctl.host.watch import Done, Watch
from armctl.kinematics.chain import tool_position
from armctl.messages import JointTrajectory, Mode, Reply, Run
from armctl.trajectory.plan import Plan, plan_from_text
from armctl.trajectory.refinement import Measured
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.tool_path import PathRequest
from tests.host.bench import Bench
from tests.host.doubles import refused
from tests.host.simulated import on_arm
from tests.trajectory.test_refinement import Scripted, first


def line_plan(bench: Bench, **changes: object) -> Plan:
    """A short plan whose line leads from its own first point to its last."""
    plan, chain = bench.plan(**changes), bench.arm.robot.chain
    ends = tool_position(chain, np.array([plan.waypoints_rad[0], plan.waypoints_rad[-1]])[:, : chain.n])
    return plan.model_copy(update=dict(zip(("from_m", "to_m"), map(tuple, ends.tolist()), strict=True)))


SHORT_PATH = PathRequest(points_m=((0.18, -0.02, 0.15), (0.18, 0.02, 0.15)), duration_s=2.0)
Work = Callable[[Bench, Path], Coroutine[Any, Any, dict[str, Any]]]


def of_plan(bench: Bench, folder: Path) -> Coroutine[Any, Any, dict[str, Any]]:
    return refine(bench.host, bench.anna, line_plan(bench), 2, folder)


def of_path(bench: Bench, folder: Path) -> Coroutine[Any, Any, dict[str, Any]]:
    return refine_path(bench.host, bench.anna, SHORT_PATH, 2, folder)


EITHER = pytest.mark.parametrize("work", [of_plan, of_path])


def of_first_run(work: Work, result: dict[str, Any], folder: Path) -> bool:
    """Whether the first run's plan is what was kept; of a path, which the client has as a file, nothing."""
    rounds, files = [row["round"] for row in result["rounds"] if row["kept"]], list(folder.iterdir())
    if work is of_path:
        return (rounds, result["plan"], files) == ([0], None, [])
    kept = plan_from_text(Path(result["plan"]).read_text(encoding="utf-8"), "kept")
    return (rounds, [result["plan"]], kept.duration_s) == ([0], list(map(str, files)), 2.0)


async def refining(bench: Bench, folder: Path, work: Work = of_plan) -> asyncio.Task[dict[str, Any]]:
    """Anna's refinement, its first run over and the second under way."""
    task = asyncio.ensure_future(work(bench, folder))
    await bench.until(lambda: runs(bench) == 2 and bench.arm.mode() is Mode.MOVING)
    return task


def runs(bench: Bench) -> int:
    return sum(isinstance(command, Run) for command in bench.control.commands)


async def test_a_refinement_says_what_a_run_says_and_every_round_and_keeps_the_plan(
    bench: Bench, tmp_path: Path
) -> None:
    plain = await bench.served(run(bench.host, bench.anna, line_plan(bench)))
    result = await bench.served(refine(bench.host, bench.anna, line_plan(bench), 2, tmp_path))
    assert plain.keys() | {"rounds", "plan", "ended"} == result.keys()
    assert result["ended"] is None
    assert [row["round"] for row in result["rounds"]] == list(range(len(result["rounds"])))
    assert result["rounds"][0]["kept"]
    kept = [row for row in result["rounds"] if row["kept"]][-1]
    assert result["recording"] == kept["recordings"][-1]
    made = [name for row in result["rounds"] for name in row["recordings"]]
    assert 2 <= len(made) == len(bench.recorder.takes) - 1 <= 3
    plan = plan_from_text(Path(result["plan"]).read_text(encoding="utf-8"), "plan")
    assert (plan.via, plan.duration_s, plan.arm_id) == (0, 2.0, bench.arm.arm.arm_id)
    assert [path.name for path in tmp_path.iterdir()] == [Path(result["plan"]).name]
    assert [params["of"] for _, params in bench.anna.told] == [3] * len(bench.anna.told)
    assert bench.anna.told[0][1]["round"] == result["rounds"][0]
    assert bench.anna.told[-1][1] == {"runs": len(made), "of": 3, "round": result["rounds"][-1]}


async def test_every_recording_of_a_run_holds_the_plan_it_was_a_run_of(bench: Bench, tmp_path: Path) -> None:
    plan = line_plan(bench)
    await bench.served(run(bench.host, bench.anna, plan))
    result = await bench.served(refine(bench.host, bench.anna, plan, 1, tmp_path))
    notes = [note for note in map(json.loads, bench.recorder.notes) if note.get("event") == "PLAN"]
    assert len(notes) == 1 + sum(len(row["recordings"]) for row in result["rounds"])
    assert all(note["corrected"] for note in notes)
    assert [Plan.model_validate(note["plan"]) for note in notes[:2]] == [plan, plan]


async def test_the_arm_is_the_refiner_s_until_its_last_run(bench: Bench, tmp_path: Path) -> None:
    task = await refining(bench, tmp_path)
    there = MoveRequest(joints_rad=bench.arm.positions_rad())
    with refused("BUSY"):
        await move(bench.host, bench.ben, there)
    await bench.served(task)
    assert bench.host.leases.current is None


@EITHER
async def test_a_stop_keeps_what_was_reached(bench: Bench, tmp_path: Path, work: Work) -> None:
    task = await refining(bench, tmp_path, work)
    await bench.served(bench.host.stop())
    result = await bench.served(task)
    assert result["ended"]["code"] == "STOPPED"
    assert [row["round"] for row in result["rounds"]] == [0]
    assert of_first_run(work, result, tmp_path)
    assert bench.arm.mode() is Mode.HOLDING
    assert len(bench.recorder.takes) == 2, "what was recorded of the run that was stopped is kept"


@EITHER
async def test_a_full_disk_keeps_what_was_reached(bench: Bench, tmp_path: Path, work: Work) -> None:
    task = await refining(bench, tmp_path, work)

    def full() -> None:
        raise LogError("the disk is full")

    bench.recorder.on_begin = full
    result = await bench.served(task)
    assert result["ended"] == {"code": "LOG", "text": "the disk is full"}
    assert of_first_run(work, result, tmp_path)


@EITHER
async def test_a_stop_in_the_first_run_is_told_as_that_of_a_run(bench: Bench, tmp_path: Path, work: Work) -> None:
    task = asyncio.ensure_future(work(bench, tmp_path))
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    await bench.served(bench.host.stop())
    await bench.refused(task, "STOPPED")
    assert not list(tmp_path.iterdir())


@EITHER
async def test_a_client_that_leaves_stops_the_arm_and_its_plan_is_in_the_log(
    bench: Bench, tmp_path: Path, work: Work
) -> None:
    task = await refining(bench, tmp_path, work)
    bench.host.client_gone(bench.anna)
    result = await bench.served(task)
    assert result["ended"]["code"] in ("STOPPED", "LEASE_LOST")
    noted = [note for note in map(json.loads, bench.recorder.notes) if note["event"] == "REFINED"]
    assert [note["plan"] for note in noted] == [result["plan"]]
    assert bench.host.leases.current is None


async def test_of_a_path_that_no_correction_made_better_no_file_is_written(bench: Bench, tmp_path: Path) -> None:
    result = await bench.served(refine_path(bench.host, bench.anna, SHORT_PATH, 2, tmp_path))
    assert [row["kept"] for row in result["rounds"]] == [True, False, False]
    assert result["recording"] == result["rounds"][0]["recordings"][0]
    assert result["plan"] is None
    assert not list(tmp_path.iterdir())


async def test_a_refinement_that_is_paused_between_runs_waits_for_resume(bench: Bench, tmp_path: Path) -> None:
    task = asyncio.ensure_future(refine(bench.host, bench.anna, line_plan(bench), 1, tmp_path))
    begin_take = bench.recorder.begin_take
    paused: list[asyncio.Task[dict[str, Any]]] = []

    def begin(name: str) -> Path:
        if bench.recorder.takes:
            paused.append(asyncio.ensure_future(bench.host.pause()))
        return begin_take(name)

    bench.recorder.begin_take = begin  # type: ignore[method-assign]
    await bench.until(lambda: bool(paused) and paused[0].done())
    bench.ticks(50)
    for _ in range(5):
        await asyncio.sleep(0)
    bench.ticks(50)
    assert runs(bench) == 1
    await bench.host.resume(bench.anna)
    assert (await bench.served(task))["ended"] is None
    assert runs(bench) == 2


async def test_a_run_that_was_paused_is_not_learnt_from_but_repeated(bench: Bench, tmp_path: Path) -> None:
    task = await refining(bench, tmp_path)
    await bench.until(lambda: any(e.code == "PLAN_BEGIN" for e in bench.recorder.records[-1].outputs.events))
    await bench.served(bench.host.pause())
    bench.ticks(20)
    await bench.served(bench.host.resume(bench.anna))
    result = await bench.served(task)
    assert runs(bench) == 3
    assert result["ended"] is None
    assert [len(row["recordings"]) for row in result["rounds"]] == [1, 1]


def test_a_run_that_waited_a_few_ticks_tells_the_same_by_where_in_its_plan_it_was() -> None:
    """Of ticks in which it waited, the first reading counts; of servos that were not heard, none."""
    way = JointTrajectory(0.1, ((0.0,),) * 31, begin_s=1.0, end_s=3.0)
    due_s = np.arange(1, 31) * 0.1

    def seen(due_s: np.ndarray, silent: tuple[int, ...] = ()) -> Measured:
        time_ns = [10**9 + 10**8 * k for k in range(len(due_s))]
        watch = Watch(time_ns=time_ns, stamps_ns=[(at + 4_000_000, at + 6_000_000) for at in time_ns])
        watch.positions_rad = [(at * at, -at) for at in due_s.tolist()]
        watch.progress = (due_s / 3.0).tolist()
        watch.fresh = [(True, k not in silent) for k in range(len(due_s))]
        watch.marks_ns = {"PLAN_BEGIN": time_ns[9], "PLAN_END": time_ns[-1]}
        return measured("run", Done(way, watch, Reply(1, ok=True)))

    plain = seen(due_s)
    assert plain.time_s == pytest.approx(due_s[9:] - due_s[9] + 0.005)
    assert plain.positions_rad[:, 1] == pytest.approx(-due_s[9:])
    assert plain.duration_s == pytest.approx(2.0)
    waited = seen(np.insert(due_s, 15, [due_s[14]] * 2), silent=(15,))
    assert waited.time_s == pytest.approx(plain.time_s)
    assert waited.positions_rad == pytest.approx(plain.positions_rad)
    assert waited.duration_s == pytest.approx(2.2)
    unheard = seen(due_s, silent=(15,))
    assert unheard.time_s == pytest.approx(np.delete(plain.time_s, 6))


async def test_a_plan_of_another_arm_is_refused_as_by_run(bench: Bench, tmp_path: Path) -> None:
    await bench.refused(refine(bench.host, bench.anna, bench.plan(arm_id="other"), 1, tmp_path), "PREFLIGHT")
    assert not list(tmp_path.iterdir())


async def test_a_simulated_arm_that_nothing_corrects_gets_straight(tmp_path: Path) -> None:
    async with on_arm("ax12-line", seed=3) as bench:
        plan = first(Scripted(0.0), via=1).plan
        result = await bench.served(refine(bench.host, bench.anna, plan, 2, tmp_path, corrected=False))
        before, *_, after = (row["mean_error_mm"] for row in result["rounds"] if row["kept"])
        assert after < 0.4 * before
