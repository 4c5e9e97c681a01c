"""The set-up of an arm on the page: `armctl setup --json`, a program of its own, whose questions and answers pass here.

Rules.
1. One at a time. Nobody else has the port meanwhile: a daemon that was started from here is ended first, any other one
   by whoever started it.
2. STOP interrupts it as Ctrl-C does at a terminal. When this program ends it ends, and the daemon started here too.
"""

import asyncio
import contextlib
import json
import signal
import sys
from asyncio.subprocess import PIPE, Process
from typing import Any

from fastapi import APIRouter
from pydantic import Field

from armctl.config import Frozen
from armctl.errors import RequestRefused
from armctl.host.methods import Nothing
from armctl.web.connections import Connections


class Answer(Frozen):
    """What is said to a question, which is told[number]; where only Enter is wanted, nothing."""

    number: int
    word: str = Field("", max_length=100, pattern=r"^[^\r\n]*$")


class SetUp:
    """The set-up under way, and the daemon of the arm that was set up."""

    def __init__(self, config_file: str | None, daemon: Connections) -> None:
        """
        Args:
            config_file: That of the programs that are started, if one was named.
            daemon: Where the pages are told of it, and where the daemon will be that is started.
        """
        self._config = ("--config", config_file) if config_file else ()
        self.pages = daemon
        self._wizard: Process | None = None
        self._daemon: Process | None = None
        self._following: asyncio.Task[None] | None = None
        # Held from ending what runs until what takes its place does.
        self._changing = asyncio.Lock()
        # What was said, a line each: `question`, `answer` or `step`; in the end `error`, or `arm` and `port`.
        self._told: list[dict[str, Any]] = []

    def routes(self) -> APIRouter:
        router = APIRouter()
        router.get("/setup")(self.state)
        for handler in (self.begin, self.answer, self.start):
            router.post(f"/setup/{handler.__name__}")(handler)
        return router

    async def state(self) -> dict[str, Any]:
        """What was said and answered, line by line, and whether the set-up is under way."""
        return {"told": self._told, "running": self._wizard is not None}

    async def begin(self, _: Nothing) -> None:
        """Begin to set an arm up, or go on where it was broken off; one that is being set up here is broken off."""
        async with self._changing:
            await self.close()
            self._told, self._wizard = [], await self._program("setup", stdin=PIPE)
            self._following = asyncio.create_task(self._follow(self._wizard))

    async def answer(self, body: Answer) -> None:
        """Answer the question that waits; `q` breaks off."""
        if self._wizard is None or body.number != len(self._told) - 1 or "question" not in self._told[-1]:
            raise RequestRefused("NO_QUESTION", f"question {body.number} does not wait for an answer")
        assert self._wizard.stdin is not None
        self._wizard.stdin.write(f"{body.word}\n".encode())
        await self._tell({"answer": body.word})

    async def start(self, _: Nothing) -> None:
        """Begin to control the arm that was set up."""
        async with self._changing:
            done = self._told[-1] if self._told else {}
            if "arm" not in done:
                raise RequestRefused("NOT_SET_UP", "no arm was set up here yet")
            await self.close()
            where = ("--port", done["port"], "--socket", str(self.pages.socket))
            self._daemon = await self._program("daemon", "--arm", done["arm"], *where)
            assert self._daemon.stdout is not None
            told = json.loads(await self._daemon.stdout.readline())
            if "error" in told:
                raise RequestRefused("NOT_STARTED", told["error"]["message"])

    def break_off(self) -> bool:
        """Interrupt the set-up under way; whether there was one."""
        if self._wizard is not None:
            _interrupt(self._wizard)
        return self._wizard is not None

    async def close(self) -> None:
        """End what was started here."""
        for program in filter(None, (self._wizard, self._daemon)):
            _interrupt(program)
            await program.wait()
        if self._following is not None:
            await self._following

    async def _program(self, *words: str, **pipes: Any) -> Process:
        command = (sys.executable, "-m", "armctl", *words, "--json", *self._config)
        return await asyncio.create_subprocess_exec(*command, stdout=PIPE, start_new_session=True, **pipes)

    async def _follow(self, wizard: Process) -> None:
        """Take down what the wizard says, until it ends."""
        assert wizard.stdout is not None
        async for line in wizard.stdout:
            await self._tell(json.loads(line))
        await wizard.wait()
        self._wizard = None
        await self._tell()

    async def _tell(self, *lines: dict[str, Any]) -> None:
        self._told += lines
        self.pages.tell({"kind": "setup", **await self.state()})


def _interrupt(program: Process) -> None:
    if program.stdin is not None:
        program.stdin.close()  # where interrupts are ignored, as in the background of a script, it has nobody to ask
    with contextlib.suppress(ProcessLookupError):  # it has ended
        program.send_signal(signal.SIGINT)
