"""`armctl program` as it is typed; the daemon is a stand-in, or there is none."""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest

from armctl import client
from armctl.cli.help import DOCS
from armctl.cli.keys import TerminalKeys
from armctl.cli.output import Output
from armctl.cli.program import HELP, Recorder
from armctl.client import Client
from armctl.trajectory.program import program_from_text
from tests.cli.conftest import Answer, StandIn, Typed
from tests.words import missing

pytestmark = pytest.mark.usefixtures("own_folders")
EXAMPLES = DOCS / "examples"
ROWS = [{"name": "rise", "ok": True, "text": "move, 5.0 s"}, {"name": "2.1@1", "ok": True, "text": "path, 2.0 s"}]
DONE = {"recording": "run-program-wave-1", "steps": ROWS, "resumed_at": "2.1@1", "ended": None, "stands_at": None}


class Daemon(StandIn):
    """Notes what it was asked, and tells what it is told to."""

    asked: dict[str, Any]
    answer: dict[str, Any] = DONE

    def call(self, method: str, *, on_progress: Any = lambda _: None, **params: Any) -> dict[str, Any]:
        Daemon.asked = {"method": method, **json.loads(json.dumps(params))}
        for told in ({"step": "2.1@1", "text": "path, 2.0 s"}, {"warning": "SLOWED", "text": "!"}):
            on_progress(told)
        return Daemon.answer


@pytest.fixture
def daemon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(client, "Client", Daemon)


@pytest.mark.usefixtures("daemon")
def test_a_program_is_sent_as_its_file_says_and_told_step_by_step(typed: Typed, answer: Answer) -> None:
    assert answer("program", "run", EXAMPLES / "wave.yaml") == DONE
    sent = Daemon.asked
    assert (sent["method"], sent["name"], sent["from_step"]) == ("program_run", "wave", None)
    text = json.dumps({"steps": sent["steps"]})
    assert program_from_text(text, "sent", "wave") == program_from_text(
        (EXAMPLES / "wave.yaml").read_text(), "f", "wave"
    )
    said = typed("program", "run", EXAMPLES / "wave.yaml", "--from", "hook@2")
    assert Daemon.asked["from_step"] == "hook@2"
    assert said.err.splitlines()[1:] == ["step 2.1@1: path, 2.0 s", "SLOWED: !"]
    assert "run-program-wave-1: 2 steps done" in said.out


