"""Programs through the host: checked as a whole, run as one, stopped and resumed; over ideal servos in virtual time."""

import asyncio
import json
import math
from pathlib import Path
from typing import Any

import pytest
import yaml

from armctl.errors import LogError
from armctl.host import programs
from armctl.host.programs import Site
from armctl.messages import Mode, Run
from armctl.trajectory.program import ProgramRequest, program_from_text
from tests.control.ideal_arm import PERIOD_S
from tests.host.bench import Bench, HostBench
from tests.host.simulated import on_arm

NAME = "tidy-up"


def asked(steps: str | list[dict[str, Any]], from_step: str | None = None) -> ProgramRequest:
    text = steps if isinstance(steps, str) else yaml.safe_dump({"steps": steps})
    return ProgramRequest(name=NAME, from_step=from_step, steps=program_from_text(text, "p.yaml", NAME).steps)


def site(bench: HostBench, folder: Path) -> Site:
    return Site(bench.host.arm, bench.host.robot, PERIOD_S, folder / "recordings")


def begun(
    bench: HostBench, folder: Path, steps: list[dict[str, Any]], from_step: str | None = None
) -> asyncio.Task[dict[str, Any]]:
    """Anna's program, under way."""
    return asyncio.ensure_future(
        programs.run(bench.host, bench.anna, site(bench, folder), asked(steps, from_step=from_step))
    )


def turn(bench: Bench, by_rad: float) -> dict[str, Any]:
    """A step to the pose of now with the first joint turned."""
    first, *others = bench.arm.positions_rad()
    return {"move": {"joints_rad": [round(first + by_rad, 5), *(round(q, 5) for q in others)]}}


def there(bench: Bench) -> list[dict[str, Any]]:
    return [turn(bench, 0.1), {"wait_s": 1.0}, {"repeat": {"times": 2, "steps": [turn(bench, 0.2), turn(bench, 0.3)]}}]


def check(bench: Bench, folder: Path, steps: list[dict[str, Any]]) -> dict[str, Any]:
    return programs.checked(site(bench, folder), asked(steps), programs.pose_now(bench.host))


ALL = ["1", "2", "3.1@1", "3.2@1", "3.1@2", "3.2@2"]


async def ticks(bench: Bench, count: int) -> None:
    """Ticks, and what they let happen."""
    for _ in range(count):
        bench.tick()
        for _ in range(5):
            await asyncio.sleep(0)


def notes(bench: HostBench, event: str) -> list[dict[str, Any]]:
    return [note for note in map(json.loads, bench.recorder.notes) if note.get("event") == event]


def runs(bench: Bench) -> int:
    return sum(isinstance(command, Run) for command in bench.control.commands)


def kept(folder: Path) -> list[str]:
    return [path.name for path in (folder / "programs").glob("*")]


async def test_a_program_is_done_step_by_step_as_one_recording_that_names_every_step(
    bench: Bench, tmp_path: Path
) -> None:
    result = await bench.served(begun(bench, tmp_path, there(bench)))
    assert [(row["name"], row["ok"]) for row in result["steps"]] == [(name, True) for name in ALL]
    assert (result["resumed_at"], result["ended"], result["stands_at"]) == (None, None, None)
    assert list(bench.recorder.takes) == [result["recording"]]
    begins, ends = notes(bench, "PROGRAM_STEP"), notes(bench, "PROGRAM_STEP_END")
    assert [note["step"] for note in begins] == [note["name"] for note in ends] == ALL
    assert {note["program"] for note in begins + ends} == {NAME}
    assert all(note["ok"] for note in ends)
    [begin], [end] = notes(bench, "PROGRAM"), notes(bench, "PROGRAM_END")
    assert (begin["name"], len(begin["steps"]), end["ended"]) == (NAME, 3, None)
    assert [told["step"] for _, told in bench.anna.told] == [name for name in ALL for _ in range(2)]
    assert [told["text"] for _, told in bench.anna.told if "done" in told] == [row["text"] for row in result["steps"]]
    assert runs(bench) == 5
    assert bench.arm.positions_rad()[0] == pytest.approx(
        there(bench)[2]["repeat"]["steps"][1]["move"]["joints_rad"][0] - 0.3, abs=0.01
    )
    assert check(bench, tmp_path, there(bench))["resumed_at"] is None
    assert bench.host.leases.current is None


async def test_a_wait_holds_for_its_time(bench: Bench, tmp_path: Path) -> None:
    before = len(bench.recorder.records)
    await bench.served(begun(bench, tmp_path, [{"wait_s": 3.0}]))
    assert len(bench.recorder.records) - before == pytest.approx(3.0 / PERIOD_S, abs=2)
    assert runs(bench) == 0


