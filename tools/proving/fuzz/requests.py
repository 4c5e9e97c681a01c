"""A client of the daemon that says almost everything wrong, and judges the answers."""

from __future__ import annotations

import asyncio
import contextlib
import itertools
import json
import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.files import load_arm
from armctl.host import jsonrpc
from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.trajectory.plan import Plan
from proving.fuzz import malformed
from proving.fuzz.files import TAKES
from proving.fuzz.tally import HANG_S, Tally
from proving.log_rig import ARM

NUMBERS = frozenset(
    {
        jsonrpc.PARSE_ERROR,
        jsonrpc.INVALID_REQUEST,
        jsonrpc.METHOD_NOT_FOUND,
        jsonrpc.INVALID_PARAMS,
        jsonrpc.ARMCTL_ERROR,
    }
)
# So near to each other that the arm is soon done.
STATIONS = {"pick_m": [0.18, -0.01, 0.1], "place_m": [0.18, 0.01, 0.1]}


def fuzzed_arm() -> ArmConfig:
    """An arm whose limits are its servos': wherever it sags while it is limp, it can be energised again."""
    arm = load_arm(ARM)
    joints = []
    for joint in arm.joints:
        low, high = sorted(math.degrees(joint.position_rad(tick)) for tick in (0, ax12a.TICK_MAX))
        limits = (math.ceil(10.0 * low) / 10.0, math.floor(10.0 * high) / 10.0)
        joints.append(joint.model_copy(update={"limits_deg": limits}))
    return ArmConfig.model_validate(arm.model_copy(update={"joints": tuple(joints)}).model_dump(mode="json"))


def requests_to(arm: ArmConfig) -> list[tuple[str, dict[str, Any]]]:
    """Every method with parameters that a holding arm at rest accepts."""
    rest = [joint.rest_rad for joint in arm.joints]
    line: dict[str, Any] = {"from_m": [0.18, -0.1, 0.1], "to_m": [0.18, 0.1, 0.1]}
    plan = Plan(
        arm_id=arm.arm_id,
        calibration_hash=arm.calibration_hash,
        **line,
        duration_s=2.0,
        via=0,
        interpolation="linear",
        waypoints_rad=(tuple(rest), (rest[0] + 0.1, *rest[1:])),
        waypoint_progress=(0.0, 1.0),
        predicted_mean_error_mm=1.0,
        predicted_max_error_mm=2.0,
        seed=0,
    ).model_dump(mode="json")
    optimize = {"recordings": list(TAKES), **line, "via": [0, 2], "duration_s": 5.0, "seed": 1}
    turns = {"times": 2, "steps": [{"wait_s": 0.2}, {"move": {"point_m": [0.18, 0.0, 0.15]}}]}
    program = {"name": "tidy", "steps": [{"name": "up", "move": {"joints_rad": rest}}, {"repeat": turns}]}
    return [
        *((method, {}) for method in ("status", "log", "subscribe", "stop", "hold", "pause", "resume")),
        *((method, {}) for method in ("torque_on", "torque_on", "park", "clear", "teach_end")),
        *((method, {}) for method in ("take_mark", "take_end", "recordings_list", "plans_list")),
        *((method, {"confirm": True}) for method in ("release", "teach_begin")),
        ("take_begin", {"name": "take"}),
        ("run", {"plan": plan}),
        ("path", {"points_m": [[0.18, -0.02, 0.12], [0.18, 0.02, 0.12]], "tolerance_mm": 2.0}),
        ("play", {"name": "take", "rate": 0.5}),
        ("program_check", program),
        ("program_run", program | {"from_step": "up"}),
        ("move", {"joints_rad": rest, "duration_s": 1.0}),
        ("move", {"point_m": [0.18, 0.0, 0.15]}),
        ("move", {"pose": [0.18, 0.0, 0.15, 0.0, 1.5, 0.0]}),
        ("reach", {"point_m": [0.18, 0.0, 0.12], "gripper": "stay", "ik": "closed", "seed": 1, "along": "above"}),
        ("grip", {"grip": "close"}),
        ("transfer", {**STATIONS, "height_m": 0.01, "lift_s": 0.4, "carry_s": 0.4, "dwell_s": 0.0}),
        ("rate", {"rate": 0.5}),
        ("jog", {"joints_rad_s": [0.0] * len(rest), "begin": True}),
        ("jog", {"tool_m_s": [0.0, 0.0, 0.01], "begin": False}),
        ("recordings_show", {"name": TAKES[0], **line}),
        ("recordings_track", {"name": TAKES[0]}),
        ("plans_save", {"name": "kept", "plan": plan}),
        ("plans_show", {"name": "kept"}),
        ("plans_delete", {"name": "kept"}),
        ("recordings_rename", {"name": TAKES[0], "to": "b"}),
        ("recordings_delete", {"name": TAKES[1]}),
        ("optimize", {**optimize, "settings": {"generations": 5, "population": 10}}),
    ]


