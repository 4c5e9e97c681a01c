"""`armctl teach`: an arm guided by hand, and its tool followed from take to take."""

from __future__ import annotations

import math
import sys
from collections import deque
from collections.abc import Callable, Collection
from functools import partial
from typing import Any

from armctl.cli.arm import warn_of_limpness
from armctl.cli.jobs import OWN_LINE, WANTED, in_words
from armctl.cli.keys import attended, keys
from armctl.cli.output import SOCKET, Output, Point, command
from armctl.client import Client
from armctl.commissioning.texts import refusal, said
from armctl.errors import ConfigError, LogError

# How near its start a take begins.
AT_START_M = 0.04
# How far the tool goes before a rest can end a take.
MOVED_M = 0.03
# Largest change of the tool's place that still counts as rest.
STILL_M = 0.004
SETTLE_S = 0.5
REST_S = 1.0
ENTER = frozenset("\r\n")
# From where to where the tool is to be led; None: anywhere.
Line = tuple[Point, Point] | None


@command("teach", SOCKET)
def teach_command(
    output: Output, name: str, takes: int, from_m: Point | None, to_m: Point | None, countdown: int, yes: bool
) -> None:
    """Make the arm limp, and record while you guide it by hand. Ctrl-C ends it; the arm stays limp.

    Carry the tool to the start and rest it there for half a second (or press Enter): the take begins. Guide it along
    the line; it ends when the tool rests for a second (or on Enter). Rest it for half a second on the way, or press any
    other key, to mark a via point. Every further take begins where the first did. Takes are named NAME, or NAME-1,
    NAME-2, ... and never overwrite one another.

    If torque is on, it asks first and counts down. Where nobody can be asked (no terminal, or in the background) it is
    refused without --yes.

    Example: armctl teach line --takes 5 --from 0.18,-0.125,0.10 --to 0.18,0.125,0.10
    """
    if (from_m is None) != (to_m is None) or (from_m and from_m == to_m):
        raise ConfigError("armctl teach", "--from/--to", "a line has two ends", "give both, not the same, or neither")
    if not yes and not attended(sys.stdin):
        raise refusal("NOT_CONFIRMED", name=name)
    names = [name] if takes == 1 else [f"{name}-{take}" for take in range(1, takes + 1)]
    line: dict[str, Any] = {} if from_m is None else {"from_m": from_m, "to_m": to_m}
    made = []
    with output.client() as commander, output.client() as watcher:
        taken = {recording["name"] for recording in commander.call("recordings_list")["recordings"]} & set(names)
        if taken:
            raise LogError(f"recording {sorted(taken)[0]} exists; choose another name, or delete it")
        if not yes:
            warn_of_limpness(output, commander, countdown, "the arm will go limp. Go on?")
        output.after_interrupt = said("limp")
        commander.call("teach_begin", confirm=True)
        output.kept = output.after_interrupt
        output.say("the arm is limp; support it")
        start = from_m
        try:
            with keys(sys.stdin) as pressed:
                tool = Tool(output, watcher, partial(pressed.wait, 0.0), (from_m, to_m) if from_m and to_m else None)
                for take in names:
                    place = "start" if start is None else "start at " + ", ".join(f"{x:.3f}" for x in start)
                    output.say(f"{take}: carry the tool to the {place} and rest it there (or press Enter)")
                    start = tool.settle(start)
                    made.append(record_take(output, commander, tool, take, start, line))
        finally:
            commander.call("teach_end")
    output.answer({"recordings": made}, "")


def record_take(
    output: Output, commander: Client, tool: Tool, take: str, start: Point, line: dict[str, Any]
) -> dict[str, Any]:
    """Record one take from its start on; what the daemon says of it, with its via points."""
    commander.call("take_begin", name=take)
    tool.recorded(take)
    output.say(f"{take}: recording; guide it along the line and rest it at the end (or press Enter)")
    marks: list[dict[str, Any]] = []
    end = tool.guided(start, lambda: marks.append(commander.call("take_mark")))
    commander.call("take_end")
    shown = commander.call("recordings_show", name=take, **line)
    # The tool rests at the end of a take, so a mark there is no via point.
    shown["marks"] = [mark for mark in marks if math.dist(mark["position_m"], end) > AT_START_M]
    output.say(in_words(shown, WANTED if line else OWN_LINE))
    return shown


