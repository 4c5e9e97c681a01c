"""The commands that set an arm up, on a simulated arm in virtual time and once on the real pseudo terminal."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from datetime import date
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl.cli import main, setup
from armctl.commissioning.calibration import Readings, readings_text
from armctl.dynamixel import ax12a
from armctl.files import find_arm_file, load_arm
from tests.commissioning.bench import EXACT, Bench, PosingHand, planted, postures, touch_points


@pytest.fixture(autouse=True)
def _own_folders(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("XDG_DATA_HOME", "XDG_CONFIG_HOME", "XDG_RUNTIME_DIR"):
        monkeypatch.setenv(name, str(tmp_path / name.lower()))
    monkeypatch.setenv("ARMCTL_SOCKET", str(tmp_path / "nobody.sock"))


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


@pytest.fixture
def answer(capsys: pytest.CaptureFixture[str]) -> Callable[..., tuple[int, dict[str, Any]]]:
    def run(*arguments: str) -> tuple[int, dict[str, Any]]:
        status = main([*arguments, "--json"])
        return status, json.loads(capsys.readouterr().out)

    return run


Answer = Callable[..., tuple[int, dict[str, Any]]]


# ------------------------------------------------------------------------------------------------- scan and doctor


def test_scan_lists_the_servos(bench: Bench, answer: Answer) -> None:
    status, result = answer("scan", "--port", "x")
    assert status == 0
    assert result["servos"][0] == {
        "id": 1, "baud": 1_000_000, "model": 12, "firmware": 24, "round_trip_us": 620, "clash": False,
    }  # fmt: skip
    assert [servo["id"] for servo in result["servos"]] == [1, 2, 3, 4, 5, 6]
    assert not bench.port.is_open


def test_scan_says_what_it_found_and_what_to_do_when_nothing_is(
    bench: Bench, capsys: pytest.CaptureFixture[str]
) -> None:
    bench.servos[3].set(ax12a.ID, 3)
    bench.servos[5].set(ax12a.RETURN_LEVEL, 0)
    assert main(["scan", "--port", "x", "--baud", "1000000"]) == 0
    text = capsys.readouterr().out
    assert "two servos have this id" in text
    assert "answers no READ" in text
    assert main(["scan", "--port", "x", "--baud", "9600"]) == 1
    assert "try --baud all" in capsys.readouterr().out


def test_scan_of_all_bauds_finds_a_stray(bench: Bench, answer: Answer) -> None:
    bench.servos[1].set(ax12a.BAUD, 34)
    _, result = answer("scan", "--port", "x", "--baud", "all")
    assert {(servo["id"], servo["baud"]) for servo in result["servos"]} >= {(1, 1_000_000), (2, 57_600)}


def test_doctor_names_every_trouble_with_its_fix_and_fails(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], answer: Answer
) -> None:
    bench = plugged(Bench(latency_ms=16.0), monkeypatch)
    bench.servos[3].set(ax12a.ID, 9)
    status, result = answer("doctor", "--port", "x")
    assert status == 1
    bad = {check["name"]: check["fix"] for check in result["checks"] if not check["ok"]}
    assert bad.keys() == {"adapter_latency", "present", "wrong_id", "return_delay"}
    assert all(bad.values())
    assert set(result["checks"][0]) >= {"name", "ok", "value", "fix"}
    assert main(["doctor", "--port", "x"]) == 1
    text = capsys.readouterr().out
    assert "-> armctl servo set-id 9 4 --port x" in text
    assert "500 us (register 250)  (servo 1)" in text


def test_doctor_is_content_with_a_fit_arm(bench: Bench, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["servo", "set-return-delay", "all", "0", "--port", "x"]) == 0
    assert main(["doctor", "--port", "x"]) == 0
    assert "FAIL" not in capsys.readouterr().out


def test_doctor_leaves_a_busy_port_alone(tmp_path: Path, answer: Answer) -> None:
    status, result = answer("doctor", "--port", str(tmp_path / "none"))
    assert status == 1
    assert [check["name"] for check in result["checks"] if not check["ok"]] == ["port"]


# ----------------------------------------------------------------------------------------------------------- servo


def test_servo_commands_write_and_say_so(bench: Bench, answer: Answer, capsys: pytest.CaptureFixture[str]) -> None:
    assert answer("servo", "set-id", "4", "9", "--port", "x") == (0, {"id": 9, "before": 4})
    assert answer("servo", "set", "9", "shutdown", "37", "--port", "x")[0] == 0
    assert answer("servo", "set-baud", "9", "57600", "--port", "x")[1]["real_baud"] == 57_142
    assert main(["servo", "set-baud", "9", "115200", "--baud", "57600", "--port", "x"]) == 0
    assert "The daemon talks at 1000000" in capsys.readouterr().out
    assert main(["servo", "set-baud", "9", "1000000", "--baud", "115200", "--port", "x"]) == 0
    assert main(["servo", "set-id", "9", "4", "--port", "x"]) == 0
    assert main(["servo", "set", "4", "shutdown", "36", "--port", "x"]) == 0
    assert "servo 9 is now servo 4" in capsys.readouterr().out
    assert answer("servo", "set-return-delay", "4", "101", "--port", "x")[1]["return_delay_us"] == 100
    assert bench.servos[3].get(ax12a.ID) == 4
    assert bench.servos[3].get(ax12a.RETURN_DELAY) == 50
    assert not any(servo.torque_enabled for servo in bench.servos)


@pytest.mark.parametrize(
    ("arguments", "status", "text"),
    [
        ("servo set-id 1 2", 1, "servo 2 already answers"),
        ("servo set-id 1 300", 2, "range"),
        ("servo set-baud 1 1234", 2, "no rate of an AX-12A"),
        ("servo set 1 goal_position 3", 2, "one of: return_delay_time"),
        ("servo set-return-delay x 3", 2, "neither an id nor"),
        ("scan --baud x", 2, "neither a number nor"),
        ("scan --baud 12", 2, "outside 9000..1000000"),
        ("calibrate", 2, "give one of --points"),
        ("calibrate --zero-at rest", 2, "needs a terminal"),
        ("calibrate --readings /nonexistent.yaml", 2, "cannot read the readings"),
        ("servo eeprom diff /nonexistent.yaml", 2, "cannot read the EEPROM file"),
    ],
)
def test_refusals_are_one_clear_sentence(
    bench: Bench, arguments: str, status: int, text: str, capsys: pytest.CaptureFixture[str]
) -> None:
    before = [servo.writes for servo in bench.servos]
    assert main([*arguments.split(), "--port", "x"]) == status
    assert text in capsys.readouterr().err
    assert [servo.writes for servo in bench.servos] == before
    assert not bench.port.is_open


def test_without_a_port_the_remedy_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scan"]) == 2
    said = capsys.readouterr().err
    assert said.startswith("armctl scan: --port: no serial port named; give --port PATH")


def test_eeprom_is_saved_compared_and_restored(
    bench: Bench, tmp_path: Path, answer: Answer, capsys: pytest.CaptureFixture[str]
) -> None:
    file = str(tmp_path / "e.yaml")
    status, saved = answer("servo", "eeprom", "save", file, "--port", "x")
    assert (status, len(saved["servos"])) == (0, 6)
    assert main(["servo", "eeprom", "save", file, "--port", "x"]) == 1
    assert "not overwritten" in capsys.readouterr().err
    assert main(["servo", "eeprom", "diff", file, "--port", "x"]) == 0
    assert "no difference" in capsys.readouterr().out
    bench.servos[2].set(ax12a.SHUTDOWN, 4)
    difference = {"servo_id": 3, "register": "shutdown", "wanted": 36, "found": 4}
    assert answer("servo", "eeprom", "diff", file, "--port", "x") == (1, {"differences": [difference]})
    bench.servos[4].set(ax12a.ID, 50)
    assert main(["servo", "eeprom", "diff", file, "--port", "x"]) == 1
    assert "not readable" in capsys.readouterr().out
    bench.servos[4].set(ax12a.ID, 5)
    assert main(["servo", "eeprom", "restore", file, "--servo", "3", "--port", "x"]) == 0
    assert "1 registers restored" in capsys.readouterr().out
    assert answer("servo", "eeprom", "restore", file, "--port", "x") == (0, {"restored": []})
    assert main(["servo", "eeprom", "save", str(tmp_path / "f.json"), "--port", "x"]) == 0


# ------------------------------------------------------------------------------------------------------- calibrate


@pytest.fixture
def arm_file(tmp_path: Path) -> Path:
    path = tmp_path / "my-arm.yaml"
    path.write_text(find_arm_file("ax12-line").read_text())
    return path


def test_calibrate_from_readings_writes_a_new_file_beside_the_old(
    tmp_path: Path, arm_file: Path, answer: Answer, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(0)
    true = planted(load_arm("ax12-line"), rng, tick=20.0, length_m=0.003)
    touches = touch_points(Bench(spec=EXACT, simulated=true), 16, rng)
    readings = tmp_path / "r.yaml"
    readings.write_text(readings_text(Readings(arm_id=true.arm_id, touches=tuple(touches))))
    old = arm_file.read_text()
    command = ["calibrate", "--arm", str(arm_file), "--readings", str(readings)]
    status, result = answer(*command)
    assert status == 0
    today = date.today().isoformat()
    assert result["path"] == str(tmp_path / f"my-arm-{today}.yaml")
    assert arm_file.read_text() == old
    calibrated = load_arm(result["path"])
    for found, planted_joint in zip(calibrated.joints[:5], true.joints[:5], strict=True):
        assert found.zero_tick == pytest.approx(planted_joint.zero_tick, abs=1.0)
    for name, length in true.lengths_m.items():
        assert calibrated.lengths_m[name] == pytest.approx(length, abs=0.0005)
    assert {change["key"] for change in result["changes"]} >= {"base.zero_tick", "lengths_m.d1"}
    assert len(result["residuals_mm"]) == 16
    assert result["rms_mm"] < 1.0
    assert main([*command[:2], result["path"], *command[3:]]) == 0
    text = capsys.readouterr().out
    assert f"my-arm-{today}-2.yaml" in text
    assert "roll.zero_tick" in text
    assert "does not move the tool" in text
    assert main([*command, "--out", result["path"]]) == 1
    assert "not overwritten" in capsys.readouterr().err


def test_calibrate_says_when_the_postures_were_too_much_alike(
    tmp_path: Path, arm_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    touches = touch_points(Bench(spec=EXACT), 1, np.random.default_rng(0)) * 12
    readings = tmp_path / "r.yaml"
    readings.write_text(readings_text(Readings(arm_id="ax12-line", touches=tuple(touches))))
    assert main(["calibrate", "--arm", str(arm_file), "--readings", str(readings)]) == 0
    text = capsys.readouterr().out
    assert "left alone" in text
    assert "touch every point in more postures" in text


class Person:
    """Someone at a terminal who does something each time before pressing Enter."""

    def __init__(self, act: Callable[[int], bool]) -> None:
        self._act = act
        self.asked = 0

    def isatty(self) -> bool:
        return True

    def readline(self) -> str:
        self.asked += 1
        return "\n" if self._act(self.asked - 1) else ""


def test_calibrate_leads_a_person_through_the_points(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arm_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rng = np.random.default_rng(1)
    config = load_arm("ax12-line")
    bench = Bench(spec=EXACT)
    hand = PosingHand(bench.arm)
    bench.arm.hand = hand
    places = postures(config, 12, rng)
    points = tmp_path / "points.csv"
    points.write_text("\n".join(",".join(map(str, p)) for p in bench.arm.tool_positions(places).tolist()))
    plugged(bench, monkeypatch)

    def act(asked: int) -> bool:
        hand.carry(places[max(0, asked - 1)])
        bench.clock.advance_ns(100_000_000 if asked == 0 else 3_000_000_000)  # too early the first time
        bench.arm.advance(bench.clock.now_ns())
        return True

    person = Person(act)
    monkeypatch.setattr(sys, "stdin", person)
    saved = tmp_path / "kept.yaml"
    command = ["calibrate", "--arm", str(arm_file), "--port", "x", "--points", str(points), "--touches", "1"]
    # The hand sags by millimetres under the arm's weight, so these points are not quite where the tool was.
    assert main([*command, "--save-readings", str(saved), "--out", str(tmp_path / "new.yaml")]) == 0
    text = capsys.readouterr().out
    assert person.asked == 13
    assert "not taken: " in text
    assert "hold the tool still" in text
    assert saved.exists()
    monkeypatch.setattr(sys, "stdin", Person(lambda asked: False))
    assert main([*command, "--out", str(tmp_path / "other.yaml")]) == 130
    assert not bench.port.is_open


def test_zeros_alone_are_read_in_the_rest_pose(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, arm_file: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    true = planted(load_arm("ax12-line"), np.random.default_rng(2), tick=20.0, length_m=0.0)
    plugged(Bench(spec=EXACT, simulated=true), monkeypatch)
    monkeypatch.setattr(sys, "stdin", Person(lambda asked: True))
    out = tmp_path / "new.yaml"
    assert main(["calibrate", "--arm", str(arm_file), "--port", "x", "--zero-at", "rest", "--out", str(out)]) == 0
    for found, planted_joint in zip(load_arm(str(out)).joints, true.joints, strict=True):
        assert found.zero_tick == pytest.approx(planted_joint.zero_tick, abs=1.0)
    assert "base.zero_tick" in capsys.readouterr().out


# --------------------------------------------------------------------------------------- on the pseudo terminal


@contextmanager
def simulator(link: Path, *options: str) -> Iterator[subprocess.Popen[str]]:
    command = [sys.executable, "-m", "armctl", "sim", "--link", str(link), *options]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=os.environ.copy()) as process:
        try:
            assert process.stdout is not None
            assert process.stdout.readline() == f"ready {link}\n"
            yield process
        finally:
            process.terminate()
            process.wait(10.0)


@pytest.mark.pty
def test_scan_and_a_change_of_baud_on_a_real_terminal(tmp_path: Path, answer: Answer) -> None:
    link = tmp_path / "servos"
    with simulator(link):
        status, result = answer("scan", "--port", str(link))
        assert status == 0
        assert [servo["id"] for servo in result["servos"]] == [1, 2, 3, 4, 5, 6]
        assert answer("servo", "set-baud", "3", "57600", "--port", str(link))[0] == 0
        assert answer("servo", "set-baud", "3", "1000000", "--baud", "57600", "--port", str(link))[0] == 0


@pytest.mark.pty
def test_doctor_on_a_slow_terminal_with_a_wrong_id_names_all_three(tmp_path: Path, answer: Answer) -> None:
    link = tmp_path / "servos"
    with simulator(link, "--latency-ms", "16"):
        assert answer("servo", "set-id", "4", "9", "--port", str(link))[0] == 0
        status, result = answer("doctor", "--port", str(link))
    assert status == 1
    bad = {check["name"]: check["fix"] for check in result["checks"] if not check["ok"]}
    assert bad.keys() == {"adapter_latency", "present", "wrong_id", "return_delay"}
    assert bad["wrong_id"] == f"armctl servo set-id 9 4 --port {link}"
    assert bad["return_delay"].startswith("armctl servo set-return-delay ")
    assert "latency_timer" in bad["adapter_latency"]
