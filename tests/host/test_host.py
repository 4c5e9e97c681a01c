"""The arm as its clients share it: leases, requests, runs and the snapshot, over ideal servos, on a virtual clock."""

from __future__ import annotations

import asyncio
import json
import math
from collections.abc import Awaitable, Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from armctl.clock import VirtualClock
from armctl.control.link import Link
from armctl.dynamixel import ax12a
from armctl.errors import IllegalTransition, LogError, RequestRefused
from armctl.host import exchange
from armctl.host import host as host_module
from armctl.host.host import Host
from armctl.kinematics.chain import forward_kinematics, tool_position
from armctl.kinematics.transform import rpy_from_matrix
from armctl.messages import Hold, Mode, Reply, Run, TeachEnd, TickRecord
from armctl.trajectory.plan import Plan
from armctl.trajectory.target import MoveRequest
from tests.control.ideal_arm import PERIOD_S, IdealArm
from tests.host.doubles import IdealControl, InlineExecutor, MemoryRecorder, NamedClient, small_plan


class Bench:
    """A host over ideal servos; `tick` is one tick, `served` ticks until something is done."""

    def __init__(self, **calibration: Any) -> None:
        self.clock = VirtualClock()
        self.recorder = MemoryRecorder()
        self.control = IdealControl(self.clock)
        self.arm = self.control.arm
        self.host = Host(
            self.arm.arm.model_copy(update=calibration), self.arm.robot, PERIOD_S, self.recorder, self.clock
        )
        self.host.attach(self.control)
        self.anna, self.ben = NamedClient("anna"), NamedClient("ben")

    def tick(self, **changes: Any) -> TickRecord:
        record = replace(self.control.tick(), **changes)
        self.host.receive(record)
        return record

    async def until(self, condition: Callable[[], bool]) -> None:
        for _ in range(5_000):
            if condition():
                return
            await asyncio.sleep(0)
            self.tick()
        raise AssertionError("it never came to pass")

    async def served(self, work: Awaitable[dict[str, Any]]) -> dict[str, Any]:
        task = asyncio.ensure_future(work)
        await asyncio.sleep(0)
        await self.until(task.done)
        return task.result()

    async def beat(self, client: NamedClient, *, begin: bool = False, **velocity: tuple[float, ...]) -> dict[str, Any]:
        """One heartbeat of a jog and the tick that answers it, and no tick more."""
        turn, lead = velocity.get("turn", ()), velocity.get("lead", ())
        task = asyncio.ensure_future(self.host.jog(client, turn, lead, begin))
        for _ in range(5):
            await asyncio.sleep(0)
        if not task.done():
            self.tick()
        return await task

    async def refused(self, work: Awaitable[dict[str, Any]]) -> RequestRefused:
        with pytest.raises(RequestRefused) as caught:
            await self.served(work)
        return caught.value

    async def holding(self) -> Bench:
        self.tick()
        self.tick()
        assert await self.served(self.host.command(self.anna, "torque_on")) == {"state": "holding"}
        return self

    def plan(self, **changes: object) -> Plan:
        return small_plan(self.arm, **changes)

    async def running(self) -> asyncio.Task[dict[str, Any]]:
        """Anna's run, under way."""
        task = asyncio.ensure_future(self.host.run(self.anna, self.plan()))
        await self.until(lambda: self.arm.mode() is Mode.MOVING)
        return task


def on_bench(test: Callable[[Bench], Awaitable[None]]) -> Callable[[], None]:
    """Run an async test on a fresh bench."""

    def wrapper() -> None:
        asyncio.run(run(test))

    wrapper.__name__ = test.__name__
    return wrapper


async def run(test: Callable[[Bench], Awaitable[None]], **calibration: Any) -> None:
    bench = Bench(**calibration)
    asyncio.get_running_loop().set_default_executor(InlineExecutor())
    try:
        await test(bench)
    finally:
        bench.control.die()
        bench.control.link.close()


# ---------------------------------------------------------------------------------------------- requests


@on_bench
async def test_torque_on_is_answered_when_the_arm_holds(bench: Bench) -> None:
    await bench.holding()
    assert bench.arm.mode() is Mode.HOLDING


@on_bench
async def test_a_refusal_of_the_control_step_reaches_the_client_as_it_is(bench: Bench) -> None:
    await bench.holding()
    error = await bench.refused(bench.host.command(bench.anna, "torque_on"))
    assert isinstance(error, IllegalTransition)
    assert "holding" in str(error)


@on_bench
async def test_release_makes_the_arm_limp(bench: Bench) -> None:
    await bench.holding()
    assert await bench.served(bench.host.command(bench.anna, "release")) == {"state": "off"}


