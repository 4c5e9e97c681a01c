"""The whole set-up of simulated arms: broken off anywhere, typed, and what a person may do wrong."""

import io
import json
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import click
import numpy as np
import pytest

from armctl.cli import setup
from armctl.cli.output import Output
from armctl.commissioning import finding
from armctl.commissioning.finding import Person as Beside
from armctl.commissioning.wizard import Wizard, progress, progress_path
from armctl.errors import ConfigError
from armctl.files import load_arm
from proving.put_together import PERIOD_S, Arm, Person, assembled, opened_of, prepared
from proving.setting_up import wrong
from tests.cli.conftest import Answer, Typed
from tests.cli.conftest import answer as answer
from tests.cli.conftest import own_folders as own_folders
from tests.cli.conftest import typed as typed
from tests.host.doubles import refused
from tests.terminal import terminal

KIND = "lanzhou-4dof"


@pytest.fixture
def arm() -> Arm:
    return assembled(5, ("swapped", "reversed"), KIND)


@pytest.fixture
def answers(arm: Arm, tmp_path: Path) -> Path:
    file = tmp_path / "answers.yaml"
    file.write_text(json.dumps(prepared(arm)))
    return file


def steps(arm: Arm, path: Path, person: Beside) -> Iterator[dict[str, Any]]:
    found = progress(KIND, "mine", path)
    return Wizard(arm.kind, path, found, opened_of(arm), person, PERIOD_S).run()


class Leaving(Person):
    """Breaks off at every question once, and does what it asks for the next time."""

    def __init__(self, arm: Arm, file: Path) -> None:
        super().__init__(arm, file)
        self.left: set[str] = set()

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        if key not in self.left:
            self.left.add(key)
            raise KeyboardInterrupt
        return super().ask(key, text, choices)


def test_it_may_be_broken_off_at_every_question_and_goes_on_there(arm: Arm, answers: Path, tmp_path: Path) -> None:
    path, person, ended = tmp_path / "mine.yaml", Leaving(arm, answers), False
    before = -1
    while not ended:
        assert len(person.left) > before, "a question is left once"
        before = len(person.left)
        try:
            told = [step["name"] for step in steps(arm, path, person)]
            ended = True
        except KeyboardInterrupt:
            assert progress_path(path).exists()
            assert not any(servo.torque_enabled for servo in arm.simulated.servos)
    assert told == ["adapter", "servos", "joints", "directions", "rest", "zeros", "file", "motion"]
    assert wrong(arm, load_arm(str(path))) == []
    assert not progress_path(path).exists()
    assert not path.with_suffix(".history").exists()


