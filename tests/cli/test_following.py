"""`armctl play` and `armctl path` as they are typed; the daemon is a stand-in."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl import client
from armctl.host.jsonrpc import MAX_LINE_BYTES
from armctl.trajectory.playback import PlayRequest, TaughtMotion
from armctl.trajectory.tool_path import PathRequest
from tests.cli.conftest import Answer, Typed

ERRORS = {"mean_error_mm": 1.0, "max_error_mm": 2.0}
ANSWER = {"recording": "run-1", **ERRORS, "duration_s": 4.0}
MORE = {f"{kind}_{key}": value for kind in ("path", "predicted") for key, value in ERRORS.items()}
SQUARE = "x_m,y_m,z_m\n0.18,0,0.1\n0.2,0,0.1\n0.2,0.02,0.1\n"


class Daemon:
    """Notes what it was asked, as it would pass the socket."""

    asked: tuple[str, str] = "", ""

    def call(self, method: str, *, on_progress: object, **params: Any) -> dict[str, Any]:
        Daemon.asked = method, json.dumps(params)
        return ANSWER | MORE


@contextlib.contextmanager
def connected(socket: str | None) -> Iterator[Daemon]:
    yield Daemon()


@pytest.fixture(autouse=True)
def daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Client", connected)


def asked(method: str) -> Any:
    assert Daemon.asked[0] == method
    return json.loads(Daemon.asked[1])


def test_a_path_is_sent_as_its_file_says(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    file = tmp_path / "square.csv"
    file.write_text(SQUARE)
    assert answer("path", file, "--duration", "9") == ANSWER | MORE
    points = ((0.18, 0.0, 0.1), (0.2, 0.0, 0.1), (0.2, 0.02, 0.1))
    wanted = PathRequest(points_m=points, kinds=("line",) * 3, duration_s=9.0)
    told = asked("path")
    assert told.pop("refine") == 0
    assert PathRequest.model_validate(told) == wanted
    said = typed("path", file).out.replace("\n", " ")
    assert "1.0 mm mean and 2.0 mm at most off the path as the file has it" in said


def test_a_recording_is_played_by_its_name(answer: Answer, typed: Typed) -> None:
    assert answer("play", "line-1", "--rate", "0.5", "--repeat", "3") == ANSWER | MORE
    assert asked("play") == {"name": "line-1", "rate": 0.5, "repeat": 3}
    assert "at the same progress" in typed("play", "line-1").out.replace("\n", " ")


def test_a_log_and_a_table_are_sent_as_motions(takes: list[str], tmp_path: Path, answer: Answer) -> None:
    answer("play", takes[0])
    of_log = PlayRequest.model_validate(asked("play")).motion
    assert of_log is not None
    assert (of_log.arm_id, of_log.joints[0], len(of_log.joints)) == ("ax12-line", "base", 6)
    table = tmp_path / "motion.csv"
    header, rows = ",".join(("time_s", *of_log.joints)), zip(of_log.time_s, of_log.positions_rad, strict=True)
    table.write_text("\n".join([header, *(",".join(map(str, (t, *q))) for t, q in rows)]))
    answer("play", table)
    of_table = PlayRequest.model_validate(asked("play")).motion
    assert of_table == TaughtMotion(**of_log.model_dump(exclude={"arm_id", "calibration_hash"}))


def test_what_does_not_fit_into_one_line_of_the_socket_is_refused_before_it_is_sent(
    tmp_path: Path, typed: Typed
) -> None:
    table = tmp_path / "long.csv"
    rng = np.random.default_rng(0)

    def write(rows: int) -> None:
        lines = [",".join(f"{q:.5f}" for q in rng.uniform(-2.0, -1.0, 6)) for _ in range(rows)]
        table.write_text("\n".join(["time_s,a,b,c,d,e,f", *(f"{100.0 + t / 10:.6f},{q}" for t, q in enumerate(lines))]))

    write(857)
    typed("play", table)
    assert len(Daemon.asked[1]) < MAX_LINE_BYTES - 200
    write(900)
    assert "at most 6000 reach the daemon at once" in typed("play", table, status=2).err.replace("\n", " ")