class Tool:
    """The tool's place as the daemon sees it, followed tick by tick.

    Args:
        key: What was pressed since it was last asked, one character; empty: nothing.
    """

    # In which it is followed; None: in all.
    states: Collection[str] | None = ("teaching", "stalled")

    def __init__(self, output: Output, watcher: Client, key: Callable[[], str], line: Line = None) -> None:
        self._output, self._key, self._line = output, key, line
        # Where the take begins; between which shares of the line the tool has been in it, None: it has not begun.
        self._start: Point | None = None
        self._covered: tuple[float, float] | None = None
        self._snapshots = watcher.subscribe()
        self._recent: deque[Point] = deque(maxlen=100)
        self._warned = False

    def recorded(self, take: str) -> None:
        """Wait until the take is seen to be recorded: a tick that came before is not in it."""
        while next(self._snapshots)["recording"] != take:
            pass

    def settle(self, start: Point | None) -> Point:
        """Wait until the tool rests near `start` (anywhere if None), or for Enter; returns where it is."""
        self._start, self._covered = start, None
        moved = start is not None
        self._recent.clear()
        while True:
            place, period_s, key = self._next()
            moved = moved or math.dist(place, self._recent[0]) > MOVED_M
            near = start is None or math.dist(place, start) <= AT_START_M
            if key in ENTER or (moved and near and self._rests(SETTLE_S, period_s)):
                return place

    def guided(self, start: Point, mark: Callable[[], None]) -> Point:
        """Wait until the tool has gone along and rests again, or for Enter; returns where it is.

        Args:
            mark: Called where the tool dwells on its way, or a key other than Enter is pressed.
        """
        moved = False
        self._start, self._covered, last = start, (1.0, 0.0), start
        self._recent.clear()
        while True:
            place, period_s, key = self._next()
            moved = moved or math.dist(place, start) > AT_START_M + MOVED_M
            if key in ENTER or (moved and self._rests(REST_S, period_s)):
                return place
            if key or (math.dist(place, last) > AT_START_M and self._rests(SETTLE_S, period_s)):
                last = place
                mark()

    def _rests(self, seconds: float, period_s: float) -> bool:
        count = round(seconds / period_s)
        recent = list(self._recent)[-count:]
        return len(recent) == count and all(math.dist(place, recent[-1]) < STILL_M for place in recent)

    def _next(self) -> tuple[Point, float, str]:
        """The tool's place after the next tick, the tick's length, and the key that was pressed."""
        snapshot = next(self._snapshots)
        if self.states is not None and snapshot["state"] not in self.states:
            fault = snapshot["fault"]
            why = f"{fault['code']}: {fault['text']}" if fault else f"the arm is {snapshot['state']}"
            raise refusal("TEACH_ENDED", why=why)
        x, y, z = snapshot["tool"]["position_m"]
        speed_m_s = snapshot["tool"]["speed_m_s"] or 0.0
        limit_m_s = snapshot["tool_speed_limit_m_s"]
        if speed_m_s > limit_m_s and not self._warned:
            self._warned = True
            self._output.say(said("fast", speed_mm_s=1e3 * speed_m_s, limit_mm_s=1e3 * limit_m_s))
        self._recent.append((x, y, z))
        place = ", ".join(f"{1000.0 * value:.0f}" for value in (x, y, z))
        self._output.live(f"tool {place} mm  {1000.0 * speed_m_s:.0f} mm/s{self._way((x, y, z))}")
        return (x, y, z), float(snapshot["period_s"]), self._key()

    def _way(self, place: Point) -> str:
        """How far the tool is from the start of the take, and how it follows the line that is wanted."""
        import numpy as np

        from armctl.trajectory.straightness import distance_to_line, progress_along_line

        told = f"  from the start {1000.0 * math.dist(place, self._start):.0f} mm" if self._start else ""
        if self._line and self._covered:
            P, A, B = np.array([place, *self._line])
            share = min(max(float(progress_along_line(P, A, B)), 0.0), 1.0)
            low, high = self._covered = min(self._covered[0], share), max(self._covered[1], share)
            told += f"  off the line {1000.0 * float(distance_to_line(P, A, B)):.0f} mm  covered {high - low:.0%}"
        return told