@on_bench
async def test_park_is_answered_when_the_arm_is_limp_at_rest(bench: Bench) -> None:
    await bench.holding()
    assert await bench.served(bench.host.command(bench.anna, "park")) == {"state": "off"}


@on_bench
async def test_a_client_that_leaves_during_its_park_stops_the_arm(bench: Bench) -> None:
    await bench.holding()
    task = asyncio.ensure_future(bench.host.run(bench.anna, bench.plan()))
    await bench.until(task.done)
    task = asyncio.ensure_future(bench.host.command(bench.anna, "park"))
    await bench.until(lambda: bench.arm.mode() is Mode.PARKING)
    bench.host.client_gone(bench.anna)
    assert (await bench.refused(task)).code == "STOPPED"
    assert bench.arm.mode() is Mode.HOLDING


@on_bench
async def test_clear_without_a_fault_is_done(bench: Bench) -> None:
    bench.tick()
    assert await bench.served(bench.host.command(bench.anna, "clear")) == {"state": "off"}


@on_bench
async def test_an_unanswered_request_fails_in_bounded_time(bench: Bench) -> None:
    bench.tick()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(exchange.Exchange.request, "__defaults__", (0.01,))
        with pytest.raises(RequestRefused) as caught:
            await bench.host.command(bench.anna, "clear")
    assert caught.value.code == "NO_ANSWER"


@on_bench
async def test_a_full_link_delays_a_command_and_loses_nothing(bench: Bench) -> None:
    bench.tick()

    class FullOnce:
        pid = 1
        link: Any

        def __init__(self, link: Link) -> None:
            self.link, self.inner, self.full = self, link, True

        def send(self, message: object) -> bool:
            full, self.full = self.full, False
            return not full and self.inner.send(message)

    bench.host.attach(FullOnce(bench.control.link))
    assert await bench.served(bench.host.command(bench.anna, "clear")) == {"state": "off"}


@on_bench
async def test_a_request_to_a_dead_control_process_fails_at_once(bench: Bench) -> None:
    bench.tick()
    bench.host.control_lost()
    for work in (bench.host.stop(), bench.host.command(bench.anna, "clear"), bench.host.run(bench.anna, bench.plan())):
        with pytest.raises(RequestRefused) as caught:
            await work
        assert caught.value.code == "RESTARTED"