@pytest.mark.parametrize("ran", range(1, 6))
async def test_after_a_stop_it_goes_on_with_the_step_that_was_under_way(bench: Bench, tmp_path: Path, ran: int) -> None:
    steps, moves = there(bench), [name for name in ALL if name != "2"]
    task = begun(bench, tmp_path, steps)
    await bench.until(lambda: runs(bench) == ran and bench.arm.mode() is Mode.MOVING)
    await bench.served(bench.host.stop())
    result = await bench.served(task)
    at = moves[ran - 1]
    assert result["ended"]["code"] == "STOPPED"
    assert result["stands_at"] == at
    assert result["steps"][-1] == {"name": at, "ok": False, "text": result["ended"]["text"]}
    assert check(bench, tmp_path, steps)["resumed_at"] == (at if ran > 1 else None)
    again = await bench.served(begun(bench, tmp_path, steps))
    assert again["resumed_at"] == (at if ran > 1 else None)
    assert [row["name"] for row in again["steps"]] == ALL[ALL.index(at) :]
    assert again["ended"] is None
    assert runs(bench) == 6


async def test_a_stop_in_a_wait_ends_it_and_the_wait_begins_anew(bench: Bench, tmp_path: Path) -> None:
    task = begun(bench, tmp_path, steps := there(bench))
    await bench.until(lambda: bool(notes(bench, "PROGRAM_STEP")) and notes(bench, "PROGRAM_STEP")[-1]["step"] == "2")
    await bench.served(bench.host.stop())
    result = await bench.served(task)
    assert (result["ended"]["code"], result["stands_at"]) == ("STOPPED", "2")
    assert result["ended"]["text"] == "the program was stopped before it ended"
    assert (await bench.served(begun(bench, tmp_path, steps)))["resumed_at"] == "2"


async def test_a_step_can_be_named_to_begin_with(bench: Bench, tmp_path: Path) -> None:
    result = await bench.served(begun(bench, tmp_path, there(bench), from_step="3.2"))
    assert [row["name"] for row in result["steps"]] == ["3.2@1", "3.1@2", "3.2@2"]
    assert result["resumed_at"] == "3.2@1"
    await bench.refused(begun(bench, tmp_path, there(bench), from_step="4"), "NO_STEP")


async def stopped(bench: Bench, folder: Path, steps: list[dict[str, Any]]) -> None:
    """A program stands at its last step."""
    task = begun(bench, folder, steps)
    await bench.until(lambda: runs(bench) == 5)
    await bench.served(bench.host.stop())
    assert (await bench.served(task))["stands_at"] == "3.2@2"


async def test_what_has_changed_since_is_not_resumed_unless_it_is_said_from_where(bench: Bench, tmp_path: Path) -> None:
    await stopped(bench, tmp_path, there(bench))
    changed = [*there(bench), {"wait_s": 0.5}]
    refusal = await bench.refused(begun(bench, tmp_path, changed), "NOT_RESUMED")
    assert str(refusal) == (
        "program tidy-up stands at step 3.2@2, and it or the arm's file has changed since; `--from 1` begins anew"
    )
    assert check(bench, tmp_path, changed)["resumed_at"] is None
    assert runs(bench) == 5
    result = await bench.served(begun(bench, tmp_path, changed, from_step="1"))
    assert (result["resumed_at"], len(result["steps"])) == (None, 7)


async def test_what_is_kept_and_cannot_be_read_says_so(bench: Bench, tmp_path: Path) -> None:
    await stopped(bench, tmp_path, steps := there(bench))
    (tmp_path / "programs" / f"{NAME}.json").write_text('{"index": 99}')
    refusal = await bench.refused(begun(bench, tmp_path, steps), "NOT_RESUMED")
    assert "where it stands cannot be read: " in str(refusal)
    assert "`--from 1` begins anew" in str(refusal)


async def test_nothing_moves_unless_every_step_can_be_done_from_where_the_one_before_it_ends(
    bench: Bench, tmp_path: Path
) -> None:
    far = turn(bench, 9.0)
    inner = [turn(bench, 0.2), {"move": {"point_m": [0.9, 0.0, 0.1]}, "name": "far-off"}, {"wait_s": 1.0}]
    steps = [turn(bench, 0.1), {"repeat": {"times": 3, "steps": inner}}]
    refusal = await bench.refused(begun(bench, tmp_path, steps), "PREFLIGHT")
    assert len(refusal.reasons) == 1
    assert "step far-off@1: " in refusal.reasons[0]
    refusal = await bench.refused(
        begun(bench, tmp_path, [turn(bench, 0.1), far, {"play": {"name": "none"}}]), "PREFLIGHT"
    )
    assert "step 2: " in str(refusal)
    assert runs(bench) == 0
    assert kept(tmp_path) == []
    assert bench.recorder.takes == {}


