"""A plan that is run, and corrected by further runs, on an arm that serves people.

Rules.
1. What is learnt and what is kept stands in `trajectory/refinement.py`; computing waits in a thread, not in the loop.
2. All of it is one request and one lease. Anybody may stop or pause it, in a run or between two.
3. Each run is a recording. The best plan so far is a file as soon as it is known, so whatever ends the refinement,
   a client that leaves included, nothing is lost: once there is one whole run, the answer tells what was reached.
4. The time of a reading is the plan's, not the clock's: it does no harm that the arm waited a few ticks for a servo. A
   run that `waited_long` (paused, or slowed down) is repeated, not learnt from.
"""

import asyncio
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import LogError, RequestRefused
from armctl.host.host import Host
from armctl.host.lease import Client, Lease
from armctl.host.motions import line_result, plan_note, run_leg
from armctl.host.watch import Done
from armctl.recording.disk import put
from armctl.trajectory.course import course_of
from armctl.trajectory.plan import Plan, plan_to_text
from armctl.trajectory.refinement import Measured, Refinement, Round, following, seen_mm, waited_long

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
        return await _Job(host, lease, plan, further, folder, corrected).done()


class _Job:
    def __init__(self, host: Host, lease: Lease, plan: Plan, further: int, folder: Path, corrected: bool) -> None:
        self.host, self.lease, self.plan, self.corrected = host, lease, plan, corrected
        self.runs, self.most = 0, 1 + further
        self.work: Refinement | None = None
        # The answer of each run, by its recording.
        self.results: dict[str, dict[str, Any]] = {}
        self.path = folder / f"refined-via-{plan.via}-{datetime.now(UTC):%Y%m%dT%H%M%S.%f}Z.json"
        self.kept: Plan | None = None

    async def done(self) -> dict[str, Any]:
        """Everything; the answer."""
        first = await self._measured(self.plan)
        self._keep(self.plan)
        work = self.work = await asyncio.to_thread(self._begun, first)
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
                self._keep(work.best.plan)
        except RequestRefused as refusal:
            ended = {"code": refusal.code, "text": str(refusal)}
        self._tell(work)
        result = self.results[work.best.runs[-1].recording]
        answer = {**result, "rounds": [self._row(one) for one in work.rounds], "plan": str(self.path), "ended": ended}
        self.host.note({"event": "REFINED", "rounds": answer["rounds"], "plan": answer["plan"], "ended": ended})
        return answer

    def _begun(self, first: Measured) -> Refinement:
        one = Round(0, course_of(self.host, self.plan), self.plan, (first,), (), self.corrected)
        one = replace(one, run_mm=(seen_mm(self.host, one, first),))
        return Refinement(self.host, one, self.most - 1, further=self.most - self.runs)

    async def _measured(self, plan: Plan) -> Measured:
        """A run of the plan that nothing disturbed.

        Raises:
            RequestRefused: the plan may not run, was stopped or failed, or every run was disturbed.
        """
        for _ in range(min(TRIES, self.most - self.runs)):
            self.runs += 1
            legs, note = [run_leg(self.host, plan, corrected=self.corrected)], plan_note(plan, corrected=self.corrected)
            name, [done] = await self.host.carry_out(self.lease, legs, note)
            result = self.results[name] = {"recording": name, **line_result(plan, done, self.host.robot)}
            if not waited_long(plan, result["duration_s"], self.host.period_s):
                return measured(name, done)
            if self.work is not None:
                self.work.lost()
        raise RequestRefused(
            "DISTURBED",
            f"the run took {result['duration_s']:.2f} s instead of {plan.duration_s:.2f} s: it was paused, or servos "
            "miss readings and the arm waits for them; see `armctl doctor`",
        )

    def _tell(self, work: Refinement) -> None:
        row = self._row(work.rounds[-1])
        self.lease.client.notify("progress", {"runs": self.runs, "of": self.most, "round": row})

    def _row(self, one: Round) -> dict[str, Any]:
        results = [self.results[run.recording] for run in one.runs]
        return {
            "round": one.number,
            **{key: float(np.mean([result[key] for result in results])) for key in ("mean_error_mm", "max_error_mm")},
            "kept": one.kept,
            "recordings": [result["recording"] for result in results],
        }

    def _keep(self, plan: Plan) -> None:
        """Write the best plan, in place of the one before it."""
        if plan is not self.kept:
            put(self.path, plan_to_text(plan))
        self.kept = plan


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
