"""The set-up behind the page: a program of its own asks, and the service passes it on."""

import asyncio
from asyncio.subprocess import PIPE, Process
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import yaml

from armctl.host.methods import Nothing
from armctl.web.connections import Connections
from armctl.web.set_up import Answer, SetUp
from tests.host.doubles import refused


@pytest.fixture
def set_up(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SetUp:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path / "own"))
    config = tmp_path / "armctl.yaml"
    config.write_text(yaml.safe_dump({"port": str(tmp_path / "none"), "data_dir": str(tmp_path)}))
    return SetUp(str(config), Connections(tmp_path / "nobody.sock"))


async def until(set_up: SetUp, there: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
    """What is said once something holds of it, as a page is told."""
    async with set_up.pages.page() as messages:
        while not there(said := await set_up.state()):
            await messages.get()
    return said


def waits(said: dict[str, Any]) -> bool:
    return bool(said["told"]) and "question" in said["told"][-1]


def test_questions_are_passed_on_and_answered_once_and_what_ends_it_is_told(set_up: SetUp, tmp_path: Path) -> None:
    async def told() -> None:
        with refused("NOT_SET_UP", "no arm was set up here yet"):
            await set_up.start(Nothing())
        await set_up.begin(Nothing())
        [kind] = (await until(set_up, waits))["told"]
        assert (kind["question"]["key"], "lanzhou-4dof" in kind["question"]["choices"]) == ("kind", True)
        with refused("NO_QUESTION", "question 1 does not wait for an answer"):
            await set_up.answer(Answer(number=1))
        await set_up.answer(Answer(number=0, word="lanzhou-4dof"))
        with refused("NO_QUESTION", "question 0"):
            await set_up.answer(Answer(number=0, word="ax12-line"))
        said = await until(set_up, waits)
        assert said["told"][-1]["question"]["key"] == "name"
        await set_up.answer(Answer(number=2, word="mine"))
        said = await until(set_up, lambda now: not now["running"])
        assert str(tmp_path / "none") in said["told"][-1]["error"]["message"]
        assert set_up.break_off() is False

    asyncio.run(told())


def test_stop_breaks_it_off_and_says_where_it_goes_on_and_a_new_one_may_begin(set_up: SetUp) -> None:
    async def told() -> None:
        for _ in range(2):
            await set_up.begin(Nothing())
            await until(set_up, waits)
        assert set_up.break_off() is True
        said = await until(set_up, lambda now: not now["running"])
        assert said["told"][-1]["error"]["code"] == "INTERRUPTED"
        await set_up.begin(Nothing())
        await set_up.close()
        assert (await set_up.state())["running"] is False

    asyncio.run(told())


def test_one_that_does_not_hear_that_it_is_interrupted_ends_at_its_next_question(
    set_up: SetUp, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(Process, "send_signal", lambda *_: None)

    async def told() -> None:
        await set_up.begin(Nothing())
        await set_up.close()
        now = await set_up.state()
        assert (now["running"], now["told"][-1]["error"]["code"]) == (False, "INTERRUPTED")

    asyncio.run(told())


@pytest.mark.parametrize("what", ["begin", "start"])
def test_of_two_that_are_asked_for_at_once_none_is_left_running(
    set_up: SetUp, monkeypatch: pytest.MonkeyPatch, what: str
) -> None:
    begun: list[Process] = []

    async def program(*_: str, **__: object) -> Process:
        program = ("sh", "-c", "echo {}; read answer")
        begun.append(await asyncio.create_subprocess_exec(*program, stdin=PIPE, stdout=PIPE))
        return begun[-1]

    async def left() -> list[Process]:
        await asyncio.gather(*(getattr(set_up, what)(Nothing()) for _ in range(2)))
        await set_up.close()
        found = [one for one in begun if one.returncode is None]
        for one in found:
            one.kill()
            await one.wait()
        return found

    monkeypatch.setattr(set_up, "_program", program)
    monkeypatch.setattr(set_up, "_told", [{"arm": "ax12-line", "port": "none"}])
    assert asyncio.run(left()) == []
    assert len(begun) == 2