async def test_a_check_tells_every_step_once_and_of_a_turn_that_differs_the_turn(bench: Bench, tmp_path: Path) -> None:
    found = check(bench, tmp_path, there(bench))
    assert [(row["name"], row["ok"]) for row in found["steps"]] == [
        ("1", True),
        ("2", True),
        ("3.1", True),
        ("3.2", True),
    ]
    assert found["resumed_at"] is None
    assert found["steps"][0]["text"].startswith("move, ")
    assert found["steps"][1]["text"] == "wait 1 s"
    # Fast from near, too fast from afar: only from the second turn on.
    near, afar = turn(bench, 0.05), turn(bench, 1.0)
    near["move"]["duration_s"] = 0.3
    found = check(bench, tmp_path, [{"repeat": {"times": 3, "steps": [near, afar]}}])
    assert [(row["name"], row["ok"]) for row in found["steps"]] == [
        ("1.1", True),
        ("1.2", True),
        ("1.1@2", False),
        ("1.2@2", False),
    ]
    assert found["steps"][-1]["text"] == programs.UNCHECKED


async def test_an_arm_without_a_gripper_says_so_before_anything_moves(bench: Bench, tmp_path: Path) -> None:
    steps = [turn(bench, 0.1), {"grip": "close"}]
    assert "has no gripper" in str(await bench.refused(begun(bench, tmp_path, steps), "PREFLIGHT"))
    steps = [turn(bench, 0.1), {"if_gripped": {"then": [turn(bench, 0.2)]}}]
    assert "has no gripper" in str(await bench.refused(begun(bench, tmp_path, steps), "PREFLIGHT"))


@pytest.mark.parametrize("later", range(8))
async def test_a_program_that_is_paused_at_any_time_after_a_step_goes_on_when_it_is_told_to(
    bench: Bench, tmp_path: Path, later: int
) -> None:
    """Before, it was refused for half a second after a step, and the next one began."""
    at = bench.arm.positions_rad()[0]
    task = begun(bench, tmp_path, [turn(bench, 0.1), turn(bench, 0.2), turn(bench, 0.3)])
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    await bench.until(lambda: bench.arm.mode() is Mode.HOLDING)
    await ticks(bench, later)
    await bench.served(bench.host.pause())
    await ticks(bench, 5)
    stands = bench.arm.positions_rad()
    await ticks(bench, 60)
    assert bench.arm.positions_rad() == stands
    assert stands[0] < at + 0.25
    await bench.served(bench.host.resume(bench.anna))
    assert (await bench.served(task))["ended"] is None


async def test_a_program_that_is_paused_while_it_waits_takes_no_time(bench: Bench, tmp_path: Path) -> None:
    task = begun(bench, tmp_path, there(bench))
    await bench.until(lambda: bool(notes(bench, "PROGRAM_STEP")) and notes(bench, "PROGRAM_STEP")[-1]["step"] == "2")
    await bench.served(bench.host.pause())
    await ticks(bench, 60)
    assert runs(bench) == 1
    await bench.host.resume(bench.anna)
    assert (await bench.served(task))["ended"] is None


async def test_a_program_keeps_the_rate_that_it_is_given(bench: Bench, tmp_path: Path) -> None:
    """Before, every step began at full speed again."""
    task = begun(bench, tmp_path, [turn(bench, 0.1), turn(bench, 0.2)])
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    await bench.served(bench.host.rate(bench.anna, 0.5))
    await bench.until(lambda: runs(bench) == 2)
    await bench.until(lambda: bench.arm.mode() is Mode.MOVING)
    rates = set()
    while not task.done():
        rates.add(bench.host.status()["rate"])
        await ticks(bench, 1)
    assert rates == {0.5, None}
    assert (await task)["ended"] is None


async def test_the_arm_is_the_program_s_and_ends_with_its_client(bench: Bench, tmp_path: Path) -> None:
    task = begun(bench, tmp_path, steps := there(bench))
    await bench.until(lambda: runs(bench) == 2)
    await bench.refused(bench.host.command(bench.ben, "park"), "BUSY")
    bench.host.client_gone(bench.anna)
    result = await bench.served(task)
    assert result["ended"]["code"] in ("STOPPED", "LEASE_LOST")
    assert bench.arm.mode() is Mode.HOLDING
    assert (await bench.served(begun(bench, tmp_path, steps)))["resumed_at"] == "3.1@1"