def unfit(line: bytes) -> str:
    """What is wrong with an answer; empty: nothing, it is a result or a declared error."""
    try:
        answer = json.loads(line)
        if answer["jsonrpc"] != "2.0" or not isinstance(answer["id"], int | str | None):
            return "no JSON-RPC answer"
        if "result" in answer:
            return "" if isinstance(answer["result"], dict) and "error" not in answer else "no result object"
        error = answer["error"]
        data = error["data"]
        if error["code"] not in NUMBERS:
            return f"undeclared error {error['code']} ({data['code']})"
        told = data["reasons"] and all(isinstance(reason, str) and reason for reason in data["reasons"])
        return "" if told and data["exit_status"] in (1, 2, 3) else "an error without its reasons"
    except (ValueError, TypeError, KeyError) as error:
        return f"no answer at all: {error!r}"


def wants_answer(line: bytes) -> bool:
    """Whether a line is answered: everything but a notification is."""
    try:
        return jsonrpc.decode(line).answered
    except jsonrpc.ProtocolError:
        return True


def method_of(line: bytes) -> str:
    try:
        return jsonrpc.decode(line).method
    except jsonrpc.ProtocolError:
        return ""


class Asker:
    """A client that sends lines and counts what it is owed."""

    def __init__(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter, tally: Tally) -> None:
        self._reader, self._writer, self._tally = reader, writer, tally
        self.owed = 0
        self.asked = 0
        self.latest: Sequence[bytes] = ()
        self._settled = asyncio.Event()
        self._reading = asyncio.create_task(self._read())

    @classmethod
    async def connect(cls, path: Path, tally: Tally) -> Asker:
        return cls(*await asyncio.open_unix_connection(path, limit=1 << 24), tally)

    def ask(self, lines: Sequence[bytes]) -> None:
        self.latest = lines
        self.owed += sum(map(wants_answer, lines))
        self.asked += len(lines)
        if self.owed:
            self._settled.clear()
        self._writer.write(b"".join(line + b"\n" for line in lines))

    async def settle(self, timeout_s: float) -> bool:
        """Whether every answer came in time."""
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(timeout_s):
                if self.owed:
                    await self._settled.wait()
        return not self.owed

    async def leave(self, unfinished: bytes = b"") -> None:
        """Go away in the middle of a line."""
        self._reading.cancel()
        await asyncio.gather(self._reading, return_exceptions=True)
        self._writer.write(unfinished)
        self._writer.close()
        with contextlib.suppress(OSError):
            await self._writer.wait_closed()

    async def _read(self) -> None:
        with contextlib.suppress(OSError):
            while line := await self._reader.readline():
                if line.startswith(b'{"jsonrpc":"2.0","method":'):
                    continue  # a snapshot, or progress
                if problem := unfit(line):
                    self._tally.violation(f"{problem} {line[:200]!r} among the answers to {self.latest!r}")
                self._tally.outcomes[_outcome(line)] += 1
                self.owed -= 1
                if self.owed == 0:
                    self._settled.set()
        self._tally.violation(f"the connection ended after {self.latest!r}")


def _outcome(line: bytes) -> str:
    answer = json.loads(line)
    return "done" if "result" in answer else str(answer["error"]["data"]["code"])


class Lines:
    """Request lines in batches."""

    def __init__(self, seed: int, arm: ArmConfig) -> None:
        self.rng = random.Random(seed)
        self._valid = requests_to(arm)
        self._ids = itertools.count(1)

    def batch(self, count: int) -> list[bytes]:
        return [malformed.request_line(self.rng, self._valid, next(self._ids)) for _ in range(count)]


async def overlong(path: Path, line: bytes, tally: Tally) -> None:
    """One line around the longest that is allowed gets one answer as well."""
    reader, writer = await asyncio.open_unix_connection(path)
    writer.write(line + b"\n")
    try:
        async with asyncio.timeout(HANG_S):
            if problem := unfit(await reader.readline()):
                tally.violation(f"{problem} to a line of {len(line)} bytes, {line[:20]!r}...")
    except OSError as error:
        # Who still writes what nobody reads any more may lose the answer to it.
        if isinstance(error, TimeoutError) or len(line) < MAX_LINE_BYTES:
            tally.violation(f"{type(error).__name__} after a line of {len(line)} bytes, {line[:20]!r}...")
    tally.outcomes["overlong"] += 1
    writer.close()
    with contextlib.suppress(OSError):
        await writer.wait_closed()
