"""What a person reads who starts armctl wrongly: one clear line, the right exit status, no traceback."""

import json
import os
import threading
import tty
from collections.abc import Iterator
from pathlib import Path

import pytest
import serial
import yaml

from armctl.files import calibration_dirs
from tests.scenarios.bench import Bench, armctl, bench, simulator

pytestmark = pytest.mark.pty

CALIBRATION = next(folder / "ax12-line.yaml" for folder in calibration_dirs() if (folder / "ax12-line.yaml").is_file())
OTHER_MODEL = """
import sys
from pathlib import Path
from armctl.files import load_arm
from armctl.dynamixel import ax12a
from armctl.sim import pty
from armctl.sim.arm import SimulatedArm

other = SimulatedArm(load_arm("ax12-line"))
other.servos[2].set(ax12a.MODEL, 300)
pty.run(other, link=Path(sys.argv[-1]), ready=lambda link: print("ready", link, flush=True))
"""


@pytest.fixture
def port() -> Iterator[str]:
    """A serial port with nothing behind it."""
    master, slave = os.openpty()
    tty.setraw(slave)
    yield os.ttyname(slave)
    os.close(master)
    os.close(slave)


def one_line(folder: Path, status: int, *arguments: str) -> str:
    """What a command that must fail says: one line, and at most the next command."""
    done = armctl(folder, *arguments)
    assert (done.returncode, done.stdout) == (status, ""), done.stderr
    assert done.stderr.startswith("armctl: ")
    _, *following = done.stderr.splitlines()
    assert [line.partition(":")[0].strip() for line in following] in ([], ["next"])
    return done.stderr


@pytest.mark.parametrize(
    ("status", "line", "says"),
    [
        (1, "daemon --port /dev/ttyNOBODY", "/dev/ttyNOBODY: no such port"),
        (2, "daemon --port /dev/null --arm nobodys", "known: ax12-line"),
        (3, "status", "armctl daemon --port"),
    ],
)
def test_what_is_missing_is_named_in_one_line(tmp_path: Path, status: int, line: str, says: str) -> None:
    assert says in one_line(tmp_path, status, *line.split())


def test_port_of_another_process_names_it(tmp_path: Path, port: str) -> None:
    with serial.Serial(port, 1_000_000, exclusive=True):
        said = one_line(tmp_path, 1, "daemon", "--port", port)
    assert f"(pid {os.getpid()})" in said
    assert "in use by" in said


def test_port_that_comes_free_soon_is_waited_for() -> None:
    """As after a daemon's death: its control process still brings the arm to rest."""
    with simulator() as arm, bench(arm.port) as b:
        leaving = threading.Timer(1.0, serial.Serial(str(arm.port), 1_000_000, exclusive=True).close)
        leaving.start()
        b.start_daemon()
        leaving.join()
        assert b.until(lambda snapshot: snapshot["state"] == "off")["fault"] is None


def assert_latched(b: Bench, code: str, servo_id: int, text: str) -> None:
    """The daemon runs, because the servo may yet be connected, but says what is wrong and refuses torque."""
    b.until(lambda snapshot: snapshot["fault"] is not None)  # the servos are identified in steps
    said = b.daemons[0].stderr.read_text()
    assert [line.count(text) for line in said.splitlines() if code in line] == [1]
    asked = armctl(b.folder, "status", "--socket", str(b.socket), "--json")
    assert asked.returncode == 0
    fault = json.loads(asked.stdout)["fault"]
    assert (fault["code"], fault["servo_id"]) == (code, servo_id)
    assert text in fault["text"]
    assert "`armctl clear`" in fault["next"]
    assert "fault is latched" in one_line(b.folder, 1, "torque", "on", "--socket", str(b.socket))
    assert text in one_line(b.folder, 1, "clear", "--socket", str(b.socket))
    assert "Traceback" not in b.daemons[0].stderr.read_text()


def test_silent_servo_is_named_and_torque_refused(tmp_path: Path) -> None:
    calibration = yaml.safe_load(CALIBRATION.read_text())
    calibration["joints"].append({"name": "gripper", "servo_id": 9, "limits_deg": [-90, 90]})
    file = tmp_path / "seven.yaml"
    file.write_text(yaml.safe_dump(calibration))
    with simulator() as arm, bench(arm.port) as b:
        b.start_daemon("--arm", str(file))
        assert_latched(b, "SERVO_SILENT", 9, "servo 9 (gripper): no reply")


def test_servo_of_another_model_is_named_and_torque_refused() -> None:
    with simulator(program=("-c", OTHER_MODEL)) as arm, bench(arm.port) as b:
        b.start_daemon()
        assert_latched(b, "WRONG_MODEL", 3, "servo 3 (elbow): model number 300, wanted 12")
