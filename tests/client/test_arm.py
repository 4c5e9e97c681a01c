"""The typed client: the daemon understands what it asks, answers are as their types say, and Ctrl-C stops the arm."""

import asyncio
import json
import os
import re
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, NotRequired, get_args, get_origin, get_type_hints, is_typeddict

import numpy as np
import pytest
from mypy import api

import armctl
from armctl import Arm, AsyncArm
from armctl.client.answers import Followed, Moved, Programmed, State, Status
from armctl.client.arm import Commands
from armctl.errors import ArmctlError, RequestRefused
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.trajectory.plan import plan_to_text
from proving.hosted_arm import HostedArm
from tests.control.ideal_arm import IdealArm
from tests.host.doubles import methods_over, small_plan

ROOT = Path(armctl.__file__).parent.parent
EXAMPLES = ROOT / "armctl" / "docs" / "examples"
HERE = (0.18, 0.0, 0.15)


class Told(Arm):
    """Asks nobody; keeps what would be asked, and fails as it is told to."""

    def __init__(self, error: BaseException | None = None, answer: dict[str, Any] | None = None) -> None:
        self.asked: list[tuple[str, dict[str, Any]]] = []
        self._error, self._answer = error, answer or {}

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.asked.append((method, json.loads(json.dumps(params, default=np.ndarray.tolist))))
        if self._error is not None and method != "stop":
            raise self._error
        return self._answer


def everything(arm: Commands[Any, Any, Any, Any, Any], folder: Path) -> dict[str, Callable[[], Any]]:
    """Each method of the client, with every parameter that it has."""
    (folder / "plan.json").write_text(plan_to_text(small_plan(IdealArm())))
    return {
        "status": arm.status,
        "stop": arm.stop,
        "pause": arm.pause,
        "resume": arm.resume,
        "torque_on": arm.torque_on,
        "release": lambda: arm.release(confirm=True),
        "park": arm.park,
        "clear": arm.clear,
        "move": lambda: arm.move(xyz=np.array(HERE), duration_s=3.0),
        "jog": lambda: arm.jog(0.0, tool_m_s=(0.0, 0.0, 0.01)),
        "reach": lambda: arm.reach(HERE, gripper="grip"),
        "grip": lambda: arm.grip("open"),
        "play": lambda: arm.play("a", rate=0.5, repeat=2),
        "path": lambda: arm.path(np.array([HERE, (0.18, 0.05, 0.15)]), kinds=("line", "line"), duration_s=4.0),
        "run": lambda: arm.run(folder / "plan.json", refine=1),
        "program_run": lambda: arm.program_run(EXAMPLES / "wave.yaml", from_step="1"),
    }


def test_what_every_method_asks_is_a_request_of_that_name_that_the_daemon_understands(tmp_path: Path) -> None:
    async def nobody(*_: Any) -> dict[str, Any]:
        return {}

    table, arm = methods_over(tmp_path, nobody).table(), Told()
    methods = everything(arm, tmp_path)
    assert methods.keys() == {name for name in vars(Commands) if name.isidentifier() and not name.startswith("_")}
    for name, ask in methods.items():
        arm.asked.clear()
        ask()
        assert arm.asked[0][0] == name
        for method, params in arm.asked:
            table[method].params.model_validate(params)


@pytest.mark.parametrize("name", ["move", "jog", "program_run"])
@pytest.mark.parametrize("error", [KeyboardInterrupt(), SystemExit(1), ZeroDivisionError()])
def test_whatever_interrupts_a_motion_stops_the_arm(name: str, error: BaseException, tmp_path: Path) -> None:
    arm = Told(error)
    with pytest.raises(type(error)):
        everything(arm, tmp_path)[name]()
    assert [method for method, _ in arm.asked][1:] == ["stop"]


def test_a_motion_that_the_daemon_refused_needs_no_stop(tmp_path: Path) -> None:
    arm = Told(RequestRefused("BUSY", "another commands"))
    with pytest.raises(RequestRefused, match="another"):
        arm.move(xyz=HERE)
    assert [method for method, _ in arm.asked] == ["move"]


def test_an_arm_goes_limp_for_teaching_only_where_it_is_limp_or_somebody_says_so() -> None:
    for state, said, confirmed in (("off", False, True), ("holding", False, False), ("holding", True, True)):
        arm = Told(answer={"state": state})
        arm.teach("a", list, confirm=said)
        assert dict(arm.asked)["teach_begin"] == {"confirm": confirmed}
        assert [method for method, _ in arm.asked][-3:] == ["take_begin", "take_end", "teach_end"]


class Virtual(AsyncArm):
    """An arm behind the daemon's own host, in virtual time."""

    def __init__(self, folder: Path, arm: str) -> None:
        robot = robots.get(load_arm(arm).robot, load_arm(arm).lengths_m)
        self.methods: list[str] = []
        self.hosted = HostedArm(Path(arm), folder, 1, lambda q: tool_position(robot.chain, q[:, : robot.chain.n]))

    async def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.methods.append(method)
        return await self.hosted.ask(method, **json.loads(json.dumps(params, default=np.ndarray.tolist)))