@pytest.mark.usefixtures("daemon")
def test_a_program_that_did_not_come_to_its_end_says_where_it_stands(
    typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    ended = {"code": "STOPPED", "text": "stopped on request"}
    monkeypatch.setattr(Daemon, "answer", {**DONE, "ended": ended, "stands_at": "2.1@1"})
    said = typed("program", "run", EXAMPLES / "wave.yaml", status=1).out
    assert "ended at step 2.1@1: STOPPED: stopped on request" in said
    assert f"armctl program run {EXAMPLES / 'wave.yaml'}" in said


@pytest.mark.parametrize(("name", "arm"), [("wave", "ax12-line"), ("fetch", "xiang-6dof")])
def test_every_example_can_be_done_by_its_arm(
    name: str, arm: str, tmp_path: Path, answer: Answer, typed: Typed
) -> None:
    config = tmp_path / "armctl.yaml"
    config.write_text(f"arm: {arm}\n")
    found = answer("program", "check", EXAMPLES / f"{name}.yaml", "--config", config)
    assert [row for row in found["steps"] if not row["ok"]] == []
    assert found["resumed_at"] is None
    said = typed("program", "check", EXAMPLES / f"{name}.yaml", "--config", config).out
    assert f"no daemon: from the rest pose of {arm}" in said
    assert said.endswith("next: armctl program run FILE\n")
    assert len(said.splitlines()) == 2 + len(found["steps"])


def test_there_are_no_other_examples_of_programs() -> None:
    assert sorted(path.name for path in EXAMPLES.glob("*.yaml")) == ["fetch.yaml", "wave.yaml"]


def test_a_program_that_the_arm_cannot_do_is_told_step_by_step_and_fails(typed: Typed) -> None:
    said = typed("program", "check", EXAMPLES / "fetch.yaml", status=1).out
    assert not missing(said, "NO  1            arm ax12-line has no gripper", "`armctl arms` says which have one")
    assert "not checked, because a step before it cannot be done" in said


def test_what_is_no_program_names_the_step_and_leads_to_the_page(tmp_path: Path, typed: Typed) -> None:
    file = tmp_path / "bad.yaml"
    file.write_text("steps: [{wait_s: 1.0}, {wait_s: 5000.0}]")
    said = typed("program", "check", file, status=2).err
    assert f"{file}: step 2: wait_s: Input should be less than or equal to 3600" in said
    assert "`armctl help programs`" in said
    (tmp_path / "two words.yaml").write_text("steps: [{wait_s: 1.0}]")
    assert "name: String should match" in typed("program", "run", tmp_path / "two words.yaml", status=2).err


def test_what_does_not_fit_into_one_line_of_the_socket_is_refused_before_it_is_sent(
    tmp_path: Path, typed: Typed
) -> None:
    file = tmp_path / "long.yaml"
    points, kinds = ",".join(["[0.1,0.0,0.1],[0.1,0.1,0.1]"] * 425), ",".join(["line"] * 850)
    file.write_text("steps:\n" + f"- path: {{points_m: [{points}], kinds: [{kinds}]}}\n" * 4)
    assert "at most 65536; make two programs of it" in typed("program", "run", file, status=2).err.replace("\n", " ")


# ------------------------------------------------------------------------------------------------------- record


class Arm(StandIn):
    """An arm that a hand carries from place to place."""

    def __init__(self, *_: object, state: str = "off") -> None:
        self.state, self.calls = state, list[str]()
        self.angle: float | None = 0.0

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        self.calls.append(method)
        if method == "recordings_list":
            return {"recordings": [{"name": "tidy-1"}]}
        if method == "recordings_show":
            return {"name": params["name"], "duration_s": 1.0, "samples": 10, "mean_error_mm": None}
        joints = [{"position_rad": self.angle}, {"position_rad": 0.1234567}]
        return {"state": self.state, "joints": joints, "tool": {"position_m": [0.1, 0.0, 0.1]}}

    def subscribe(self) -> Iterator[dict[str, Any]]:
        limit = {"tool_speed_limit_m_s": 1.0, "period_s": 0.1, "state": "teaching"}
        tool = {"position_m": [0.1, 0.0, 0.1], "speed_m_s": 0.0}
        return iter({**limit, "tool": tool, "recording": "tidy-2" if tick else None} for tick in range(9))


class Keys(TerminalKeys):
    """Keys that are pressed in a take."""

    def __init__(self, keys: str) -> None:
        super().__init__(None)
        self._keys = iter(keys)

    def wait(self, timeout_s: float) -> str:
        return next(self._keys).strip(".")


Recording = Callable[..., tuple[Recorder, Arm]]


@pytest.fixture
def recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Recording:
    def make(state: str = "off", keys: str = "") -> tuple[Recorder, Arm]:
        arm = Arm(state=state)
        monkeypatch.setattr(client, "Client", lambda _socket: arm)
        return Recorder(Output(), cast("Client", arm), tmp_path / "tidy.yaml", Keys(keys)), arm

    return make


def written(tmp_path: Path) -> list[dict[str, Any]]:
    program = program_from_text((tmp_path / "tidy.yaml").read_text(), "tidy.yaml", "tidy")
    return [step.model_dump(mode="json", exclude_none=True) for step in program.steps]


def test_keys_make_a_program_that_is_in_its_file_after_each(recording: Recording, tmp_path: Path) -> None:
    recorder, arm = recording("holding")
    here = {"move": {"joints_rad": [0.0, 0.12346]}}
    steps = [here, {"grip": "close"}, {"wait_s": 1.0}, {"grip": "open"}]
    for count, key in enumerate("\ngwo", 1):
        recorder.press(key)
        assert written(tmp_path) == steps[:count]
    arm.angle = 0.5
    for key in ("u", "\r", "\n"):
        recorder.press(key)
    there = {"move": {"joints_rad": [0.5, 0.12346]}}
    assert written(tmp_path) == [*steps[:3], there, there]
    assert not {"teach_begin", "torque_on", "release"} & set(arm.calls)


def test_a_key_that_means_nothing_says_what_the_keys_mean(
    recording: Recording, capsys: pytest.CaptureFixture[str]
) -> None:
    recorder, arm = recording()
    recorder.press("x")
    assert capsys.readouterr().out == f"{HELP}\n"
    recorder.press("u")
    assert recorder.steps == []
    arm.angle = None
    recorder.press("\n")
    assert "not every servo has answered yet" in capsys.readouterr().out
    assert recorder.steps == []


def test_a_take_of_the_limp_arm_becomes_a_step_that_plays_it(recording: Recording, tmp_path: Path) -> None:
    recorder, arm = recording(keys="..\n")
    recorder.press("t")
    assert written(tmp_path) == [{"play": {"name": "tidy-2", "rate": 1.0, "repeat": 1}}]
    wanted = ["teach_begin", "take_begin", "take_end", "recordings_show", "teach_end"]
    assert [call for call in arm.calls if call in wanted] == wanted


def test_a_take_never_makes_an_arm_limp(recording: Recording, capsys: pytest.CaptureFixture[str]) -> None:
    recorder, arm = recording("holding")
    recorder.press("t")
    assert "a take needs a limp arm, and it is holding; `armctl release`, then t again" in capsys.readouterr().out
    assert (recorder.steps, "teach_begin" in arm.calls) == ([], False)


def test_where_nobody_can_press_a_key_a_place_is_taken_where_the_tool_rests(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, answer: Answer
) -> None:
    class Carried(Arm):
        """Carried 5 cm in half a second, and resting there for a second."""

        def subscribe(self) -> Iterator[dict[str, Any]]:
            same = {"tool_speed_limit_m_s": 1.0, "period_s": 0.1, "state": "holding"}
            for tick in range(15):
                yield {**same, "tool": {"position_m": [0.1, 0.01 * min(tick, 5), 0.1], "speed_m_s": 0.0}}

        def call(self, method: str, **params: Any) -> dict[str, Any]:
            if method == "program_check":
                return {"steps": ROWS, "resumed_at": None}
            return super().call(method, **params)

    monkeypatch.setattr(client, "Client", Carried)
    file = tmp_path / "tidy.yaml"
    assert answer("program", "record", file, "--places", "2") == {"path": str(file), "steps": ROWS, "resumed_at": None}
    assert written(tmp_path) == [{"move": {"joints_rad": [0.0, 0.12346]}}] * 2


def test_a_recording_that_exists_is_not_written_over(tmp_path: Path, typed: Typed) -> None:
    file = tmp_path / "tidy.yaml"
    file.write_text("steps: []")
    assert "exists; choose another name" in typed("program", "record", file, status=1).err
