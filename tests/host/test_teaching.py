"""Teaching: the lease while it lasts, takes, marks, and a hand that is too fast."""

import asyncio
import json
from contextlib import suppress

import pytest

from armctl.dynamixel import ax12a
from armctl.errors import LogError, RequestRefused
from armctl.host import teaching
from armctl.host.motions import run
from armctl.messages import Mode, TeachEnd
from tests.host.bench import Bench


async def test_teaching_records_takes_and_ends_limp(bench: Bench) -> None:
    host, anna = bench.host, bench.anna
    assert await bench.served(teaching.begin(host, anna)) == {"state": "teaching"}
    first = await bench.served(teaching.take_begin(host, anna, "first"))
    assert first == {"recording": "first", "path": "/recordings/first.mcap"}
    assert host.status()["recording"] == "first"
    bench.ticks(5)
    assert await bench.served(teaching.take_end(host, anna)) == first
    assert bench.recorder.takes["first"] >= 5
    assert await bench.served(teaching.end(host, anna)) == {"state": "off"}
    assert await bench.served(host.command(bench.ben, "torque_on")) == {"state": "holding"}


async def test_takes_belong_to_whoever_teaches(limp: Bench) -> None:
    host, anna, ben = limp.host, limp.anna, limp.ben
    for work in (teaching.take_begin(host, anna, "x"), teaching.take_end(host, anna), teaching.end(host, anna)):
        await limp.refused(work, "ILLEGAL_TRANSITION")
    await limp.served(teaching.begin(host, anna))
    await limp.refused(teaching.take_end(host, anna), "ILLEGAL_TRANSITION")
    await limp.served(teaching.take_begin(host, anna, "x"))
    await limp.refused(teaching.take_begin(host, anna, "y"), "ILLEGAL_TRANSITION")
    for work in (teaching.take_begin(host, ben, "y"), teaching.take_end(host, ben), teaching.end(host, ben)):
        await limp.refused(work, "ILLEGAL_TRANSITION")
    for work in (host.command(ben, "torque_on"), teaching.begin(host, anna), run(host, anna, limp.plan())):
        await limp.refused(work, "BUSY")


@pytest.mark.parametrize("what", ["release", "torque_on", "clear", "park"])
async def test_a_teacher_who_leaves_during_another_request_locks_nobody_out(limp: Bench, what: str) -> None:
    """Before, the arm was taught by nobody until the daemon was restarted, and the take went on."""
    host = limp.host
    await limp.taking("t")
    task = asyncio.ensure_future(host.command(limp.anna, what))
    await asyncio.sleep(0)
    host.client_gone(limp.anna)
    with suppress(RequestRefused):
        await limp.served(task)
    await limp.until(lambda: limp.arm.mode() in (Mode.OFF, Mode.HOLDING))
    assert (host.status()["commander"], host.status()["recording"]) == (None, None)
    await limp.served(host.command(limp.ben, "release"))
    assert await limp.served(host.command(limp.ben, "torque_on")) == {"state": "holding"}


async def test_a_refused_take_is_no_take(limp: Bench) -> None:
    await limp.served(teaching.begin(limp.host, limp.anna))
    limp.recorder.takes["old"] = 1
    with pytest.raises(LogError):
        await limp.served(teaching.take_begin(limp.host, limp.anna, "old"))
    assert limp.host.status()["recording"] is None


async def test_where_no_take_can_be_recorded_the_arm_does_not_go_limp(bench: Bench) -> None:
    await bench.holding()
    bench.recorder.stopped = "NO_SPACE"
    with pytest.raises(LogError, match="NO_SPACE"):
        await bench.served(teaching.begin(bench.host, bench.anna))
    bench.ticks(2)
    assert (bench.arm.mode(), bench.host.status()["commander"]) == (Mode.HOLDING, None)
    bench.recorder.stopped = ""
    assert await bench.served(teaching.begin(bench.host, bench.anna)) == {"state": "teaching"}


async def test_a_refused_teach_gives_no_lease(bench: Bench) -> None:
    task = await bench.running()
    await bench.served(bench.host.stop())
    await bench.refused(task, "STOPPED")
    bench.arm.silent = {1}
    await bench.until(lambda: bench.arm.mode() is Mode.FAULTED)
    await bench.refused(teaching.begin(bench.host, bench.anna), "ILLEGAL_TRANSITION")
    assert bench.host.status()["commander"] is None