def against(answer: Any, kind: Any) -> list[str]:
    """Where an answer is not as its type says."""
    kind = get_args(kind)[0] if get_origin(kind) is NotRequired else kind
    if is_typeddict(kind) and isinstance(answer, dict):
        hints = get_type_hints(kind, include_extras=True)
        wanted = {key for key, hint in hints.items() if get_origin(hint) is not NotRequired}
        return [f"no {key}" for key in wanted - answer.keys()] + [
            f"{key}: {wrong}" for key in hints.keys() & answer.keys() for wrong in against(answer[key], hints[key])
        ]
    if (origin := get_origin(kind)) is list:
        [inner] = get_args(kind)
        return [wrong for one in answer for wrong in against(one, inner)]
    if origin is not None and origin is not dict:  # a union
        found = [against(answer, one) for one in get_args(kind)]
        return [] if [] in found else found[0]
    good = kind is Any or type(answer) is (origin or kind) or (kind is float and type(answer) is int)
    return [] if good else [f"{answer!r} is no {kind}"]


async def test_what_the_daemon_answers_is_as_the_types_say(tmp_path: Path) -> None:
    arm = Virtual(tmp_path, "xiang-6dof")
    try:
        assert against(await arm.status(), Status) == []
        assert against(await arm.torque_on(), State) == []
        here = list((await arm.hosted.ask("status"))["tool"]["position_m"])
        moved = await arm.move(xyz=(here[0], here[1], here[2] + 0.03))
        assert against(moved, Moved) == []
        assert np.abs(np.subtract(arm.hosted.tool_m, moved["position_m"])).max() < 0.02
        assert against(await arm.grip("close"), Moved) == []
        assert (await arm.grip("open"))["gripped"] is False
        x, y, z = moved["position_m"]
        assert against(await arm.reach((x, y, z - 0.02)), Moved) == []
        followed = await arm.path([(x, y, z), (x, y + 0.03, z)])
        assert against(followed, Followed) == []
        assert against(await arm.play(followed["recording"]), Followed) == []
        steps = tmp_path / "steps.yaml"
        steps.write_text("steps: [{wait_s: 0.2}]")
        assert against(await arm.program_run(steps), Programmed) == []
    finally:
        arm.hosted.close()
    assert against({"recording": 1, "mean_error_mm": "0"}, Followed) != []


async def test_a_motion_that_is_cancelled_stops_the_arm(tmp_path: Path) -> None:
    arm = Virtual(tmp_path, "ax12-line")
    try:
        await arm.torque_on()
        moving = asyncio.create_task(arm.move(joints_rad=(0.5, 2.2, -2.0, 1.0, 0.0, 0.0)))
        for _ in range(10):
            await asyncio.sleep(0)
        moving.cancel()
        with pytest.raises((asyncio.CancelledError, ArmctlError)):
            await moving
    finally:
        arm.hosted.close()
    assert arm.methods[-1] == "stop"


FORKED = """
import os, signal, sys
from armctl import Arm
arm = Arm(sys.argv[1])
if child := os.fork():
    print(child, flush=True)
    os._exit(9)
signal.pause()
"""


def test_a_child_that_outlives_its_parent_does_not_keep_the_connection(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(tmp_path / "s"))
        listening.listen()
        command = [sys.executable, "-c", FORKED, str(tmp_path / "s")]
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as parent:
            assert parent.stdout is not None
            child = int(parent.stdout.readline())
            try:
                connection, _ = listening.accept()
                with connection:
                    connection.settimeout(20.0)
                    assert connection.recv(1) == b""
            finally:
                os.kill(child, signal.SIGKILL)  # raises where it has ended already
        assert parent.returncode == 9


WRONG = """
from armctl import Arm, AsyncArm

with Arm() as arm:
    arm.moove(xyz=(0.1, 0.0, 0.1))  # wrong
    arm.move(poin_m=(0.1, 0.0, 0.1))  # wrong
    arm.move(xyz="somewhere")  # wrong
    arm.grip("shut")  # wrong
    arm.release()  # wrong
    print(arm.play("a")["mean_eror_mm"])  # wrong
    print(arm.play("a")["mean_error_mm"] + 1.0)

async def later(arm: AsyncArm) -> None:
    print(arm.play("a")["mean_error_mm"])  # wrong
    print((await arm.play("a"))["mean_error_mm"])
"""


def test_examples_are_strictly_typed_and_what_is_wrong_is_rejected(tmp_path: Path) -> None:
    wrong = tmp_path / "wrong.py"
    wrong.write_text(WRONG)
    files = [str(path) for path in (wrong, *sorted(EXAMPLES.glob("*.py")))]
    found, failed, _ = api.run(["--strict", "--config-file", str(ROOT / "pyproject.toml"), *files])
    assert failed == ""
    lines = [number for number, line in enumerate(WRONG.splitlines(), 1) if "# wrong" in line]
    told = re.findall(r"^(.*?):(\d+): error", found, re.MULTILINE)
    assert {(Path(file).name, int(number)) for file, number in told} == {("wrong.py", number) for number in lines}
