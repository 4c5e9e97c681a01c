"""The commands that set an arm up, on a simulated arm in virtual time and once on the real pseudo terminal."""

import io
import json
import os
import pty
import re
import shlex
import shutil
import sys
import termios
import zipfile
from collections.abc import Callable, Iterator, Sequence
from contextlib import nullcontext
from itertools import count
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest

from armctl import client
from armctl.cli import calibrate, main, setup
from armctl.cli.keys import keys
from armctl.cli.output import Output
from armctl.commissioning import calibration, installation
from armctl.commissioning.calibration import Touch, calibration_text, load_readings, readings_text
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import NoDaemon, PortGone, RequestRefused
from armctl.files import find_arm_file, load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.lab.demo import started
from tests.cli.conftest import Answer, StandIn, Typed, refusals
from tests.commissioning.bench import EXACT, Bench, PosingHand, planted, postures, touch_points
from tests.paired import paired_arm
from tests.words import missing

pytestmark = pytest.mark.usefixtures("own_folders")


@pytest.fixture
def bench(monkeypatch: pytest.MonkeyPatch) -> Bench:
    return plugged(Bench(), monkeypatch)


def plugged(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> Bench:
    """The commands' port is this arm's."""
    bench.bus.close()

    def port(path: str, baud: int) -> object:
        bench.port.setBaudRate(baud)
        return bench.port

    monkeypatch.setattr(setup, "make_port", port)
    return bench


# ------------------------------------------------------------------------------------------------- scan and doctor


def test_scan_lists_the_servos(bench: Bench, answer: Answer) -> None:
    servos = answer("scan", "--port", "x")["servos"]
    assert servos[0] == {
        "id": 1, "baud": 1_000_000, "model": 12, "firmware": 24, "round_trip_us": 620, "clash": False,
    }  # fmt: skip
    assert [servo["id"] for servo in servos] == [1, 2, 3, 4, 5, 6]
    assert not bench.port.is_open


def test_scan_says_what_it_found_and_what_to_do_when_nothing_is(bench: Bench, typed: Typed) -> None:
    bench.servos[3].set(ax12a.ID, 3)
    bench.servos[5].set(ax12a.RETURN_LEVEL, 0)
    said = typed("scan", "--port", "x", "--baud", "1000000").out
    assert not missing(said, "two servos have this id", "answers no READ")
    assert "try --baud all" in typed("scan", "--port", "x", "--baud", "9600", status=1).out


def test_scan_of_all_bauds_finds_a_stray(bench: Bench, answer: Answer) -> None:
    bench.servos[1].set(ax12a.BAUD, 34)
    servos = answer("scan", "--port", "x", "--baud", "all")["servos"]
    assert {(servo["id"], servo["baud"]) for servo in servos} >= {(1, 1_000_000), (2, 57_600)}


TROUBLES = {"adapter_latency", "present", "wrong_id", "return_delay"}


def fixes(result: dict[str, Any]) -> dict[str, str]:
    """Failed checks of the doctor -> remedy."""
    return {check["name"]: check["fix"] for check in result["checks"] if not check["ok"]}


def test_doctor_names_every_trouble_with_its_fix(monkeypatch: pytest.MonkeyPatch, typed: Typed, answer: Answer) -> None:
    plugged(Bench(latency_ms=16.0), monkeypatch).servos[3].set(ax12a.ID, 9)
    result = answer("doctor", "--port", "x", status=1)
    assert fixes(result).keys() == TROUBLES
    assert all(fixes(result).values())
    assert set(result["checks"][0]) >= {"name", "ok", "value", "fix"}
    said = typed("doctor", "--port", "x", status=1).out
    assert not missing(said, "-> armctl servo set-id 9 4 --port x", "500 us (register 250)  (servo 1)")


def test_doctor_is_content_with_a_fit_arm(bench: Bench, typed: Typed) -> None:
    typed("servo", "set-return-delay", "all", "0", "--port", "x")
    assert "FAIL" not in typed("doctor", "--port", "x").out


def test_doctor_leaves_a_busy_port_alone(tmp_path: Path, answer: Answer) -> None:
    assert list(fixes(answer("doctor", "--port", tmp_path / "none", status=1))) == ["port"]


# ----------------------------------------------------------------------------------------------------------- servo


def test_servo_commands_write_and_say_so(bench: Bench, answer: Answer, typed: Typed) -> None:
    def servo(line: str, ask: Callable[..., Any] = typed) -> Any:
        return ask("servo", *line.split(), "--port", "x")

    assert servo("set-id 4 9", answer) == {"id": 9, "before": 4}
    servo("set 9 shutdown 37", answer)
    assert servo("set-baud 9 57600", answer)["real_baud"] == 57_142
    assert "The daemon talks at 1000000" in servo("set-baud 9 115200 --baud 57600").out
    servo("set-baud 9 1000000 --baud 115200")
    assert "servo 9 is now servo 4" in servo("set-id 9 4").out
    servo("set 4 shutdown 36")
    assert servo("set-return-delay 4 101", answer)["return_delay_us"] == 100
    assert [bench.servos[3].get(register) for register in (ax12a.ID, ax12a.RETURN_DELAY)] == [4, 50]
    assert not any(servo.torque_enabled for servo in bench.servos)


def test_servos_of_the_factory_are_mended_by_one_command(bench: Bench, answer: Answer, typed: Typed) -> None:
    bench.servos[1].set(ax12a.CCW_LIMIT, 1023)
    bench.servos[4].set(ax12a.SHUTDOWN, 0)
    mended = {"servo_id": 5, "register": "shutdown", "wanted": 36, "found": 0}
    assert answer("servo", "mend", "5", "--port", "x") == {"mended": [mended]}
    assert "ccw_angle_limit" in typed("servo", "mend", "all", "--port", "x").out
    assert "nothing to mend" in typed("servo", "mend", "all", "--port", "x").out
    assert "not of the arm" in typed("servo", "mend", "9", "--port", "x", status=2).err


@pytest.mark.parametrize(("status", "line", "text"), refusals("at the bench"))
def test_what_is_refused_is_said_and_nothing_is_written(
    bench: Bench, status: int, line: str, text: str, typed: Typed
) -> None:
    before = [servo.writes for servo in bench.servos]
    assert text in typed(*line.split(), "--port", "x", status=status).err
    assert [servo.writes for servo in bench.servos] == before
    assert not bench.port.is_open


def test_without_a_port_the_remedy_is_named(typed: Typed) -> None:
    assert typed("scan", status=2).err.startswith("armctl scan: --port: no serial port named; give --port PATH")


def test_eeprom_is_saved_compared_and_restored(bench: Bench, tmp_path: Path, answer: Answer, typed: Typed) -> None:
    def eeprom(act: str, *more: str, ask: Callable[..., Any] = typed, **expected: int) -> Any:
        return ask("servo", "eeprom", act, tmp_path / "e.yaml", *more, "--port", "x", **expected)

    assert len(eeprom("save", ask=answer)["servos"]) == 6
    assert "not overwritten" in eeprom("save", status=1).err
    assert "no difference" in eeprom("diff").out
    bench.servos[2].set(ax12a.SHUTDOWN, 4)
    difference = {"servo_id": 3, "register": "shutdown", "wanted": 36, "found": 4}
    assert eeprom("diff", ask=answer, status=1) == {"differences": [difference]}
    bench.servos[4].set(ax12a.ID, 50)
    assert "not readable" in eeprom("diff", status=1).out
    bench.servos[4].set(ax12a.ID, 5)
    assert "1 registers restored" in eeprom("restore", "--servo", "3").out
    assert eeprom("restore", ask=answer) == {"restored": []}
    typed("servo", "eeprom", "save", tmp_path / "f.json", "--port", "x")


# ------------------------------------------------------------------------------------------------------- calibrate


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    return Path(shutil.copy(find_arm_file("ax12-line"), tmp_path / "my-arm.yaml"))


def zeros(arm: ArmConfig) -> list[float]:
    return [joint.zero_tick for joint in arm.joints]


def calibrated(arm_file: Path, touches: Sequence[Touch]) -> tuple[object, ...]:
    """The command that calibrates an arm from these touches."""
    readings = arm_file.with_name("r.yaml")
    readings.write_text(readings_text(load_arm(str(arm_file)).arm_id, touches))
    return "calibrate", "--readings", readings, "--arm"


def test_calibrate_renews_the_arms_own_file_and_keeps_the_ones_before(
    arm_file: Path, answer: Answer, typed: Typed
) -> None:
    rng = np.random.default_rng(0)
    true = planted(load_arm("ax12-line"), rng, tick=20.0, length_m=0.003)
    old = arm_file.read_text()
    command = calibrated(arm_file, touch_points(Bench(spec=EXACT, simulated=true), 16, rng))
    result = answer(*command, arm_file)
    assert result["path"] == str(arm_file)
    found_arm = load_arm(str(arm_file))
    assert zeros(found_arm)[:5] == pytest.approx(zeros(true)[:5], abs=1.0)
    assert found_arm.lengths_m == pytest.approx(true.lengths_m, abs=0.0005)
    assert {change["key"] for change in result["changes"]} >= {"base.zero_tick", "lengths_m.d1"}
    assert len(result["residuals_mm"]) == 16
    assert result["rms_mm"] < 1.0
    second, history = arm_file.read_text(), arm_file.with_name("my-arm.history")
    again = typed(*command, arm_file).out
    assert not missing(again, f"(before: {history / '2.yaml'})", "roll.zero_tick", "does not move the tool")
    assert [(history / name).read_text() for name in ("1.yaml", "2.yaml")] == [old, second]
    assert "not overwritten" in typed(*command, arm_file, "--out", arm_file, status=1).err


def test_calibrate_holding_tells_every_parameter_and_makes_the_arm_a_table(
    arm_file: Path, answer: Answer, typed: Typed
) -> None:
    rng = np.random.default_rng(0)
    true = planted(load_arm("ax12-line"), rng, tick=10.0, length_m=0.002)
    q = postures(true, 20, rng)
    points = tool_position(robots.of(true).chain, q[:, :5])
    ticks = [[joint.tick(at) for joint, at in zip(true.joints, row, strict=True)] for row in q.tolist()]
    touches = [Touch(point_m=tuple(p), ticks=tuple(t)) for p, t in zip(points.tolist(), ticks, strict=True)]
    command = calibrated(arm_file, touches)
    result = answer(*command, arm_file, "--holding")
    assert result["parameters"][0].keys() == {"name", "value", "sd", "unit"}
    assert {one["unit"] for one in result["parameters"]} == {"tick", "m", "deg", "deg/m"}
    assert result["after_mm"] < result["held_out_mm"] < 0.5 < 2.0 < result["before_mm"]
    found = load_arm(str(arm_file))
    assert zeros(found)[5] == 512.0, "of a servo that moves no tool"
    seen = [[joint.position_rad(tick) for joint, tick in zip(found.joints, row, strict=True)] for row in ticks]
    np.testing.assert_allclose(tool_position(robots.of(found).chain, np.array(seen)[:, :5]), points, atol=5e-4)
    again = typed(*calibrated(arm_file, touches), arm_file, "--holding")
    assert not missing(
        again.out, "base.zero_tick", "robot.dh.1.alpha_deg", "mm on points left out", "my-arm.history/2.yaml"
    )


class Standing(StandIn):
    """A daemon's arm that goes where it is moved, unless that is refused, and where a hand presses its tip."""

    arm: ArmConfig
    q_rad: list[float]
    # What it was asked to do; the codes of the refusals of its next moves, empty: it goes; what is told of its torque.
    moves: list[dict[str, Any]]
    refusals: list[str]
    limp: bool
    told_hash: str

    def call(self, method: str, **params: Any) -> dict[str, Any]:
        if method == "status":
            joints = [{"wanted_rad": None if k == 5 else q, "position_rad": q} for k, q in enumerate(self.q_rad)]
            return {"arm_id": self.arm.arm_id, "calibration_hash": self.told_hash, "joints": joints}
        assert method == "move"
        Standing.moves.append(params)
        if Standing.refusals and (code := Standing.refusals.pop(0)):
            raise RequestRefused(code, f"not there ({code})")
        Standing.q_rad = [*params["joints_rad"]] if "joints_rad" in params else self.q_rad
        return {}

    def subscribe(self) -> Iterator[dict[str, Any]]:
        while True:
            yield {"joints": [{"torque_enabled": not self.limp, "position_rad": q} for q in self.q_rad]}

    @classmethod
    def lead(cls, to_m: FloatArray) -> None:
        """Press the tip onto a point."""
        chain, steps = robots.of(cls.arm).chain, 1e-6 * np.eye(5)
        for _ in range(20):
            q = np.array(cls.q_rad[:5])
            J = np.array([tool_position(chain, q + step) - tool_position(chain, q - step) for step in steps]).T / 2e-6
            q = q + J.T @ np.linalg.solve(J @ J.T + 1e-5 * np.eye(3), to_m - tool_position(chain, q))
            cls.q_rad = [*q.tolist(), *cls.q_rad[5:]]


@pytest.fixture
def standing(arm_file: Path, monkeypatch: pytest.MonkeyPatch) -> type[Standing]:
    """The daemon that commands find; a person sits at the terminal, whose keys `by_keys` of a test presses."""
    arm = load_arm(str(arm_file))
    start: dict[str, Any] = {"moves": [], "refusals": [], "limp": False, "told_hash": arm.calibration_hash, "arm": arm}
    for name, value in (start | {"q_rad": [0.0] * 5 + [0.25]}).items():
        monkeypatch.setattr(Standing, name, value, raising=False)
    monkeypatch.setattr(client, "Client", Standing)
    monkeypatch.setattr(calibrate, "keys", lambda _: nullcontext(Mock()))
    monkeypatch.setattr(sys, "stdin", person(lambda: "\n"))
    return Standing


SHEET = "0.235,0,0\n0.2,0,0\n0.9,0,0\n0.2,0.1,0\n0.2,-0.1,0.05\n"


def asked_for(said: str) -> list[str]:
    """Numbers of points, as the arm was moved above them."""
    return re.findall(r"point (\d) of 5 .*, posture \d of \d: moving above it", said.replace("\n", " ").replace(
        "point", "\npoint"))  # fmt: skip


def test_calibrate_holding_moves_above_each_point_and_is_led_onto_it(
    arm_file: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch, standing: type[Standing]
) -> None:
    led, pressed = list[str](), iter("qq" + "s" + "b" + "Qq" + "q" * 9)

    def by_keys(_output: object, _call: object, _speed: float, said: str, ends: str) -> str:
        assert not missing(said, "q: take it", "s: skip this point", "b: take the last touch back")
        led.append(key := next(pressed))
        standing.limp = len(led) == 2
        if key == "q":
            tip = tool_position(robots.of(standing.arm).chain, np.array(standing.q_rad[:5]))
            standing.lead(tip - (0.0, 0.0, 0.03))
        assert key.lower() in ends
        return key.lower()

    monkeypatch.setattr(calibrate, "by_keys", by_keys)
    standing.refusals = ["PREFLIGHT"]
    (points := arm_file.with_name("points.csv")).write_text(SHEET)
    saved = arm_file.with_name("kept.yaml")
    words = ("calibrate", "--arm", arm_file, "--points", points, "--holding", "--save-readings", saved)
    standing.told_hash = "of another calibration"
    assert not missing(
        typed(*words, status=2).err, "the daemon drives arm", "of another calibration", "restart the daemon"
    )
    assert not standing.moves
    standing.told_hash = standing.arm.calibration_hash
    said = typed(*words, status=1)
    assert not missing(
        said.out, "not moved above it: not there", "press q", "not taken: torque is off",
        "left out: point 3 (900.0, 0.0, 0.0 mm)",
    )  # fmt: skip
    assert "not taken: the tip is 30 mm from point" in said.out.replace("\n", " ")
    above = [move["joints_rad"] for move in standing.moves]
    stands = tool_position(robots.of(standing.arm).chain, np.array(above)[:2, :5])
    assert above[0] != above[1], "where one posture cannot be gone to, another one"
    np.testing.assert_allclose(stands[0], stands[1], atol=1e-5)
    assert {q[5] for q in above} == {0.25}, "what moves no tip stays"
    # The second touch was not taken, as the arm was limp; its point was skipped. Then the first one was taken back,
    # above whose point the tip was again, and made at the second go: before, the tip was where it had been moved to.
    order = asked_for(said.out)
    assert order[1] == order[2]
    assert order[3] == order[0] != order[2]
    assert order[2] not in order[3:], "what was skipped comes no more"
    assert "".join(led).startswith("qqsbQq")
    assert len(order) == len(led) - 2 == len(standing.moves) - 1
    kept = load_readings(saved, standing.arm)
    assert (0.9, 0.0, 0.0) not in [touch.point_m for touch in kept]
    for touch in kept:
        q = [joint.position_rad(tick) for joint, tick in zip(standing.arm.joints, touch.ticks, strict=True)]
        tip = tool_position(robots.of(standing.arm).chain, np.array(q[:5]))
        np.testing.assert_allclose(tip, touch.point_m, atol=1e-4)
    assert "armctl status" not in said.err
    wrong = typed("calibrate", "--arm", arm_file, "--zero-at", "rest", "--holding", status=2)
    assert "either with --holding" in wrong.err


def test_where_no_posture_of_a_point_can_be_gone_to_the_tip_is_moved_there_in_any(
    arm_file: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch, standing: type[Standing]
) -> None:
    def by_keys(*_: object) -> str:
        raise KeyboardInterrupt

    monkeypatch.setattr(calibrate, "by_keys", by_keys)
    (points := arm_file.with_name("points.csv")).write_text(SHEET)
    command = ("calibrate", "--arm", arm_file, "--points", points, "--holding")
    standing.refusals = ["PREFLIGHT", "LIMIT", "PREFLIGHT", "PREFLIGHT", "PREFLIGHT"]
    typed(*command, status=130)
    *ways, last = standing.moves
    assert len({tuple(way["joints_rad"]) for way in ways}) == len(ways) >= 2
    tip = tool_position(robots.of(standing.arm).chain, np.array(ways[0]["joints_rad"][:5]))
    np.testing.assert_allclose(last["point_m"], tip, atol=1e-5)
    standing.moves, standing.refusals = [], ["STOPPED"]
    assert "not moved above it: not there (STOPPED)" in typed(*command, status=130).out
    assert len(standing.moves) == 1, "somebody stopped it: nothing moves but by keys"


def test_keys_that_are_pressed_while_the_arm_moves_are_neither_shown_nor_used(
    arm_file: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch, standing: type[Standing]
) -> None:
    person_fd, terminal_fd = pty.openpty()
    shown, looks = list[int](), count(1)

    class Pressed(standing):  # type: ignore[misc, valid-type]
        def call(self, method: str, **params: Any) -> dict[str, Any]:
            if method == "move":
                os.write(person_fd, b"ss\n")
                shown.append(termios.tcgetattr(terminal_fd)[3] & (termios.ECHO | termios.ICANON))
            found: dict[str, Any] = super().call(method, **params)
            return found

    def look(*_: object) -> None:
        if next(looks) == 3:
            raise KeyboardInterrupt
        os.write(person_fd, b"q")

    (points := arm_file.with_name("points.csv")).write_text(SHEET)
    with os.fdopen(terminal_fd) as terminal:
        before = termios.tcgetattr(terminal)
        monkeypatch.setattr(sys, "stdin", terminal)
        monkeypatch.setattr(client, "Client", Pressed)
        monkeypatch.setattr(calibrate, "keys", keys)
        monkeypatch.setattr(Output, "live", look)
        said = typed("calibrate", "--arm", arm_file, "--points", points, "--holding", status=130).out.replace("\n", " ")
        assert termios.tcgetattr(terminal) == before
    os.close(person_fd)
    assert shown == [0]
    assert said.count("moving above it") == 1
    assert said.count("not taken: the tip is 30 mm from point") == 2


def test_a_session_whose_daemon_dies_goes_on_with_the_command_that_the_error_names(
    arm_file: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch, standing: type[Standing]
) -> None:
    turns = count(1)

    def by_keys(*_: object) -> str:
        if next(turns) == 3:
            raise NoDaemon("no daemon answers on x.sock: it closed the connection; start it with `armctl daemon`")
        tip = tool_position(robots.of(standing.arm).chain, np.array(standing.q_rad[:5]))
        standing.lead(tip - (0.0, 0.0, 0.03))
        return "q"

    monkeypatch.setattr(calibrate, "by_keys", by_keys)
    (points := arm_file.with_name("my points.csv")).write_text(SHEET)
    died = typed("calibrate", "--arm", arm_file, "--points", points, "--holding", status=3)
    (kept,) = arm_file.parent.glob("my-arm-*.readings")
    [again] = re.findall(r"touches in .*: 2; `armctl (.*)` goes on", died.err.replace("\n", " "))
    words = shlex.split(again)
    assert words == ["calibrate", "--arm", str(arm_file), "--points", str(points), "--holding", "--readings", str(kept)]
    before = load_readings(kept, standing.arm)
    said = typed(*words, status=1)
    assert f"readings are kept in {kept}" in said.out.replace("\n", "")
    after = load_readings(kept, standing.arm)
    assert after[:2] == before
    assert len(after) == 6 + 1 == 2 + len(asked_for(said.out)), "two of each point but the one with one posture"


def test_readings_go_on_only_with_the_sheet_and_the_arm_that_they_are_of(
    arm_file: Path, typed: Typed, standing: type[Standing]
) -> None:
    (points := arm_file.with_name("points.csv")).write_text(SHEET)
    touch = Touch(point_m=(0.21, 0.0, 0.0), ticks=(512.0,) * 6)
    for arm_id, status, words in (
        (
            standing.arm.arm_id,
            1,
            "touch 1 of the readings is at 0.2100, 0.0000, 0.0000 m, where the sheet has no point",
        ),
        ("mine", 2, "readings of 'mine'"),
    ):
        (begun := arm_file.with_name("begun")).write_text(readings_text(arm_id, [touch]))
        old = begun.read_text()
        for holding in ([], ["--holding", "--port", "x"]):
            command = ("calibrate", "--arm", arm_file, "--points", points, "--readings", begun, *holding)
            assert words in typed(*command, status=status).err.replace("\n", " ")
        assert begun.read_text() == old
    assert not standing.moves


def test_a_limp_touch_is_skipped_or_taken_back_by_a_word(
    monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed
) -> None:
    bench = plugged(Bench(spec=EXACT), monkeypatch)
    (points := arm_file.with_name("points.csv")).write_text("0.1,0,0\n0.2,0,0\n0.1,0.1,0\n0.2,0.1,0\n")
    monkeypatch.setattr(calibration, "read_ticks", lambda *_: tuple(joint.zero_tick for joint in bench.config.joints))
    words = iter(["\n", "s\n", "b\n", *["\n"] * 8])
    monkeypatch.setattr(sys, "stdin", person(lambda: next(words)))
    said = typed("calibrate", "--arm", arm_file, "--port", "x", "--points", points, status=1).out
    order = re.findall(r"point (\d) of 4 .*, posture (\d) of 2", said.replace("\n", " ").replace("point", "\npoint"))
    assert ["".join(one) for one in order] == ["11", "12", "21", "11", "12", "21", "22", "31", "32", "41", "42"][
        : len(order)
    ]
    assert not missing(said, "s: skip this point; b: take the last touch back")


def test_a_sheet_of_points_is_drawn_for_an_arm_and_has_its_points_beside_it(
    arm_file: Path, answer: Answer, typed: Typed
) -> None:
    sheet = arm_file.with_name("sheet.svg")
    told = answer("calibrate", "--sheet", sheet, "--arm", arm_file)
    assert told == {"sheet": str(sheet), "paper": "A4", "points": str(sheet.with_suffix(".csv"))}
    points = calibration.read_points(sheet.with_suffix(".csv"))
    assert len(points) >= 8
    assert {z for *_, z in points} == {0.0, 0.06}
    again = typed("calibrate", "--sheet", sheet, "--arm", arm_file, status=1).err
    assert "not overwritten" in again
    assert "warning" not in again, "armctl's own points"
    assert "next: armctl status" not in again
    sheet.with_suffix(".csv").unlink()
    (own := arm_file.with_name("own.csv")).write_text("x,y,z\n0.2,0,0\n0.03,0,0\n0,0,0\n0.2,0.1,0.05\n0.2,0,-0.05\n")
    drawn = typed("calibrate", "--sheet", sheet, "--points", own, "--arm", arm_file)
    assert not missing(drawn.out, "5 points on A4", "100 %")
    said = drawn.err.replace("\n", " ")
    assert [*map(int, re.findall(r"warning: point (\d) .*?: the arm cannot stand 30 mm above it", said))] == [2, 3, 5]
    assert not missing(said, "below the table", "warning: 5 points are few; touch 8 or more")
    assert "ends in .svg" in typed("calibrate", "--sheet", arm_file.with_name("x.csv"), status=2).err
    assert "--sheet draws a sheet" in typed("calibrate", "--sheet", sheet, "--sag", status=2).err
    own.write_text("0.1,0,0\n0.2,0,0\n")
    thin = ("calibrate", "--sheet", sheet, "--points", own)
    assert "too few touches: 4, at least 5 are needed; give points that the arm reaches" in typed(*thin, status=1).err
    assert "too few different points: 2" in typed(*thin, "--touches", "3", status=1).err


def test_a_calibration_is_taken_back_and_brought_back(arm_file: Path, answer: Answer, typed: Typed) -> None:
    assert not missing(typed("calibrate", "--arm", arm_file, "--undo", status=2).err, "has no history", "take back")
    for more in (["--sag"], ["--holding"], ["--out", arm_file.with_name("new.yaml")]):
        assert typed("calibrate", "--arm", arm_file, "--undo", *more, status=2).err
    old = arm_file.read_text()
    answer(*calibrated(arm_file, touch_points(Bench(spec=EXACT), 16, np.random.default_rng(0))), arm_file)
    new = arm_file.read_text()
    told = answer("calibrate", "--arm", arm_file, "--undo")
    assert arm_file.read_text() == old != new
    assert told["path"] == str(arm_file)
    assert told["changes"]
    assert told["in_force"] == str(arm_file.with_name("my-arm.history") / "1.yaml")
    said = typed("calibrate", "--arm", arm_file, "--undo").out.replace("\n", " ")
    assert not missing(said, "written: ", "my-arm.history/3.yaml", "my-arm.history/2.yaml holds; --undo again brings")
    assert arm_file.read_text() == new


@pytest.mark.parametrize("where", ["history", "shipped"])
def test_an_arm_of_a_urdf_is_taken_back(
    where: str, tmp_path: Path, typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    shipped, old = find_arm_file("crane-plus-v2"), load_arm("crane-plus-v2")
    (own := tmp_path / "armctl" / "calibration" / shipped.name).parent.mkdir(parents=True)
    joints = (old.joints[0].model_copy(update={"zero_tick": 500.0}), *old.joints[1:])
    own.write_text(calibration_text(old.model_copy(update={"joints": joints}), []))
    if where == "history":
        shutil.copy(shipped.with_suffix(".urdf"), own.parent)
        (kept := own.with_suffix(".history") / "1.yaml").parent.mkdir()
        shutil.copy(shipped, kept)
    said = typed("calibrate", "--arm", "crane-plus-v2", "--undo").out
    assert not missing(said, "waist.zero_tick", f"written: {own}")
    assert load_arm(str(own)).model_dump() == old.model_dump()
    assert (own.read_text() == shipped.read_text()) == (where == "history")


def test_a_history_that_cannot_be_taken_back_is_named_itself_and_the_arm_stays(arm_file: Path, typed: Typed) -> None:
    whole = arm_file.read_text()
    (kept := arm_file.with_name("my-arm.history") / "1.yaml").parent.mkdir()
    unknown = whole.replace("zero_tick", "zero_tack", 1)
    far = whole.replace("zero_tick: 512", "zero_tick: 5120", 1)
    remedy = "mend it, or remove it to go back farther"
    for text, place in (
        (f"{whole}\nmore: [", f"line {whole.count(chr(10)) + 2}, column"),
        (unknown, "joints.0.zero_tack: unknown key"),
        (far, "joints.0.zero_tick: "),
        ("\xff", "the calibration is not UTF-8 text"),
    ):
        kept.write_text(text, encoding="latin-1")
        said = typed("calibrate", "--arm", arm_file, "--undo", status=2).err.replace("\n", " ")
        assert not missing(said, f"{kept}: ", place, remedy)
    assert arm_file.read_text() == whole
    assert [*kept.parent.iterdir()] == [kept]


def test_where_the_arms_folder_cannot_be_written_the_file_stays(arm_file: Path, typed: Typed) -> None:
    old = arm_file.read_text()
    arm_file.with_name("my-arm.history").write_text("in the way")
    command = calibrated(arm_file, touch_points(Bench(spec=EXACT), 16, np.random.default_rng(0)))
    assert "my-arm.history/1.yaml: cannot be written" in typed(*command, arm_file, status=2).err
    assert arm_file.read_text() == old


def test_an_arm_that_comes_with_armctl_is_calibrated_into_a_file_of_ones_own(
    arm_file: Path, answer: Answer, typed: Typed
) -> None:
    shipped = find_arm_file("ax12-line")
    before = shipped.read_text()
    command = calibrated(arm_file, touch_points(Bench(spec=EXACT), 16, np.random.default_rng(0)))
    written = answer(*command, "ax12-line")["path"]
    assert Path(written) == find_arm_file("ax12-line") != shipped
    assert shipped.read_text() == before
    assert "daemon --arm ax12-line" in typed(*command, "ax12-line").out


def test_calibrate_says_when_the_postures_were_too_much_alike(arm_file: Path, typed: Typed) -> None:
    said = typed(*calibrated(arm_file, touch_points(Bench(spec=EXACT), 3, np.random.default_rng(0)) * 4), arm_file)
    assert not missing(said.out, "left alone", "touch every point in more postures")


def person(readline: Callable[[], str]) -> Mock:
    """Someone at a terminal who presses Enter, or leaves."""
    return Mock(isatty=lambda: True, fileno=lambda: -1, readline=Mock(side_effect=readline))


def test_calibrate_leads_a_person_through_points(monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed) -> None:
    rng = np.random.default_rng(1)
    bench = plugged(Bench(spec=EXACT), monkeypatch)
    hand = bench.arm.hand = PosingHand(bench.arm)
    places = postures(bench.config, 12, rng)
    turns = count()
    points, saved = arm_file.with_name("points.csv"), arm_file.with_name("kept.yaml")
    points.write_text("\n".join(",".join(map(str, p)) for p in bench.arm.tool_positions(places).tolist()))

    def posing() -> str:
        asked = next(turns)
        hand.carry(places[max(0, asked - 1)])
        bench.clock.advance_ns(100_000_000 if asked == 0 else 3_000_000_000)  # too early the first time
        bench.arm.advance(bench.clock.now_ns())
        return "\n"

    monkeypatch.setattr(sys, "stdin", person(posing))
    command = ("calibrate", "--arm", arm_file, "--port", "x", "--points", points, "--touches", "1", "--out")
    # The hand sags by millimetres under the arm's weight, so these points are not quite where the tool was.
    said = typed(*command, arm_file.with_name("new.yaml"), "--save-readings", saved)
    assert next(turns) == 13
    assert not missing(said.out, "not taken: ", "hold the tool still")
    assert saved.exists()
    monkeypatch.setattr(sys, "stdin", person(str))
    typed(*command, arm_file.with_name("other.yaml"), status=130)
    assert not bench.port.is_open


@pytest.mark.parametrize("end", ["Ctrl-C", "port", "fit"])
def test_no_touch_is_lost_when_a_calibration_breaks_off(
    monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed, end: str
) -> None:
    bench = plugged(Bench(spec=EXACT), monkeypatch)
    (points := arm_file.with_name("points.csv")).write_text("0.1,0,0\n0.2,0,0\n0.1,0.1,0\n")
    turns = count(1)

    def touching() -> str:
        if next(turns) == 6 and end == "Ctrl-C":
            raise KeyboardInterrupt
        return "\n"

    def gone(*_: object) -> tuple[float, ...]:
        if next(reads) == 6 and end == "port":
            raise PortGone("the port vanished")
        return tuple(joint.zero_tick for joint in bench.config.joints)

    reads = count(1)
    monkeypatch.setattr(calibration, "read_ticks", gone)
    monkeypatch.setattr(sys, "stdin", person(touching))
    command = ("calibrate", "--arm", arm_file, "--port", "x", "--points", points)
    said = typed(*command, status={"Ctrl-C": 130, "port": 1, "fit": 1}[end])
    (kept,) = arm_file.parent.glob("my-arm-*.readings")
    assert len(load_readings(kept, load_arm(str(arm_file)))) == (6 if end == "fit" else 5)
    assert f"readings are kept in {kept}" in said.out.replace("\n", "")
    number, again = (6 if end == "fit" else 5), f"--readings {kept}` goes on"
    assert not missing(said.err.replace("\n", ""), f"touches in {kept}: {number}; `armctl calibrate", again)
    turns, reads = count(7), count(7)
    typed(*command, "--readings", kept, status=1)
    assert next(turns) == next(reads) == (7 if end == "fit" else 8), "what was touched is not asked for again"
    assert len(load_readings(kept, load_arm(str(arm_file)))) == 6


def test_what_makes_touches_useless_is_told_before_the_first(
    monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed
) -> None:
    plugged(Bench(spec=EXACT), monkeypatch)
    monkeypatch.setattr(sys, "stdin", person(lambda: pytest.fail("asked")))
    (points := arm_file.with_name("points.csv")).write_text("0.1,0,0\n0.2,0,0\n")
    command = ("calibrate", "--arm", arm_file, "--port", "x", "--points", points)
    assert "not overwritten" in typed(*command, "--save-readings", arm_file, status=1).err
    assert "too few different points: 2" in typed(*command, "--touches", "3", status=1).err


def test_zeros_alone_are_read_in_the_rest_pose(monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed) -> None:
    true = planted(load_arm("ax12-line"), np.random.default_rng(2), tick=20.0, length_m=0.0)
    plugged(Bench(spec=EXACT, simulated=true), monkeypatch)
    monkeypatch.setattr(sys, "stdin", person(lambda: "\n"))
    out = arm_file.with_name("new.yaml")
    said = typed("calibrate", "--arm", arm_file, "--port", "x", "--zero-at", "rest", "--out", out)
    assert zeros(load_arm(str(out))) == pytest.approx(zeros(true), abs=1.0)
    assert "base.zero_tick" in said.out


def test_pairs_are_measured_into_the_arms_own_file(
    monkeypatch: pytest.MonkeyPatch, arm_file: Path, typed: Typed, answer: Answer
) -> None:
    arm_file.write_text(calibration_text(paired_arm(), []), encoding="utf-8")
    bench = plugged(Bench(spec=EXACT, simulated=paired_arm()), monkeypatch)
    hand = bench.arm.hand = PosingHand(bench.arm)
    ends = iter(("shoulder", "elbow"))

    def leading() -> str:
        index = bench.config.joint_names.index(next(ends))
        posture = bench.arm.true_positions()
        posture[index] = sum(bench.config.joints[index].limits_rad) / 2.0
        hand.carry(posture)
        return "\n"

    monkeypatch.setattr(sys, "stdin", person(leading))
    said = typed("calibrate", "--arm", arm_file, "--port", "x", "--pairs")
    assert not missing(said.out, "lead the limp shoulder", "lead the limp elbow", "shoulder.pair", "written")
    pairs = [joint.pair for joint in load_arm(str(arm_file)).joints]
    assert [pair is not None and pair.table is not None for pair in pairs] == [False, True, True, False, False, False]
    assert answer("arm", "check", arm_file)["ok"]
    refused = typed("calibrate", "--arm", "ax12-line", "--port", "x", "--pairs", status=2)
    assert "no joint of this arm has two servos" in refused.err
    assert "give one of" in typed("calibrate", "--arm", arm_file, "--pairs", "--zero-at", "rest", status=2).err


def test_an_arm_with_pairs_is_not_set_up_by_questions(arm_file: Path, typed: Typed) -> None:
    answers = arm_file.with_name("answers.yaml")
    answers.write_text("{}\n", encoding="utf-8")
    said = typed("setup", "phantomx-reactor", "--port", "x", "--answers", answers, status=2)
    assert "two servos on one joint turn together" in said.err


# ---------------------------------------------------------------------------------------------- install and report


@pytest.fixture
def prefix(tmp_path: Path) -> str:
    program = tmp_path / "opt" / "bin" / "armctl"
    program.parent.mkdir(parents=True)
    program.touch()
    return str(program.parent.parent)


def test_a_dry_run_says_everything_and_does_nothing(tmp_path: Path, prefix: str, typed: Typed) -> None:
    said = typed("install", "--prefix", prefix, "--dry-run", "--root", tmp_path / "root")
    assert "would write /etc/systemd/system/armctl.service" in said.out
    assert not (tmp_path / "root").exists()


def test_install_and_uninstall_below_a_root(tmp_path: Path, prefix: str, typed: Typed, answer: Answer) -> None:
    told = answer("install", "--prefix", prefix, "--root", tmp_path)
    assert told["done"]
    assert {"act": "write /etc/udev/rules.d/60-armctl.rules", "due": True} in told["acts"]
    assert (tmp_path / "etc/systemd/system/armctl.service").is_file()
    left = typed("uninstall", "--root", tmp_path).out.replace("\n", " ")
    assert not missing(left, "left: /etc/armctl, /var/lib/armctl,", "users and groups armctl and armctl-web")
    assert not (tmp_path / "etc/systemd/system/armctl.service").exists()


def test_a_system_without_systemd_is_refused_before_anything_is_written(
    tmp_path: Path, prefix: str, typed: Typed, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(installation, "BOOTED", tmp_path / "none")
    monkeypatch.setattr(installation, "carry_out", Mock(side_effect=AssertionError))
    monkeypatch.setattr("shutil.which", str)
    said = typed("install", "--prefix", prefix, status=2).err
    assert not missing(said, "not started by systemd (a container?); run `armctl daemon` by hand instead")


def test_an_unknown_port_is_wrong_usage(tmp_path: Path, prefix: str, typed: Typed) -> None:
    said = typed("install", "--prefix", prefix, "--root", tmp_path, "--port", "/dev/no-such-port", status=2)
    assert "no such serial device" in said.err


def test_a_report_holds_every_part_even_where_nothing_runs(tmp_path: Path, answer: Answer, typed: Typed) -> None:
    logs = tmp_path / "xdg_data_home" / "armctl" / "logs"
    logs.mkdir(parents=True)
    (logs / "a.mcap").write_bytes(b"log")
    path = tmp_path / "report.zip"
    texts = ["versions.json", "configuration.json", "calibration.yaml", "status.json", "doctor.json", "journal.txt"]
    assert answer("report", "--out", path) == {"path": str(path), "files": [*texts, "logs/a.mcap"]}
    with zipfile.ZipFile(path) as archive:
        assert "numpy" in json.loads(archive.read("versions.json"))["packages"]
        assert "NoDaemon" in archive.read("status.json").decode()
        assert "checks" in archive.read("doctor.json").decode() or "port" in archive.read("doctor.json").decode()
        assert b"arm_id" in archive.read("calibration.yaml")
    assert "exists" in typed("report", "--out", path, status=1).err


# --------------------------------------------------------------------------------------- on the pseudo terminal


@pytest.mark.pty
def test_scan_and_a_change_of_baud_on_a_real_terminal(tmp_path: Path, answer: Answer) -> None:
    link = tmp_path / "servos"
    with started(tmp_path / "log", "sim", "--link", str(link)):
        assert [servo["id"] for servo in answer("scan", "--port", link)["servos"]] == [1, 2, 3, 4, 5, 6]
        answer("servo", "set-baud", "3", "57600", "--port", link)
        answer("servo", "set-baud", "3", "1000000", "--baud", "57600", "--port", link)


@pytest.mark.pty
def test_simulated_servos_of_the_factory_fail_the_doctor_and_are_mended_at_once(tmp_path: Path, answer: Answer) -> None:
    link = tmp_path / "servos"
    with started(tmp_path / "log", "sim", "--link", str(link), "--factory", "--return-delay-us", "0"):
        fix = fixes(answer("doctor", "--port", link, status=1))["angle_limits"]
        assert fix == f"armctl servo mend 6 --port {link}"
        assert len(answer("servo", "mend", "all", "--port", link)["mended"]) == 12
        assert answer("servo", "mend", "all", "--port", link) == {"mended": []}


@pytest.mark.pty
def test_doctor_on_a_slow_terminal_with_a_wrong_id_names_all_three(tmp_path: Path, answer: Answer) -> None:
    link = tmp_path / "servos"
    with started(tmp_path / "log", "sim", "--link", str(link), "--latency-ms", "16"):
        answer("servo", "set-id", "4", "9", "--port", link)
        bad = fixes(answer("doctor", "--port", link, status=1))
    assert bad.keys() == TROUBLES
    assert bad["wrong_id"] == f"armctl servo set-id 9 4 --port {link}"
    assert bad["return_delay"].startswith("armctl servo set-return-delay ")
    assert "latency_timer" in bad["adapter_latency"]


def test_no_arm_is_offered_that_questions_cannot_set_up(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(sys, "stdin", io.StringIO(""))
    main(["setup", "--port", "x", "--json"])
    [asked, *_] = [json.loads(line)["question"] for line in capsys.readouterr().out.splitlines() if "question" in line]
    assert asked["key"] == "kind"
    assert "phantomx-pincher" in asked["choices"]
    assert not {"phantomx-reactor", "crustcrawler"} & set(asked["choices"])
