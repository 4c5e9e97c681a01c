"""A plan or a path that is run, and corrected by further runs, on an arm that serves people.

Rules.
1. What is learnt of a plan and when it is kept stands in `trajectory/refinement.py`, what is learnt of a path in
   `trajectory/path_motion.py`; computing waits in a thread, not in the loop.
2. All of it is one request and one lease. Anybody may stop or pause it, in a run or between two.
3. Each run is a recording. The best plan so far is a file as soon as it is known, a path as soon as a correction made
   it better. So whatever ends the refinement, a client that leaves included, nothing is lost: once there is one whole
   run, the answer tells what was reached.
4. The time of a reading is the plan's, not the clock's: it does no harm that the arm waited a few ticks for a servo. A
   run that `waited_long` (paused, or slowed down) is repeated, not learnt from.
"""

import asyncio
from collections.abc import Callable, Sequence
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.config import Frozen
from armctl.errors import LogError, RequestRefused
from armctl.host.host import Host
from armctl.host.lease import Client, Lease
from armctl.host.motions import line_result, path_leg, path_note, path_result, plan_note, run_leg
from armctl.host.watch import Done, Leg
from armctl.recording.disk import put
from armctl.trajectory import refinement
from armctl.trajectory.course import course_of
from armctl.trajectory.path_motion import PathSeen, path_seen, relearnt
from armctl.trajectory.plan import Plan, plan_to_text
from armctl.trajectory.refinement import Measured, Refinement, Round, following, waited_long, with_run
from armctl.trajectory.tool_path import PathRequest

MOST_FURTHER = 20
# Runs in a row that may be disturbed.
TRIES = 3
# Less than this is no progress.
SAME_S = 1e-3


async def refine(
    host: Host, client: Client, plan: Plan, further: int, folder: Path, *, corrected: bool = True
) -> dict[str, Any]:
    """Run a plan, and correct it by at most so many further runs.

    Args:
        folder: Where the best plan is kept, as a new file.
    Raises:
        RequestRefused: as `run`, of the first run; later ones only end the refinement.
        LogError: the first run's recording or the plan cannot be written.
    """
    with host.leases.commanding(client, "run") as lease:
        return await _OfPlan(host, lease, further, folder, f"via-{plan.via}").done(plan, corrected)


async def refine_path(host: Host, client: Client, request: PathRequest, further: int, folder: Path) -> dict[str, Any]:
    """Lead the tool along a path, and correct it by at most so many further runs; else as `refine`.

    Args:
        folder: Where the best correction is kept, as a new file; without one that is better there is none.
    """
    with host.leases.commanding(client, "path") as lease:
        return await _OfPath(host, lease, further, folder, "path").done(request)


class _Runs:
    """What is run under one lease, and what is kept of it."""

    def __init__(self, host: Host, lease: Lease, further: int, folder: Path, what: str) -> None:
        self.host, self.lease = host, lease
        self.runs, self.most = 0, 1 + further
        # The answer of each run, by its recording.
        self.results: dict[str, dict[str, Any]] = {}
        self.path = folder / f"refined-{what}-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}Z.json"
        self.kept: Frozen | None = None
        # The file of what is kept; None: there is none.
        self.file: str | None = None

    async def run(self, leg: Leg, note: dict[str, Any], result_of: Callable[[Done], dict[str, Any]]) -> Measured:
        """A run that nothing disturbed.

        Raises:
            RequestRefused: it may not run, was stopped or failed, or every run was disturbed.
        """
        for _ in range(min(TRIES, self.most - self.runs)):
            self.runs += 1
            name, [done] = await self.host.carry_out(self.lease, [leg], note)
            result = self.results[name] = {"recording": name, **result_of(done)}
            wanted_s = done.trajectory.end_s - done.trajectory.begin_s
            if not waited_long(wanted_s, result["duration_s"], self.host.period_s):
                return measured(name, done)
        why = "it was paused, or servos miss readings and the arm waits for them; see `armctl doctor`"
        took = f"the run took {result['duration_s']:.2f} s instead of {wanted_s:.2f} s"
        raise RequestRefused("DISTURBED", f"{took}: {why}")

    def tell(self, row: dict[str, Any]) -> None:
        self.lease.client.notify("progress", {"runs": self.runs, "of": self.most, "round": row})

    def row(self, number: int, kept: bool, runs: Sequence[Measured]) -> dict[str, Any]:
        results = [self.results[run.recording] for run in runs]
        return {
            "round": number,
            **{key: float(np.mean([result[key] for result in results])) for key in ("mean_error_mm", "max_error_mm")},
            "kept": kept,
            "recordings": [result["recording"] for result in results],
        }

    def keep(self, what: Frozen) -> None:
        """Write the best so far, in place of the one before it."""
        if what is not self.kept:
            put(self.path, plan_to_text(what))
            self.kept, self.file = what, str(self.path)

    def answer(self, best: Measured, rows: list[dict[str, Any]], ended: RequestRefused | None) -> dict[str, Any]:
        told = {"rounds": rows, "plan": self.file, "ended": ended and {"code": ended.code, "text": str(ended)}}
        self.host.note({"event": "REFINED", **told})
        return self.results[best.recording] | told


