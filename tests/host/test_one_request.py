"""One type for each request: no field changes its name between the command line, the socket, the job and the plan."""

import asyncio
import json
import pickle
from pathlib import Path
from typing import Any, Self, cast

import click
import pytest

from armctl import client
from armctl.cli import main
from armctl.cli.jobs import optimize_command, play_command
from armctl.cli.motion import move_command, path_command, reach_command, transfer_command
from armctl.cli.program import program_run
from armctl.config import Frozen, validate
from armctl.genetic.algorithm import PROFILES
from armctl.genetic.request import OptimizeRequest
from armctl.genetic.straight_line import Progress, optimize
from armctl.host import jobs
from armctl.host.jobs import OptimizeJob
from armctl.host.server import Connection
from armctl.trajectory.grasp import ReachRequest
from armctl.trajectory.plan import Plan, plan_from_text
from armctl.trajectory.playback import PlayRequest, TaughtMotion
from armctl.trajectory.program import ProgramRequest
from armctl.trajectory.target import MoveRequest
from armctl.trajectory.tool_path import PathRequest
from armctl.trajectory.transfer import TransferRequest
from tests.host.doubles import methods_over


@pytest.mark.parametrize(
    ("method", "command", "request_type", "chosen_otherwise"),
    [
        ("optimize", optimize_command, OptimizeRequest, {"settings", "free", "interpolation"}),  # --profile
        ("reach", reach_command, ReachRequest, {"gripper"}),  # --grip, --let-go
        ("transfer", transfer_command, TransferRequest, set()),
        ("move", move_command, MoveRequest, set()),
        ("play", play_command, PlayRequest, {"motion"}),  # NAME|FILE
        ("path", path_command, PathRequest, {"points_m", "kinds", "learnt"}),  # FILE
        ("program_run", program_run, ProgramRequest, {"name", "steps"}),  # FILE
    ],
)
def test_an_option_a_parameter_and_a_field_have_the_same_name(
    method: str, command: click.Command, request_type: type[Frozen], chosen_otherwise: set[str], tmp_path: Path
) -> None:
    fields = set(request_type.model_fields)
    assert fields - {param.name for param in command.params} == chosen_otherwise
    assert issubclass(methods_over(tmp_path, in_this_process).table()[method].params, request_type)


async def in_this_process(job: OptimizeJob, progress: Progress) -> dict[str, Any]:
    return jobs.optimize_task(pickle.loads(pickle.dumps(job)), progress)


class Daemon:
    """Stands in for the client: hands each call to the table of methods, as text and back."""

    def __init__(self, folder: Path, seen: list[dict[str, Any]]) -> None:
        self._folder, self._seen = folder, seen

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        pass

    def notify(self, *_: object) -> None:
        pass

    def call(self, method: str, *, on_progress: object, **params: Any) -> dict[str, Any]:
        params = json.loads(json.dumps(params))
        self._seen.append(params)

        async def answer() -> dict[str, Any]:
            entry = methods_over(self._folder, in_this_process).table()[method]
            return await entry.handle(cast("Connection", self), validate(entry.params, params, method))

        return asyncio.run(answer())


def test_an_optimisation_is_one_object_from_the_command_line_to_the_plan(
    taken: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    params: list[dict[str, Any]] = []
    asked: list[OptimizeRequest] = []

    def seen(takes: Any, arm: Any, robot: Any, request: OptimizeRequest, progress: Any) -> Any:
        asked.append(request)
        return optimize(takes, arm, robot, request, progress)

    monkeypatch.setattr(client, "Client", lambda _socket: Daemon(taken, params))
    monkeypatch.setattr(jobs, "optimize", seen)
    out = taken / "plan.json"
    line = ["--from", "0.18,-0.125,0.10", "--to", "0.18,0.125,0.10", "--duration", "6", "--seed", "7", "--via", "1"]
    assert main(["optimize", "a", "b", *line, "--profile", "paper", "--objective", "mix", "--out", str(out)]) == 0
    capsys.readouterr()
    ends: dict[str, Any] = {"from_m": (0.18, -0.125, 0.10), "to_m": (0.18, 0.125, 0.10)}
    how: dict[str, Any] = {"objective": "mix", "free": False, "settings": PROFILES["paper"]}
    wanted = OptimizeRequest(**ends, **how, via=(1,), duration_s=6.0, seed=7)
    [sent], [request] = params, asked
    assert set(sent) == {*OptimizeRequest.model_fields, "recordings"}
    assert request.model_dump(exclude={"recordings"}) == wanted.model_dump()
    plan = plan_from_text(out.read_text(encoding="utf-8"), "plan")
    named = {*OptimizeRequest.model_fields} & {*Plan.model_fields}
    assert named == {"from_m", "to_m", "via", "duration_s", "seed", "interpolation"}
    assert plan.model_dump(include=named) == wanted.model_dump(include=named) | {"via": 1}


@pytest.mark.parametrize(
    "request_",
    [
        OptimizeRequest(from_m=(0.1, 0.0, 0.1), to_m=(0.2, 0.0, 0.1), via=(0, 2), settings=PROFILES["paper"]),
        ReachRequest(point_m=(0.1, 0.0, 0.1), gripper="grip"),
        TransferRequest(pick_m=(0.1, 0.0, 0.1), place_m=(0.1, 0.1, 0.1)),
        MoveRequest(pose=(0.1, 0.0, 0.1, 0.0, 1.0, 0.0)),
        PlayRequest(
            motion=TaughtMotion(joints=("a", "b"), time_s=(0.0, 1.0), positions_rad=((0.0, 0.1), (0.2, 0.3))), rate=0.5
        ),
        PathRequest(points_m=((0.1, 0.0, 0.1), (0.2, 0.0, 0.1), (0.2, 0.1, 0.1)), kinds=("line", "through", "arc")),
    ],
    ids=lambda request_: type(request_).__name__,
)
def test_a_request_is_the_same_behind_a_pipe_and_behind_the_socket(request_: Frozen) -> None:
    assert pickle.loads(pickle.dumps(request_)) == request_
    assert validate(type(request_), json.loads(json.dumps(request_.model_dump())), "request") == request_