async def test_a_client_that_leaves_while_teaching_leaves_a_limp_arm_and_its_take(bench: Bench) -> None:
    await bench.taking("orphan")
    bench.ticks(3)
    bench.host.client_gone(bench.anna)
    await bench.until(lambda: bench.arm.mode() is Mode.OFF)
    assert bench.recorder.takes["orphan"] >= 3
    assert any("ORPHAN_TAKE" in note for note in bench.recorder.notes)
    assert not any(bench.arm.get(index, ax12a.TORQUE_ENABLE) for index in range(6))
    assert await bench.served(teaching.begin(bench.host, bench.ben)) == {"state": "teaching"}


async def test_a_client_that_leaves_while_the_arm_becomes_limp_keeps_no_lease(bench: Bench) -> None:
    task = asyncio.ensure_future(teaching.begin(bench.host, bench.anna))
    await asyncio.sleep(0)
    bench.host.client_gone(bench.anna)
    await bench.until(task.done)
    await bench.until(lambda: bench.arm.mode() is Mode.OFF)
    assert bench.host.status()["commander"] is None


async def test_teaching_that_a_fault_has_ended_can_be_ended(limp: Bench) -> None:
    await limp.taking("cut")
    limp.arm.silent = {1}
    await limp.until(lambda: limp.arm.mode() is Mode.FAULTED)
    assert await limp.served(teaching.end(limp.host, limp.anna)) == {"state": "faulted"}
    assert "cut" in limp.recorder.takes
    assert not any(isinstance(command, TeachEnd) for command in limp.control.commands)


async def test_a_fault_that_has_ended_teaching_is_cleared_by_the_same_user_from_elsewhere(limp: Bench) -> None:
    await limp.served(teaching.begin(limp.host, limp.anna))
    limp.arm.silent = {1}
    await limp.until(lambda: limp.arm.mode() is Mode.FAULTED)
    limp.arm.silent = set()
    await limp.until(lambda: limp.host.status()["joints"][1]["age_s"] < 0.1)
    assert await limp.served(limp.host.command(limp.ben, "clear")) == {"state": "off"}


async def test_a_control_process_that_dies_while_teaching_leaves_the_take_to_be_kept(limp: Bench) -> None:
    host, anna = limp.host, limp.anna
    await limp.taking("kept")
    limp.ticks(3)
    host.control_lost()
    limp.arm.state = type(limp.arm.state)()  # the next one knows nothing
    limp.attach()
    limp.control.connect_again()
    limp.tick()
    assert host.status()["state"] == "off"
    assert await limp.served(teaching.end(host, anna)) == {"state": "off"}
    assert limp.recorder.takes["kept"] >= 3


async def test_a_mark_stands_in_the_take_with_where_the_tool_is(limp: Bench) -> None:
    host, anna = limp.host, limp.anna
    await limp.served(teaching.begin(host, anna))
    await limp.refused(teaching.take_mark(host, anna), "ILLEGAL_TRANSITION")
    await limp.served(teaching.take_begin(host, anna, "x"))
    marked = await limp.served(teaching.take_mark(host, anna))
    assert marked["position_m"] == host.status()["tool"]["position_m"]
    assert marked["joints_rad"] == pytest.approx(limp.arm.positions_rad())
    assert json.loads(limp.recorder.notes[-1]) == {"event": "VIA_MARK", **marked}
    await limp.refused(teaching.take_mark(host, limp.ben), "ILLEGAL_TRANSITION")


@pytest.mark.parametrize(
    ("fresh", "limit_m_s", "noted"),
    [({}, 0.25, 1), ({"tool_speed_limit_m_s": 0.1}, 0.1, 1), ({"tool_speed_limit_m_s": 2.0}, 2.0, 0)],
    indirect=["fresh"],
)
async def test_a_hand_faster_than_the_arm_s_tool_speed_limit_is_shown_and_noted_once_an_excursion(
    limp: Bench, limit_m_s: float, noted: int
) -> None:
    await limp.served(teaching.begin(limp.host, limp.anna))
    tick = limp.arm.get(0, ax12a.PRESENT_POSITION)
    limp.arm.put(1, ax12a.PRESENT_POSITION, 512)  # arm stretched out: the tool is far from the base axis
    limp.ticks(10)
    limp.recorder.notes.clear()
    for step in range(1, 11):
        limp.arm.put(0, ax12a.PRESENT_POSITION, tick + 30 * step)
        limp.tick()
    assert limp.host.status()["tool_speed_limit_m_s"] == limit_m_s
    assert limp.host.status()["tool"]["speed_m_s"] > 0.25
    texts = [json.loads(note)["text"] for note in limp.recorder.notes if "TEACHING_FAST" in note]
    assert len(texts) == noted
    assert all(text.endswith(f"(bound {1e3 * limit_m_s:.0f})") for text in texts)
    limp.ticks(10)
    assert limp.host.status()["tool"]["speed_m_s"] == pytest.approx(0.0, abs=1e-9)