async def test_where_it_stands_cannot_be_kept_so_it_ends(
    bench: Bench, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    task = begun(bench, tmp_path, steps := there(bench))
    await bench.until(lambda: runs(bench) == 3)

    def full(*_: object, **__: object) -> None:
        raise LogError("the disk is full")

    with monkeypatch.context() as patch:
        patch.setattr(Site, "keep", full)
        result = await bench.served(task)
    assert result["ended"] == {"code": "LOG", "text": "the disk is full"}
    assert result["stands_at"] == "3.2@1"
    assert (await bench.served(begun(bench, tmp_path, steps)))["resumed_at"] == "3.2@1"


# ------------------------------------------------------------------------------------------------- the gripper

GRIPS = """
- {grip: open}
- {move: {joints_rad: [0.3, 1.2, -1.2, 0.0, 0.0, 1.4]}, name: there}
- {grip: close}
- if_gripped:
    then: [{move: {joints_rad: [0.0, 1.2, -1.2, 0.0, 0.0, 0.0]}, name: carry}]
    otherwise: [{wait_s: 0.5}]
- {grip: open}
"""
# How thick the thing is that is gripped, as the angle at which it stops the gripper.
THICK_RAD = math.radians(40.0)


@pytest.mark.parametrize("thing", [True, False])
async def test_what_is_gripped_decides_the_branch_and_is_carried_and_the_log_replays(
    thing: bool, tmp_path: Path
) -> None:
    async with on_arm("xiang-6dof") as bench:
        take_away = bench.place_object(THICK_RAD) if thing else lambda: None
        task = begun(bench, tmp_path, yaml.safe_load(GRIPS))
        await bench.until(lambda: bool(bench.anna.told) and bench.anna.told[-1][1].get("step") == "5")
        take_away()  # what blocks the simulated joint does so both ways
        result = await bench.served(task)
        assert result["ended"] is None
        taken = {"carry"} if thing else {"4.otherwise.1"}
        assert [row["name"] for row in result["steps"]] == ["1", "there", "3", "4", *taken, "5"]
        assert result["steps"][3]["text"] == f"gripped: {'yes' if thing else 'nothing'}"
        gripper_deg = [record.outputs.joints[5].position_rad for record in bench.recorder.records]
        assert max(gripper_deg) == pytest.approx(THICK_RAD if thing else math.radians(90.0), abs=0.1)
        assert Mode.FAULTED not in bench.modes
        replayed = bench.replayed(tmp_path / "program.mcap")
        assert (replayed.mismatches, replayed.first_mismatch) == (0, "")


async def test_what_was_gripped_and_is_lost_meanwhile_is_a_reason_not_to_go_on(tmp_path: Path) -> None:
    async with on_arm("xiang-6dof") as bench:
        take_away = bench.place_object(THICK_RAD)
        steps = yaml.safe_load(GRIPS)
        task = begun(bench, tmp_path, steps)
        await bench.until(lambda: bool(bench.anna.told) and bench.anna.told[-1][1].get("step") == "carry")
        await bench.served(bench.host.stop())
        assert (await bench.served(task))["stands_at"] == "carry"
        take_away()
        bench.ticks(20)
        refusal = await bench.refused(begun(bench, tmp_path, steps), "NOT_RESUMED")
        assert str(refusal) == (
            "program tidy-up stands at step carry with something gripped, and the gripper does not hold it any more; "
            "`--from carry` goes on all the same, `--from 1` begins anew"
        )
        result = await bench.served(begun(bench, tmp_path, steps, from_step="there"))
        assert result["resumed_at"] == "there"


async def test_both_branches_are_checked_whatever_is_gripped(tmp_path: Path) -> None:
    async with on_arm("xiang-6dof") as bench:
        far = {"move": {"point_m": [0.9, 0.0, 0.1]}}
        for branch in ("then", "otherwise"):
            steps: list[dict[str, Any]] = [{"grip": "close"}, {"if_gripped": {branch: [far]}}]
            refusal = await bench.refused(begun(bench, tmp_path, steps), "PREFLIGHT")
            assert f"step 2.{branch}.1: " in str(refusal)


async def test_branches_that_lead_to_ever_more_poses_are_refused(tmp_path: Path) -> None:
    async with on_arm("xiang-6dof") as bench:
        here = bench.host.commanded_joints("test")

        def turned(by_rad: float) -> dict[str, Any]:
            return {"move": {"joints_rad": [here[0] + by_rad, *here[1:]]}}

        # Each may end elsewhere, and what follows is reached by all of them.
        branches = [{"if_gripped": {"then": [turned(0.1 * number)]}} for number in range(1, 10)]
        last = turned(0.1)
        assert all(row["ok"] for row in site(bench, tmp_path).check(asked([*branches[:7], last]), here))
        wrong = [row for row in site(bench, tmp_path).check(asked([*branches, last]), here) if not row["ok"]]
        assert wrong[0]["text"] == "more than 8 poses lead here; let a move to joint positions come before"
        assert {row["text"] for row in wrong[1:]} == {programs.UNCHECKED}