def test_an_arms_own_file_is_renewed_and_what_it_was_stays(arm: Arm, answers: Path, tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("arm_id: mine\n")
    *_, file, _ = steps(arm, path, Person(arm, answers))
    assert file["text"].endswith(f"; before: {path.with_suffix('.history') / '1.yaml'}")
    assert (path.with_suffix(".history") / "1.yaml").read_text() == "arm_id: mine\n"


class Clumsy(Person):
    """Does one thing wrong the first time it is asked for."""

    wrongly = ""
    refused: list[str] = []  # noqa: RUF012

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        said = super().ask(key, text, choices)
        if key == self.wrongly:
            self.wrongly = ""
            posture, low = self._middle(), [joint.limits_rad[0] for joint in self.arm.kind.joints]
            if key.startswith("elbow"):  # from its end, and the shoulder with it
                posture[1:3] = posture[1] + 0.9, low[2] + 1.0
            elif key.startswith("wrist"):
                posture[3] = low[3]
            else:
                posture[2] += 1.5
            self._hold(posture)
        return said

    def again(self, refusal: object) -> bool:
        self.refused = [*self.refused, str(refusal)]
        return len(self.refused) < 3


@pytest.mark.parametrize(("wrongly", "says"), [
    ("elbow.the_other_end", "turned together"),
    ("wrist.the_other_end", "no servo turned by 30 deg"),
    ("middle", "elbow"),
])  # fmt: skip
def test_what_is_done_wrong_is_said_and_done_again(
    wrongly: str, says: str, arm: Arm, answers: Path, tmp_path: Path
) -> None:
    person, path = Clumsy(arm, answers), tmp_path / "mine.yaml"
    person.wrongly = wrongly
    list(steps(arm, path, person))
    [told] = person.refused
    assert says in told
    assert wrong(arm, load_arm(str(path))) == []


def test_a_joint_that_is_not_free_stays_limp_and_the_first_motion_may_be_left_out(
    arm: Arm, answers: Path, tmp_path: Path
) -> None:
    told = prepared(arm)
    answers.write_text(json.dumps(told | {"motion": "no"}))
    *_, last = steps(arm, tmp_path / "other.yaml", Person(arm, answers))
    assert last == {"name": "motion", "ok": True, "text": "left out"}
    answers.write_text(json.dumps(told | {"waist.free": "no"}))
    with refused("NOT_FREE", "waist stays limp"):
        list(steps(arm, tmp_path / "mine.yaml", Person(arm, answers)))
    assert np.all([not servo.torque_enabled for servo in arm.simulated.servos])


def test_progress_of_another_kind_of_arm_and_a_name_that_is_none_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    progress_path(path).write_text('{"kind": "ax12-line", "arm_id": "mine"}')
    with pytest.raises(ConfigError, match="kind: 'ax12-line', not 'lanzhou-4dof'; remove the file to begin anew"):
        progress(KIND, "mine", path)
    with pytest.raises(ConfigError, match="armctl setup: arm_id: String should match"):
        progress(KIND, "a/b", tmp_path / "other.yaml")


@pytest.mark.usefixtures("own_folders")
def test_typed_with_prepared_answers_it_makes_the_file_that_the_name_loads(
    arm: Arm, answers: Path, monkeypatch: pytest.MonkeyPatch, typed: Typed, answer: Answer
) -> None:
    monkeypatch.setattr(setup, "make_port", lambda path, baud: arm.virtual.port)
    monkeypatch.setattr(finding, "Prepared", lambda file: Person(arm, file))
    monkeypatch.setattr(sys, "stdin", io.StringIO())  # nobody is waited for
    answers.write_text(json.dumps(prepared(arm) | {"name": "mine"}))
    told = answer("setup", KIND, "--answers", answers, "--port", "x")
    assert told["arm"].endswith("armctl/calibration/mine.yaml")
    assert [step["ok"] for step in told["steps"]] == [True] * 8
    assert wrong(arm, load_arm("mine")) == []
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n" * 100))
    said = typed("setup", "mine", "--answers", answers, "--port", "x").out
    assert "lay the arm down" in said
    assert "\nmotion [yes], Enter:\n" in said
    assert "armctl calibrate --points sheet.csv --arm mine --port x" in said


@pytest.mark.parametrize(("typed_in", "word"), [("", "yes"), ("\n", "yes"), ("no\n", "no"), ("maybe\ny\n", "yes")])
def test_enter_takes_an_answer_that_is_prepared_and_another_one_may_be_typed(
    typed_in: str, word: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "answers.yaml"
    file.write_text("motion: yes")
    monkeypatch.setattr(sys, "stdin", io.StringIO(typed_in))
    assert setup.AtTerminal(Output(), "armctl setup", "", file).ask("motion", "free?", ("yes", "no")) == word


def test_a_choice_that_is_not_prepared_is_asked_for_until_it_is_typed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "answers.yaml"
    file.write_text("name: mine")
    person = setup.AtTerminal(Output(), "armctl setup", "", file)
    monkeypatch.setattr(sys, "stdin", io.StringIO("\n\nno\n"))
    assert person.ask("motion", "free?", ("yes", "no")) == "no"
    with pytest.raises(ConfigError, match="motion: '' does not answer"):
        person.ask("motion", "free?", ("yes", "no"))  # nobody is left to be asked
    monkeypatch.setattr(sys, "stdin", io.StringIO("q\n"))
    with pytest.raises(click.Abort):
        person.ask("name", "what is it called?")


# ------------------------------------------------------------------------------------------ at a real terminal

LIKE = """
arm_id: small
robot: {convention: standard, dh: [{d_m: 0.06, alpha_deg: 90}, {a_m: 0.1}]}
floor_m: -0.2
joints:
  - {name: pan, servo_id: 1, limits_deg: [-100, 100]}
  - {name: lift, servo_id: 2, limits_deg: [-80, 90], rest_deg: -60}
"""
# As it truly is: each has the other's id, and the servo of the lift is mounted the other way round.
TRULY = LIKE.replace("pan, servo_id: 1", "pan, servo_id: 2").replace(
    "lift, servo_id: 2", "lift, servo_id: 1, direction: -1, zero_tick: 540"
)
# What is asked, what the hand then does, and what is typed: until the person breaks off, and from there on.
BEFORE = [
    ("turn pan to one end", "lead -102.5 0", ""),
    ("turn pan to the other end", "lead 102.5 0", ""),
    ("turn lift to one end", "lead 0 0", "q"),
]
AFTER = [
    ("turn lift to one end", "lead 0 -82.5", ""),
    ("turn lift to the other end", "lead 0 92.5", ""),
    ("hold every joint about in the middle", "lead 0 5", ""),
    ("pan turns by 9 deg and back", "free 0", "yes"),
    ("did the tool go left", "lead 0 5", "yes"),
    ("lift turns by 9 deg and back", "free 1", "y"),
    ("did the tool go up", "lead 0 5", "no"),
    ("lay the arm down", "lead 0 -60", ""),
    ("pan 0 deg, lift 0 deg", "lead 0 0", ""),
    ("Then the arm gets torque", "release", "yes"),
]


@pytest.mark.pty
@pytest.mark.usefixtures("own_folders")
def test_at_a_terminal_a_person_is_led_through_it_and_may_leave_and_come_back(tmp_path: Path) -> None:
    truly, like, link = (tmp_path / name for name in ("truly.yaml", "like.yaml", "port"))
    truly.write_text(TRULY)
    like.write_text(LIKE)
    command = (sys.executable, "-m", "armctl", "setup", str(like), "--port", str(link))
    held = (sys.executable, "-m", "tests.commissioning.held_arm", str(link), str(truly))
    here = {**os.environ, "PYTHONPATH": os.pathsep.join(sys.path)}
    with subprocess.Popen(held, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=here) as world:
        assert world.stdin is not None
        assert world.stdout is not None
        try:
            assert world.stdout.readline().strip() == str(link)
            for script, status in ((BEFORE, 130), (AFTER, 0)):
                with terminal(*command) as person:
                    at = 0
                    for words, order, typed_in in script:
                        at = person.until(words, at)
                        print(order, file=world.stdin, flush=True)
                        assert world.stdout.readline() == "there\n"
                        person.press(f"{typed_in}\n".encode())
                    assert person.status() == status, person.said
                    said = person.said
        finally:
            world.terminate()
    assert "joints: pan: servo 2, lift: servo 1" in said
    assert "motion: every joint moved, and the arm is back at rest" in said
    assert "armctl daemon --arm" in said
    found, true = load_arm(str(like)), load_arm(str(truly))
    for joint, its in zip(found.joints, true.joints, strict=True):
        assert (joint.servo_id, joint.direction) == (its.servo_id, its.direction)
        assert joint.zero_tick == pytest.approx(its.zero_tick, abs=6.0)
        assert joint.limits_deg == pytest.approx(its.limits_deg, abs=3.0)
    assert (like.with_suffix(".history") / "1.yaml").read_text() == LIKE