@on_bench
async def test_requests_under_way_fail_when_the_control_process_dies(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    bench.host.control_lost()
    with pytest.raises(RequestRefused) as caught:
        await task
    assert caught.value.code == "RESTARTED"
    assert len(bench.recorder.takes) == 1, "the take of the broken run is kept"
    assert bench.recorder.begun is None


# --------------------------------------------------------------------------------------------------- stop


@on_bench
async def test_anyone_may_stop_a_run_and_the_run_says_so(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    assert await bench.served(bench.host.stop()) == {"state": "holding"}
    error = await bench.refused(task)
    assert error.code == "STOPPED"
    assert len(bench.recorder.takes) == 1


@on_bench
async def test_many_stops_at_once_are_one_command(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    stops = asyncio.gather(*(bench.host.stop() for _ in range(500)))
    await bench.until(stops.done)
    assert stops.result() == [{"state": "holding"}] * 500
    assert sum(isinstance(command, Hold) for command in bench.control.commands) == 1
    assert (await bench.refused(task)).code == "STOPPED"


def holds(bench: Bench) -> list[Hold]:
    """Those the control process has got, served by a tick or not."""
    bench.control.commands += bench.control.take()
    return [command for command in bench.control.commands if isinstance(command, Hold)]


async def stopped_at_rest(bench: Bench) -> None:
    """A stop, answered by the control process as soon as it gets it, if it gets any."""
    stop = asyncio.ensure_future(bench.host.stop())
    before = len(holds(bench))
    for _ in range(5):
        await asyncio.sleep(0)
    for hold in holds(bench)[before:]:
        bench.host.answer(Reply(hold.request_id, True))
    await stop


@on_bench
async def test_a_stop_of_an_arm_at_rest_waits_for_no_tick(bench: Bench) -> None:
    await bench.holding()
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 1


@on_bench
async def test_stops_close_behind_one_another_are_one_command(bench: Bench) -> None:
    await bench.holding()
    for _ in range(100):
        await stopped_at_rest(bench)
    assert len(holds(bench)) == 1
    bench.clock.advance_ns(60_000_000)
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 2


@on_bench
async def test_a_stop_after_anything_else_was_asked_is_a_command_of_its_own(bench: Bench) -> None:
    await bench.holding()
    await stopped_at_rest(bench)
    park = asyncio.ensure_future(bench.host.command(bench.anna, "park"))
    await asyncio.sleep(0)
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 2
    park.cancel()


@on_bench
async def test_a_stop_that_found_no_control_process_is_asked_again(bench: Bench) -> None:
    await bench.holding()
    control, bench.host._exchange.control = bench.host._exchange.control, None
    with pytest.raises(RequestRefused, match="started again"):
        await bench.host.stop()
    bench.host._exchange.control = control
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 1


@on_bench
async def test_a_run_that_is_stopped_while_it_is_being_checked_does_not_begin(bench: Bench) -> None:
    await bench.holding()
    stops: list[asyncio.Task[dict[str, Any]]] = []
    bench.recorder.on_begin = lambda: stops.append(asyncio.ensure_future(bench.host.stop()))
    error = await bench.refused(bench.host.run(bench.anna, bench.plan()))
    assert error.code == "STOPPED"
    await bench.until(stops[0].done)
    assert stops[0].result() == {"state": "holding"}
    assert not any(isinstance(command, Run) for command in bench.control.commands)


@on_bench
async def test_a_stop_after_a_run_was_sent_is_a_command_of_its_own(bench: Bench) -> None:
    await bench.holding()
    early = asyncio.ensure_future(bench.host.stop())
    await asyncio.sleep(0)
    bench.host._exchange.forget_hold()  # what sending a run does
    late = asyncio.ensure_future(bench.host.stop())
    await bench.until(lambda: early.done() and late.done())
    assert sum(isinstance(command, Hold) for command in bench.control.commands) == 2


# ---------------------------------------------------------------------------------------------------- run


@on_bench
async def test_a_run_is_recorded_and_compared_with_its_line(bench: Bench) -> None:
    await bench.holding()
    plan = bench.plan()
    start, end = tool_position(bench.arm.robot.chain, _chain_joints(bench.arm, plan))
    plan = bench.plan(from_m=tuple(start.tolist()), to_m=tuple(end.tolist()))
    result = await bench.served(bench.host.run(bench.anna, plan))
    assert result["recording"].startswith("run-line-via-0-")
    assert list(bench.recorder.takes) == [result["recording"]]
    # A servo resolves 0.29 deg, 1 to 2 mm at the tool; straight in joint space is not straight in space.
    assert 0.0 < result["mean_error_mm"] < result["max_error_mm"] < 10.0
    assert result["duration_s"] == pytest.approx(plan.duration_s, abs=2 * PERIOD_S)
    assert result["end_ns"] - result["begin_ns"] == pytest.approx(result["duration_s"] * 1e9)
    assert (result["predicted_mean_error_mm"], result["predicted_max_error_mm"]) == (1.5, 2.5)
    ended_ns = bench.recorder.records[-1].inputs.sample.time_ns
    assert ended_ns - result["end_ns"] >= host_module.TAIL_NS, "the recording goes on a little after the motion"


def _chain_joints(arm: IdealArm, plan: Plan) -> Any:
    return np.array(plan.waypoints_rad)[:, : arm.robot.chain.n]


@on_bench
async def test_a_refused_preflight_tells_every_reason_and_moves_nothing(bench: Bench) -> None:
    await bench.holding()
    error = await bench.refused(bench.host.run(bench.anna, bench.plan(arm_id="other", duration_s=0.05)))
    assert error.code == "PREFLIGHT"
    assert len(error.reasons) > 1
    assert "other" in error.reasons[0]
    assert not any(isinstance(command, Run) for command in bench.control.commands)
    assert not bench.recorder.takes


@on_bench
async def test_a_plan_outside_the_limits_is_refused_as_such(bench: Bench) -> None:
    await bench.holding()
    start = bench.arm.positions_rad()
    far = (math.radians(149.0), *start[1:])
    error = await bench.refused(bench.host.run(bench.anna, bench.plan(waypoints_rad=(start, far), duration_s=20.0)))
    assert error.code == "LIMIT"


@pytest.mark.parametrize("mode", [Mode.OFF, Mode.TEACHING, Mode.FAULTED, Mode.ENERGISING, Mode.MOVING])
def test_a_run_needs_a_holding_arm_and_says_how_to_get_there(mode: Mode) -> None:
    async def test(bench: Bench) -> None:
        record = bench.control.tick()
        bench.host.receive(replace(record, outputs=replace(record.outputs, mode=mode)))
        with pytest.raises(IllegalTransition, match=mode.value):
            await bench.host.run(bench.anna, bench.plan())
        assert not bench.recorder.takes

    on_bench(test)()


@on_bench
async def test_a_run_that_cannot_be_recorded_does_not_start(bench: Bench) -> None:
    await bench.holding()

    def full() -> None:
        raise LogError("the disk is full")

    bench.recorder.on_begin = full
    with pytest.raises(LogError):
        await bench.served(bench.host.run(bench.anna, bench.plan()))
    assert not any(isinstance(command, Run) for command in bench.control.commands)
    assert bench.host.status()["recording"] is None


@on_bench
async def test_a_client_that_leaves_during_its_run_stops_the_arm(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    bench.host.client_gone(bench.ben)
    assert not any(isinstance(command, Hold) for command in bench.control.commands)
    bench.host.client_gone(bench.anna)
    error = await bench.refused(task)
    assert error.code == "STOPPED"
    assert bench.arm.mode() is Mode.HOLDING
    assert any("LEASE_LOST" in note for note in bench.recorder.notes)


@on_bench
async def test_a_client_that_leaves_before_its_run_begins_moves_nothing(bench: Bench) -> None:
    await bench.holding()
    bench.recorder.on_begin = lambda: bench.host.client_gone(bench.anna)
    error = await bench.refused(bench.host.run(bench.anna, bench.plan()))
    assert error.code == "LEASE_LOST"
    assert not any(isinstance(command, Run) for command in bench.control.commands)


@on_bench
async def test_a_run_whose_marks_were_lost_is_not_given_a_figure(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    while not task.done():
        await asyncio.sleep(0)
        record = bench.control.tick()
        kept = tuple(event for event in record.outputs.events if event.code != "PLAN_BEGIN")
        bench.host.receive(replace(record, outputs=replace(record.outputs, events=kept)))
    with pytest.raises(RequestRefused) as caught:
        task.result()
    assert caught.value.code == "RECORDS_LOST"


@on_bench
async def test_a_run_that_does_not_end_is_stopped(bench: Bench) -> None:
    await bench.holding()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_module, "STUCK_S", -1e6)
        with pytest.raises(RequestRefused) as caught:
            await bench.host.run(bench.anna, bench.plan())
    assert caught.value.code == "NO_ANSWER"
    await bench.until(lambda: any(isinstance(command, Hold) for command in bench.control.commands))


# ---------------------------------------------------------------------------------------------------- move


@on_bench
async def test_a_move_to_joints_is_recorded_and_measured(bench: Bench) -> None:
    await bench.holding()
    goal = tuple(q - 0.3 * (i == 1) for i, q in enumerate(bench.arm.positions_rad()))
    result = await bench.served(bench.host.move(bench.anna, MoveRequest(joints_rad=goal)))
    assert list(bench.recorder.takes) == [result["recording"]]
    assert result["recording"].startswith("run-move-")
    assert 0.0 <= result["position_error_mm"] < 2.0
    assert bench.arm.positions_rad() == pytest.approx(goal, abs=ax12a.TICK_RAD)
    assert result["target_rad"] == pytest.approx(goal)
    assert result["position_m"] == pytest.approx(
        tool_position(bench.arm.robot.chain, np.array(bench.arm.positions_rad()[:5])).tolist()
    )


@on_bench
async def test_a_move_to_a_point_takes_the_tool_there(bench: Bench) -> None:
    await bench.holding()
    point = (0.15, 0.05, 0.2)
    result = await bench.served(bench.host.move(bench.anna, MoveRequest(point_m=point)))
    assert result["position_m"] == pytest.approx(point, abs=0.004)
    assert math.dist(result["position_m"], point) == pytest.approx(result["position_error_mm"] / 1e3, abs=1e-5)


@on_bench
async def test_a_point_out_of_reach_is_refused_with_the_nearest_distance(bench: Bench) -> None:
    await bench.holding()
    error = await bench.refused(bench.host.move(bench.anna, MoveRequest(point_m=(0.9, 0.0, 0.2))))
    assert error.code == "UNREACHABLE"
    assert "no nearer than" in str(error)
    assert not bench.recorder.takes


@on_bench
async def test_a_move_is_refused_with_every_reason_before_it_starts(bench: Bench) -> None:
    await bench.holding()
    here = bench.arm.positions_rad()
    fast = MoveRequest(joints_rad=(here[0] + 1.0, here[1] - 1.0, *here[2:]), duration_s=0.3)
    error = await bench.refused(bench.host.move(bench.anna, fast))
    assert error.code == "PREFLIGHT"
    assert len(error.reasons) > 2
    far = await bench.refused(bench.host.move(bench.anna, MoveRequest(joints_rad=(2.6, *here[1:]))))
    assert far.code == "LIMIT"
    assert (await bench.refused(bench.host.move(bench.anna, MoveRequest(joints_rad=here[:5])))).code == "LIMIT"
    assert not any(isinstance(command, Run) for command in bench.control.commands)


@on_bench
async def test_a_client_that_leaves_during_its_move_stops_the_arm(bench: Bench) -> None:
    await bench.holding()
    goal = tuple(q - 0.3 * (i == 1) for i, q in enumerate(bench.arm.positions_rad()))
    task = asyncio.ensure_future(bench.host.move(bench.anna, MoveRequest(joints_rad=goal)))
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    bench.host.client_gone(bench.anna)
    assert (await bench.refused(task)).code == "STOPPED"


# --------------------------------------------------------------------------------------- pause, resume, rate


@on_bench
async def test_anyone_may_pause_a_run_and_its_own_user_goes_on(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    host = bench.host
    other, same = NamedClient("carl", uid=1001), NamedClient("anna's other terminal")
    assert await bench.served(host.pause()) == {"state": "moving"}
    for _ in range(20):
        bench.tick()
    before = host.status()
    assert before["rate"] == 0.0
    bench.tick()
    assert host.status()["progress"] == before["progress"]
    assert (await bench.refused(host.resume(other))).code == "BUSY"
    assert (await bench.refused(host.rate(other, 0.5))).code == "BUSY"
    assert await bench.served(host.rate(same, 0.5)) == {"state": "moving", "rate": 0.5}
    assert await bench.served(host.resume(same)) == {"state": "moving"}
    assert host.status()["rate"] == 0.5
    assert (await bench.served(task))["recording"]


@on_bench
async def test_a_paused_run_waits_as_long_as_it_takes(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    await bench.served(bench.host.pause())
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_module, "STUCK_S", 0.0)
        for _ in range(50):
            bench.tick()
            await asyncio.sleep(0)
        assert not task.done()
    await bench.served(bench.host.resume(bench.anna))
    assert (await bench.served(task))["recording"]


# ----------------------------------------------------------------------------------------------------- jog

UP = (0.0, 0.0, 0.05)
TURN = (0.2, 0.0, 0.0, 0.0, 0.0, 0.0)


@on_bench
async def test_a_jog_is_one_client_s_until_it_ends(bench: Bench) -> None:
    await bench.holding()
    host, anna, ben = bench.host, bench.anna, bench.ben
    assert await bench.beat(anna, turn=TURN, begin=True) == {"state": "jogging"}
    assert host.status()["commander"] == "anna: jogging"
    for work in (bench.beat(ben, turn=TURN), host.run(ben, bench.plan()), host.run(anna, bench.plan())):
        with pytest.raises(RequestRefused) as caught:
            await work
        assert caught.value.code == "BUSY"
    assert await bench.beat(anna, turn=TURN) == {"state": "jogging"}
    for _ in range(7):
        bench.tick()
    assert (host.status()["state"], host.status()["commander"]) == ("holding", None)
    with pytest.raises(IllegalTransition, match="begin another"):
        await bench.beat(anna, turn=TURN)
    assert await bench.beat(ben, turn=TURN, begin=True) == {"state": "jogging"}


@on_bench
async def test_anyone_may_stop_a_jog_and_it_does_not_go_on(bench: Bench) -> None:
    await bench.holding()
    await bench.beat(bench.anna, lead=UP, begin=True)
    assert await bench.served(bench.host.stop()) == {"state": "holding"}
    with pytest.raises(IllegalTransition, match="begin another"):
        await bench.beat(bench.anna, lead=UP)


@on_bench
async def test_a_client_that_leaves_during_its_jog_leaves_a_holding_arm(bench: Bench) -> None:
    await bench.holding()
    await bench.beat(bench.anna, lead=UP, begin=True)
    bench.host.client_gone(bench.anna)
    assert bench.host.status()["commander"] is None
    goals = len(bench.arm.goals)
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    assert len(bench.arm.goals) == goals


@on_bench
async def test_a_jog_that_leads_links_into_each_other_is_refused(bench: Bench) -> None:
    await bench.holding()

    async def fold() -> None:
        for tick in range(100):
            await bench.beat(bench.anna, turn=(0.0, 0.0, 0.0, 0.35, 0.35, 0.0), begin=tick == 0)

    with pytest.raises(RequestRefused, match="would touch") as caught:
        await fold()
    assert caught.value.code == "PREFLIGHT"
    goals = len(bench.arm.goals)
    for _ in range(7):
        bench.tick()
    assert len(bench.arm.goals) == goals, "the arm stops, as where heartbeats cease"
    assert bench.arm.mode() is Mode.HOLDING


# ------------------------------------------------------------------------------------------------- leases


@on_bench
async def test_one_client_commands_and_the_other_is_told_who(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    host, ben = bench.host, bench.ben
    for work in (
        host.command(ben, "release"),
        host.command(ben, "torque_on"),
        host.command(ben, "clear"),
        host.teach_begin(ben),
        host.run(ben, bench.plan()),
        host.run(bench.anna, bench.plan()),
        host.command(bench.anna, "release"),
    ):
        error = await bench.refused(work)
        assert error.code == "BUSY"
    assert "anna" in str(await bench.refused(host.command(ben, "release")))
    assert bench.host.status()["commander"] == "anna: run"
    await bench.served(task)
    assert bench.host.status()["commander"] is None


# ----------------------------------------------------------------------------------------------- teaching


@on_bench
async def test_teaching_records_takes_and_ends_limp(bench: Bench) -> None:
    await bench.holding()
    host, anna = bench.host, bench.anna
    assert await bench.served(host.teach_begin(anna)) == {"state": "teaching"}
    first = await bench.served(host.teaching.take_begin(anna, "first"))
    assert first == {"recording": "first", "path": "/recordings/first.mcap"}
    assert host.status()["recording"] == "first"
    for _ in range(5):
        bench.tick()
    assert await bench.served(host.teaching.take_end(anna)) == first
    assert bench.recorder.takes["first"] >= 5
    assert await bench.served(host.teach_end(anna)) == {"state": "off"}
    assert await bench.served(host.command(bench.ben, "torque_on")) == {"state": "holding"}


@on_bench
async def test_takes_belong_to_whoever_teaches(bench: Bench) -> None:
    bench.tick()
    host, anna, ben = bench.host, bench.anna, bench.ben
    for work in (host.teaching.take_begin(anna, "x"), host.teaching.take_end(anna), host.teach_end(anna)):
        assert isinstance(await bench.refused(work), IllegalTransition)
    await bench.served(host.teach_begin(anna))
    assert isinstance(await bench.refused(host.teaching.take_end(anna)), IllegalTransition)
    await bench.served(host.teaching.take_begin(anna, "x"))
    assert isinstance(await bench.refused(host.teaching.take_begin(anna, "y")), IllegalTransition)
    for work in (host.teaching.take_begin(ben, "y"), host.teaching.take_end(ben), host.teach_end(ben)):
        assert isinstance(await bench.refused(work), IllegalTransition)
    for work in (host.command(ben, "torque_on"), host.teach_begin(anna), host.run(anna, bench.plan())):
        assert (await bench.refused(work)).code == "BUSY"


@on_bench
async def test_a_refused_take_is_no_take(bench: Bench) -> None:
    bench.tick()
    await bench.served(bench.host.teach_begin(bench.anna))
    bench.recorder.takes["old"] = 1
    with pytest.raises(LogError):
        await bench.served(bench.host.teaching.take_begin(bench.anna, "old"))
    assert bench.host.status()["recording"] is None


@on_bench
async def test_a_refused_teach_gives_no_lease(bench: Bench) -> None:
    await bench.holding()
    task = await bench.running()
    await bench.served(bench.host.stop())
    assert (await bench.refused(task)).code == "STOPPED"
    bench.arm.silent = {1}
    await bench.until(lambda: bench.arm.mode() is Mode.FAULTED)
    assert isinstance(await bench.refused(bench.host.teach_begin(bench.anna)), IllegalTransition)
    assert bench.host.status()["commander"] is None


@on_bench
async def test_a_client_that_leaves_while_teaching_leaves_a_limp_arm_and_its_take(bench: Bench) -> None:
    await bench.holding()
    await bench.served(bench.host.teach_begin(bench.anna))
    await bench.served(bench.host.teaching.take_begin(bench.anna, "orphan"))
    for _ in range(3):
        bench.tick()
    bench.host.client_gone(bench.anna)
    await bench.until(lambda: bench.arm.mode() is Mode.OFF)
    assert bench.recorder.takes["orphan"] >= 3
    assert any("ORPHAN_TAKE" in note for note in bench.recorder.notes)
    assert not any(bench.arm.get(index, ax12a.TORQUE_ENABLE) for index in range(6))
    assert await bench.served(bench.host.teach_begin(bench.ben)) == {"state": "teaching"}


@on_bench
async def test_a_client_that_leaves_while_the_arm_becomes_limp_keeps_no_lease(bench: Bench) -> None:
    await bench.holding()
    task = asyncio.ensure_future(bench.host.teach_begin(bench.anna))
    await asyncio.sleep(0)
    bench.host.client_gone(bench.anna)
    await bench.until(task.done)
    await bench.until(lambda: bench.arm.mode() is Mode.OFF)
    assert bench.host.status()["commander"] is None


@on_bench
async def test_teaching_that_a_fault_has_ended_can_be_ended(bench: Bench) -> None:
    bench.tick()
    await bench.served(bench.host.teach_begin(bench.anna))
    await bench.served(bench.host.teaching.take_begin(bench.anna, "cut"))
    bench.arm.silent = {1}
    await bench.until(lambda: bench.arm.mode() is Mode.FAULTED)
    assert await bench.served(bench.host.teach_end(bench.anna)) == {"state": "faulted"}
    assert "cut" in bench.recorder.takes
    assert not any(isinstance(command, TeachEnd) for command in bench.control.commands)


@on_bench
async def test_a_control_process_that_dies_while_teaching_leaves_the_take_to_be_kept(bench: Bench) -> None:
    bench.tick()
    host, anna = bench.host, bench.anna
    await bench.served(host.teach_begin(anna))
    await bench.served(host.teaching.take_begin(anna, "kept"))
    for _ in range(3):
        bench.tick()
    host.control_lost()
    bench.arm.state = type(bench.arm.state)()  # the next one knows nothing
    host.attach(bench.control)
    bench.control.connect_again()
    bench.tick()
    assert host.status()["state"] == "off"
    assert await bench.served(host.teach_end(anna)) == {"state": "off"}
    assert bench.recorder.takes["kept"] >= 3


@on_bench
async def test_a_mark_stands_in_the_take_with_where_the_tool_is(bench: Bench) -> None:
    bench.tick()
    host, anna = bench.host, bench.anna
    await bench.served(host.teach_begin(anna))
    assert isinstance(await bench.refused(host.teaching.take_mark(anna)), IllegalTransition)
    await bench.served(host.teaching.take_begin(anna, "x"))
    marked = await bench.served(host.teaching.take_mark(anna))
    assert marked["position_m"] == host.status()["tool"]["position_m"]
    assert marked["joints_rad"] == pytest.approx(bench.arm.positions_rad())
    assert json.loads(bench.recorder.notes[-1]) == {"event": "VIA_MARK", **marked}
    assert isinstance(await bench.refused(host.teaching.take_mark(bench.ben)), IllegalTransition)


@pytest.mark.parametrize(
    ("calibration", "limit_m_s", "noted"),
    [({}, 0.25, 1), ({"tool_speed_limit_m_s": 0.1}, 0.1, 1), ({"tool_speed_limit_m_s": 2.0}, 2.0, 0)],
)
def test_a_hand_faster_than_the_arm_s_tool_speed_limit_is_shown_and_noted_once_an_excursion(
    calibration: dict[str, float], limit_m_s: float, noted: int
) -> None:
    async def test(bench: Bench) -> None:
        bench.tick()
        await bench.served(bench.host.teach_begin(bench.anna))
        tick = bench.arm.get(0, ax12a.PRESENT_POSITION)
        bench.arm.put(1, ax12a.PRESENT_POSITION, 512)  # arm stretched out: the tool is far from the base axis
        for _ in range(10):
            bench.tick()
        bench.recorder.notes.clear()
        for step in range(1, 11):
            bench.arm.put(0, ax12a.PRESENT_POSITION, tick + 30 * step)
            bench.tick()
        assert bench.host.status()["tool_speed_limit_m_s"] == limit_m_s
        assert bench.host.status()["tool"]["speed_m_s"] > 0.25
        texts = [json.loads(note)["text"] for note in bench.recorder.notes if "TEACHING_FAST" in note]
        assert len(texts) == noted
        assert all(text.endswith(f"(bound {1e3 * limit_m_s:.0f})") for text in texts)
        for _ in range(10):
            bench.tick()
        assert bench.host.status()["tool"]["speed_m_s"] == pytest.approx(0.0, abs=1e-9)

    asyncio.run(run(test, **calibration))


# ------------------------------------------------------------------------------------------------- status

STATUS_KEYS = {"state", "fault", "tick", "period_s", "joints", "tool", "cycle", "recording"}
JOINT_KEYS = {
    "limits_rad",
    "name",
    "servo_id",
    "position_rad",
    "velocity_rad_s",
    "load_ratio",
    "voltage_V",
    "temperature_degC",
    "torque_enabled",
    "age_s",
}
FAULT_KEYS = {"code", "servo_id", "since_s", "arm", "next", "text"}
CYCLE_KEYS = {"bus_us_p50", "bus_us_p99", "lateness_us_p99", "overruns", "retries"}


@on_bench
async def test_the_snapshot_has_the_keys_of_the_contract_before_and_after_the_first_tick(bench: Bench) -> None:
    for state in ("starting", "off"):
        status = bench.host.status()
        json.dumps(status, allow_nan=False)
        assert status.keys() >= STATUS_KEYS
        assert status["state"] == state
        assert status["fault"] is None
        assert all(joint.keys() == JOINT_KEYS for joint in status["joints"])
        assert status["cycle"].keys() == CYCLE_KEYS
        bench.tick()
    assert status["arm_id"] == "ax12-line"
    assert status["pids"]["control"] == 4242
    assert status["tool"].keys() == {"position_m", "rpy_rad", "speed_m_s"}
    assert status["joints"][1]["position_rad"] == pytest.approx(math.radians(158.0), abs=ax12a.TICK_RAD)
    assert status["cycle"]["bus_us_p50"] == status["cycle"]["bus_us_p99"] == 2500


@on_bench
async def test_the_tool_is_given_in_roll_pitch_yaw(bench: Bench) -> None:
    bench.tick()
    tool = bench.host.status()["tool"]
    T = forward_kinematics(bench.arm.robot.chain, _positions(bench))
    assert tool["position_m"] == pytest.approx(T[:3, 3].tolist())
    assert tool["rpy_rad"] == pytest.approx(rpy_from_matrix(T[:3, :3]), abs=1e-9)


def _positions(bench: Bench) -> Any:
    return np.array(bench.arm.positions_rad()[: bench.arm.robot.chain.n])


@on_bench
async def test_ages_grow_when_no_tick_comes(bench: Bench) -> None:
    bench.tick()
    before = bench.host.status()
    bench.clock.advance_ns(700_000_000)
    after = bench.host.status()
    assert after["age_s"] - before["age_s"] == pytest.approx(0.7)
    for old, new in zip(before["joints"], after["joints"], strict=True):
        assert new["age_s"] - old["age_s"] == pytest.approx(0.7)


@on_bench
async def test_a_joint_that_never_answered_has_no_values(bench: Bench) -> None:
    bench.arm.silent = {2}
    bench.tick()
    joint = bench.host.status()["joints"][2]
    assert joint["name"] == "elbow"
    assert all(joint[key] is None for key in JOINT_KEYS - {"name", "servo_id", "limits_rad"})
    assert bench.host.status()["tool"] is None


@on_bench
async def test_a_fault_tells_code_servo_time_what_the_arm_does_and_what_to_type(bench: Bench) -> None:
    bench.tick()
    bench.arm.silent = {1}
    await bench.until(lambda: bench.arm.mode() is Mode.FAULTED)
    bench.clock.advance_ns(2_000_000_000)
    fault = bench.host.status()["fault"]
    assert fault.keys() == FAULT_KEYS
    assert (fault["code"], fault["servo_id"]) == ("SERVO_SILENT", 2)
    assert fault["since_s"] == pytest.approx(2.0, abs=0.01)
    assert "armctl clear" in fault["next"]


@on_bench
async def test_a_dead_control_process_is_a_fault_until_the_next_one_ticks(bench: Bench) -> None:
    bench.tick()
    bench.host.control_lost()
    status = bench.host.status()
    assert (status["state"], status["fault"]["code"]) == ("restarting", "RESTARTED")
    assert status["fault"].keys() == FAULT_KEYS
    assert status["pids"]["control"] is None
    bench.host.attach(bench.control)
    bench.tick()
    assert bench.host.status()["fault"] is None
    assert bench.host.status()["state"] == "off"


@on_bench
async def test_the_cycle_figures_cover_the_last_600_ticks(bench: Bench) -> None:
    record = bench.tick(lateness_us=90_000)
    assert bench.host.status()["cycle"]["overruns"] == 1
    assert bench.host.status()["cycle"]["lateness_us_p99"] == 90_000
    for _ in range(600):
        bench.host.receive(record := replace(record, lateness_us=5))
    assert bench.host.status()["cycle"]["overruns"] == 0
    assert bench.host.status()["cycle"]["lateness_us_p99"] == 5


@on_bench
async def test_ticks_the_host_was_too_slow_for_are_counted(bench: Bench) -> None:
    bench.tick(dropped=3)
    bench.tick(dropped=2)
    bench.recorder.dropped_records = 2
    assert bench.host.status()["log"] == {
        "path": "/logs/log.mcap",
        "problem": "",
        "dropped": 5,
        "recorder_dropped": 2,
    }
    bench.recorder.log_path = None
    assert bench.host.log()["path"] is None