class _OfPath(_Runs):
    async def done(self, request: PathRequest) -> dict[str, Any]:
        """Everything; the answer."""
        host, rows, self.kept = self.host, list[dict[str, Any]](), request
        best: tuple[float, PathRequest, Measured] | None = None
        seen, ended, unkept = list[PathSeen](), None, 0
        while self.runs < self.most and unkept < refinement.PATIENCE:
            leg, made = path_leg(host, request)
            try:
                run = await self.run(leg, path_note(request), partial(path_result, made, host.robot))
                seen.append(await asyncio.to_thread(path_seen, request, made[-1], run, host))
                kept = best is None or seen[-1].off_mm + 2.0**0.5 * refinement.NOISE_MM < best[0]
                best, unkept = ((seen[-1].off_mm, request, run), 0) if best is None or kept else (best, unkept + 1)
                rows.append(self.row(len(rows), kept, [run]))
                self.keep(best[1])
            except (RequestRefused, LogError) as error:
                if best is None:
                    raise
                ended = error if isinstance(error, RequestRefused) else RequestRefused("LOG", str(error))
                break
            self.tell(rows[-1])
            gain = refinement.GAINS[0] * refinement.LESS**unkept
            request = await asyncio.to_thread(relearnt, request, made[-1], seen, host, gain)
        assert best is not None
        return self.answer(best[2], rows, None if ended and ended.code in refinement.ASTRAY else ended)


class _OfPlan(_Runs):
    async def done(self, plan: Plan, corrected: bool) -> dict[str, Any]:
        """Everything; the answer."""
        self.plan, self.corrected = plan, corrected
        first = await self._measured(self.plan)
        self.keep(self.plan)
        work = await asyncio.to_thread(self._begun, first)
        steps, ended = work.steps(), None
        try:
            one = await asyncio.to_thread(following, steps)
            while one is not None:
                self._tell(work)
                try:
                    told: Measured | RequestRefused = await self._measured(one.plan)
                except RequestRefused as refusal:  # it ends the refinement, and is told unless the plan is astray
                    told = refusal
                except LogError as error:  # what was reached is no worse for it
                    raise RequestRefused("LOG", str(error)) from None
                one = await asyncio.to_thread(following, steps, told)
                self.keep(work.best.plan)
        except RequestRefused as refusal:
            ended = refusal
        self._tell(work)
        rows = [self.row(one.number, one.kept, one.runs) for one in work.rounds]
        return self.answer(work.best.runs[-1], rows, ended)

    def _begun(self, first: Measured) -> Refinement:
        one = with_run(self.host, Round(0, course_of(self.host, self.plan), self.plan, self.corrected), first)
        return Refinement(self.host, one, self.most - 1, runs_left=lambda: self.most - self.runs)

    async def _measured(self, plan: Plan) -> Measured:
        host, corrected = self.host, self.corrected
        leg, note = run_leg(host, plan, corrected=corrected), plan_note(plan, corrected=corrected)
        return await self.run(leg, note, lambda done: line_result(plan, done, host.robot))

    def _tell(self, work: Refinement) -> None:
        one = work.rounds[-1]
        self.tell(self.row(one.number, one.kept, one.runs))


def measured(name: str, done: Done) -> Measured:
    """What was seen between the plan's begin and its end; of the ticks in which the arm waited, the first counts."""
    watch, way = done.watch, done.trajectory
    begin_ns, end_ns = watch.marks_ns["PLAN_BEGIN"], watch.marks_ns["PLAN_END"]
    time_ns, progress = np.array(watch.time_ns), np.array(watch.progress)
    inside = np.flatnonzero((begin_ns <= time_ns) & (time_ns <= end_ns))
    goes_on = np.diff(progress[inside], prepend=-1.0) * way.duration_s > SAME_S
    k = inside[goes_on & np.array(watch.fresh)[inside].all(axis=1)]
    read_s = (np.array(watch.stamps_ns)[k].mean(axis=1) - time_ns[k]) / NS_PER_S
    at_s = (progress[k] - progress[inside[0]]) * way.duration_s + read_s
    return Measured(at_s, np.array(watch.positions_rad)[k], (end_ns - begin_ns) / NS_PER_S, name)
