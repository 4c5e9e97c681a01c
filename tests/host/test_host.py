"""Requests, stops and leases: who commands the arm its clients share, and what becomes of a request."""

import asyncio
from typing import Any

import pytest

from armctl.clock import NS_PER_S
from armctl.errors import IllegalTransition, RequestRefused
from armctl.host import host as host_module
from armctl.host import teaching
from armctl.host.motions import run
from armctl.messages import Hold, Reply, Run
from tests.host.bench import Bench
from tests.host.doubles import refused
from tests.words import missing

# -------------------------------------------------------------------------------------------- requests


async def test_a_refusal_of_the_control_step_reaches_the_client_as_it_is(limp: Bench) -> None:
    error = await limp.refused(limp.host.command(limp.anna, "park"), "ILLEGAL_TRANSITION")
    assert isinstance(error, IllegalTransition)
    assert "the arm is limp" in str(error)


async def test_torque_that_is_on_is_no_error(bench: Bench) -> None:
    asked = len(bench.arm.replies)
    answer = await bench.served(asyncio.ensure_future(bench.host.command(bench.anna, "torque_on")))
    assert answer == {"state": "holding"}
    assert len(bench.arm.replies) == asked


async def test_torque_comes_on_when_a_late_reply_has_come(limp: Bench) -> None:
    limp.arm.silent = {2}
    coming = asyncio.ensure_future(limp.host.command(limp.anna, "torque_on"))
    for _ in range(3):
        await asyncio.sleep(0)
        limp.tick()
    assert not coming.done()
    limp.arm.silent = set()
    assert await limp.served(coming) == {"state": "holding"}


async def test_torque_is_refused_while_a_servo_is_silent(limp: Bench) -> None:
    limp.arm.silent = {2}
    begin_s = limp.clock.now_ns() / NS_PER_S
    await limp.refused(limp.host.command(limp.anna, "torque_on"), "NO_REPLY")
    assert 0.3 < limp.clock.now_ns() / NS_PER_S - begin_s < 0.6


@pytest.mark.parametrize("what", ["release", "park"])
async def test_release_and_park_are_answered_when_the_arm_is_limp(bench: Bench, what: str) -> None:
    assert await bench.served(bench.host.command(bench.anna, what)) == {"state": "off"}


async def test_clear_without_a_fault_is_done(limp: Bench) -> None:
    assert await limp.served(limp.host.command(limp.anna, "clear")) == {"state": "off"}


async def test_an_unanswered_request_fails_in_bounded_time(limp: Bench) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(host_module, "ANSWER_S", 0.01)
        with refused("NO_ANSWER"):
            await limp.host.command(limp.anna, "clear")


async def test_a_full_link_delays_a_command_and_loses_nothing(limp: Bench) -> None:
    full = [True]
    limp.host.exchange.attach(1, lambda command: not (full and full.pop()) and limp.control.link.send(command))
    assert await limp.served(limp.host.command(limp.anna, "clear")) == {"state": "off"}


async def test_a_request_to_a_dead_control_process_fails_at_once(limp: Bench) -> None:
    limp.host.control_lost()
    for work in (limp.host.stop(), limp.host.command(limp.anna, "clear"), run(limp.host, limp.anna, limp.plan())):
        with refused("RESTARTED"):
            await work


async def test_requests_under_way_fail_when_the_control_process_dies(bench: Bench) -> None:
    task = await bench.running()
    bench.host.control_lost()
    with refused("RESTARTED"):
        await task
    assert len(bench.recorder.takes) == 1, "the take of the broken run is kept"
    assert bench.recorder.begun is None


# ------------------------------------------------------------------------------------------------ stop


async def test_anyone_may_stop_a_run_and_the_run_says_so(bench: Bench) -> None:
    task = await bench.running()
    assert await bench.served(bench.host.stop()) == {"state": "holding"}
    await bench.refused(task, "STOPPED")
    assert len(bench.recorder.takes) == 1


async def test_many_stops_at_once_are_one_command(bench: Bench) -> None:
    task = await bench.running()
    stops = asyncio.gather(*(bench.host.stop() for _ in range(500)))
    await bench.until(stops.done)
    assert stops.result() == [{"state": "holding"}] * 500
    assert sum(isinstance(command, Hold) for command in bench.control.commands) == 1
    await bench.refused(task, "STOPPED")


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
        bench.host.exchange.answer(Reply(hold.request_id, True))
    await stop


async def test_a_stop_of_an_arm_at_rest_waits_for_no_tick(bench: Bench) -> None:
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 1


async def test_a_stop_says_that_it_did_not_reach_the_arm_while_the_port_is_gone(bench: Bench) -> None:
    bench.arm.port_open = False
    bench.tick()
    answer = await bench.served(bench.host.stop())
    assert answer["state"] == "faulted"
    assert not missing(answer["unreached"], "did not reach the arm", "its serial port is gone", "switch its power off")
    bench.arm.port_open = True
    bench.tick()
    assert await bench.served(bench.host.stop()) == {"state": "faulted"}


async def test_stops_close_behind_one_another_are_one_command(bench: Bench) -> None:
    for _ in range(100):
        await stopped_at_rest(bench)
    assert len(holds(bench)) == 1
    bench.clock.advance_ns(60_000_000)
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 2


async def test_a_stop_after_anything_else_was_asked_is_a_command_of_its_own(bench: Bench) -> None:
    await stopped_at_rest(bench)
    park = asyncio.ensure_future(bench.host.command(bench.anna, "park"))
    await asyncio.sleep(0)
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 2
    park.cancel()


async def test_a_stop_that_found_no_control_process_is_asked_again(bench: Bench) -> None:
    bench.host.exchange.pid = None
    with pytest.raises(RequestRefused, match="started again"):
        await bench.host.stop()
    bench.attach()
    await stopped_at_rest(bench)
    assert len(holds(bench)) == 1


async def test_a_run_that_is_stopped_while_it_is_being_checked_does_not_begin(bench: Bench) -> None:
    stops: list[asyncio.Task[dict[str, Any]]] = []
    bench.recorder.on_begin = lambda: stops.append(asyncio.ensure_future(bench.host.stop()))
    await bench.refused(run(bench.host, bench.anna, bench.plan()), "STOPPED")
    await bench.until(stops[0].done)
    assert stops[0].result() == {"state": "holding"}
    assert not any(isinstance(command, Run) for command in bench.control.commands)


async def test_a_stop_after_a_run_was_sent_is_a_command_of_its_own(bench: Bench) -> None:
    early = asyncio.ensure_future(bench.host.stop())
    await asyncio.sleep(0)
    bench.host.exchange.forget_hold()  # what sending a run does
    late = asyncio.ensure_future(bench.host.stop())
    await bench.until(lambda: early.done() and late.done())
    assert sum(isinstance(command, Hold) for command in bench.control.commands) == 2


# ---------------------------------------------------------------------------------------------- leases


async def test_one_client_commands_and_the_other_is_told_who(bench: Bench) -> None:
    task = await bench.running()
    host, ben = bench.host, bench.ben
    for work in (
        host.command(ben, "release"),
        host.command(ben, "torque_on"),
        host.command(ben, "clear"),
        teaching.begin(host, ben),
        run(host, ben, bench.plan()),
        run(host, bench.anna, bench.plan()),
        host.command(bench.anna, "release"),
    ):
        await bench.refused(work, "BUSY")
    told = str(await bench.refused(host.command(ben, "release"), "BUSY"))
    assert "client anna commands the arm now (run)" in told
    assert bench.host.status()["commander"] == "anna: run"
    await bench.served(task)
    assert bench.host.status()["commander"] is None
