"""Programs that armctl did not write, on the simulated arm's pseudo terminal, in real time."""

import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Iterator
from pathlib import Path

import dynamixel_sdk
import numpy as np
import pytest
import serial
from dynamixel_sdk import port_handler
from pyax12.connection import Connection

from armctl.cli import main
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, RequestRefused
from armctl.sim.control import SimulatorClient, control_path
from armctl.sim.pty import PseudoTerminal
from tests.conformance.conftest import SIMULATOR, simulator

pytestmark = pytest.mark.pty

# How long a servo is given to answer: a few milliseconds, as the clients have it, would be a test of the machine.
SILENT_S = 0.3


@pytest.fixture(scope="module")
def link(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    path = tmp_path_factory.mktemp("sim") / "port"
    with simulator(path):
        yield path


@pytest.fixture
def control(link: Path) -> Iterator[SimulatorClient]:
    with SimulatorClient(control_path(link)) as client:
        yield client
        for fault in client.faults():
            client.fault_end(fault["id"])
        client.replug()
        client.let_go()


@pytest.fixture
def port(link: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[dynamixel_sdk.PortHandler]:
    monkeypatch.setattr(port_handler, "LATENCY_TIMER", SILENT_S * 1000.0 / 2.0)
    handler = dynamixel_sdk.PortHandler(str(link))
    assert handler.openPort()
    yield handler
    handler.closePort()


SDK = dynamixel_sdk.PacketHandler(1.0)


def test_stock_sdk_finds_six_servos_and_no_more(port: dynamixel_sdk.PortHandler) -> None:
    found = [i for i in range(9) if SDK.ping(port, i) == (ax12a.MODEL_NUMBER, dynamixel_sdk.COMM_SUCCESS, 0)]
    assert found == [1, 2, 3, 4, 5, 6]


def test_stock_sdk_reads_writes_and_moves(port: dynamixel_sdk.PortHandler, control: SimulatorClient) -> None:
    assert SDK.read2ByteTxRx(port, 1, ax12a.PRESENT_POSITION.address)[1:] == (dynamixel_sdk.COMM_SUCCESS, 0)
    assert SDK.write2ByteTxRx(port, 1, ax12a.MOVING_SPEED.address, 300) == (dynamixel_sdk.COMM_SUCCESS, 0)
    assert SDK.write2ByteTxRx(port, 1, ax12a.GOAL.address, 560) == (dynamixel_sdk.COMM_SUCCESS, 0)
    assert control.state()["servos"][0]["goal_tick"] == 560
    moving = dynamixel_sdk.GroupSyncWrite(port, SDK, ax12a.GOAL.address, 4)
    for servo_id, tick in ((1, 540), (6, 500)):
        assert moving.addParam(servo_id, [*tick.to_bytes(2, "little"), *(300).to_bytes(2, "little")])
    assert moving.txPacket() == dynamixel_sdk.COMM_SUCCESS
    deadline, off_tick = time.monotonic() + 5.0, np.inf
    while off_tick > 4:
        assert time.monotonic() < deadline
        ticks = [SDK.read2ByteTxRx(port, i, ax12a.PRESENT_POSITION.address)[0] for i in (1, 6)]
        off_tick = np.abs(np.array(ticks) - (540, 500)).max()
    for servo_id in (1, 6):
        assert SDK.write1ByteTxRx(port, servo_id, ax12a.TORQUE_ENABLE.address, 0) == (dynamixel_sdk.COMM_SUCCESS, 0)


def test_pypot_scans_reads_and_moves(link: Path, control: SimulatorClient) -> None:
    from pypot.dynamixel import DxlIO

    with DxlIO(str(link), baudrate=1_000_000, timeout=SILENT_S) as io:
        assert io.scan(range(1, 8)) == [1, 2, 3, 4, 5, 6]
        assert set(io.get_model((1, 6))) == {"AX-12"}
        before = io.get_present_position((6,))[0]
        io.set_goal_position({6: before + 10.0})
        time.sleep(0.1)  # pypot flushes its output before each packet, and so what the kernel has not yet passed on
        assert io.get_goal_position((6,))[0] == pytest.approx(before + 10.0, abs=0.3)
        assert io.is_torque_enabled((6,)) == (True,)
        io.disable_torque((6,))
        time.sleep(0.1)
    assert control.state()["servos"][5]["torque_enabled"] is False


@pytest.fixture
def connection(link: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Connection]:
    found = Connection(port=str(link), baudrate=1_000_000, timeout=SILENT_S, waiting_time=0.0)
    read = found.serial_connection.read

    def reply(_arrived: int) -> bytes:
        begin = read(4)
        return bytes(begin + read(begin[3])) if begin else b""

    # It takes what is there after a fixed time: on a busy machine not all of the reply.
    monkeypatch.setattr(found.serial_connection, "read", reply)
    yield found
    found.close()


def test_pyax12_scans_and_reads(connection: Connection) -> None:
    assert list(connection.scan(range(20))) == [1, 2, 3, 4, 5, 6]
    assert connection.get_model_number(2) == ax12a.MODEL_NUMBER
    assert len(connection.dump_control_table(2)) == ax12a.TABLE_SIZE
    assert connection.get_present_voltage(2) == 12.0


def test_pyax12_writes_and_moves(connection: Connection) -> None:
    goal = connection.get_present_position(1) + 30
    connection.goto(1, goal, speed=300)
    deadline = time.monotonic() + 5.0
    while abs(connection.get_present_position(1) - goal) > 4:
        assert time.monotonic() < deadline
    assert connection.get_goal_position(1) == goal
    connection.write_data(1, ax12a.TORQUE_ENABLE.address, 0)
    assert bytes(connection.read_data(1, ax12a.TORQUE_ENABLE.address, 1)) == b"\x00"


def test_hand_moves_the_arm_and_truth_tells_so(link: Path, control: SimulatorClient) -> None:
    begin_ns = time.monotonic_ns()
    guided = control.guide((0.18, -0.1, 0.1), (0.18, 0.1, 0.1), seed=1, duration_s=4.0)
    assert guided.end_s - guided.begin_s == pytest.approx(4.0)
    deadline = time.monotonic() + 5.0
    while np.linalg.norm((truth := control.truth(begin_ns, time.monotonic_ns())).tool_m[-1:] - truth.tool_m[:1]) < 0.01:
        assert time.monotonic() < deadline
        time.sleep(0.05)
    assert np.diff(truth.time_ns).tolist() == [10_000_000] * (len(truth.time_ns) - 1)
    assert truth.tool_m.shape == (len(truth.time_ns), 3)
    assert truth.joints_rad.shape == (len(truth.time_ns), 6)
    assert control.truth(0, 1).time_ns.size == 0
    with pytest.raises(RequestRefused, match="within the joint limits"):
        control.guide((0.9, 0.0, 0.1), (0.18, 0.1, 0.1), seed=1)


def test_live_fault_strikes_programs_at_once(port: dynamixel_sdk.PortHandler, control: SimulatorClient) -> None:
    number = control.fault_begin("mute", servo_id=2)
    assert SDK.ping(port, 2)[1] == dynamixel_sdk.COMM_RX_TIMEOUT
    assert SDK.ping(port, 3)[1] == dynamixel_sdk.COMM_SUCCESS
    assert [(fault["id"], fault["kind"]) for fault in control.faults()] == [(number, "mute")]
    control.fault_end(number)
    assert SDK.ping(port, 2)[1] == dynamixel_sdk.COMM_SUCCESS
    with pytest.raises(RequestRefused, match="no servo 9"):
        control.fault_begin("mute", servo_id=9)


def wait_for(link: Path, *, there: bool) -> None:
    deadline = time.monotonic() + 5.0
    while link.is_symlink() is not there:
        assert time.monotonic() < deadline
        time.sleep(0.01)


def test_unplug_fault_takes_the_port_away_for_its_time(link: Path, control: SimulatorClient) -> None:
    begin_s = time.monotonic()
    control.fault_begin("unplug", duration_s=0.3)
    wait_for(link, there=False)
    wait_for(link, there=True)
    assert 0.25 < time.monotonic() - begin_s < 3.0


def test_command_line_begins_lists_and_ends_faults(
    link: Path, control: SimulatorClient, capsys: pytest.CaptureFixture[str]
) -> None:
    def say(*words: str) -> str:
        assert main(["fault", *words, "--link", str(link)]) == 0
        return capsys.readouterr().out

    number = say("begin", "late", "--servo", "2", "--value", "12", "--probability", "0.5", "--for", "60").strip()
    assert f"{number} late 2 now" in " ".join(say("list").split())
    (fault,) = json.loads(say("list", "--json"))["faults"]
    assert (fault["kind"], fault["value"], fault["probability"]) == ("late", 12.0, 0.5)
    assert say("end", number) == ""
    assert control.faults() == []
    assert main(["fault", "begin", "lsot", "--link", str(link)]) == 1
    assert "unknown; known: lost" in capsys.readouterr().err.replace("\n", " ")
    assert main(["fault", "begin", "--help"]) == 0
    assert "second_writer" in capsys.readouterr().out


def test_program_plays_its_fault_file_in_lockstep_too(tmp_path: Path) -> None:
    script = tmp_path / "faults.yaml"
    script.write_text("faults:\n  - {kind: unplug, begin_s: 0, duration_s: 0.4}\n  - {kind: mute, servo_id: 2}\n")
    link = tmp_path / "port"
    with simulator(link, "--faults", str(script), "--echo", "--lockstep"):
        wait_for(link, there=False)
        wait_for(link, there=True)
        with serial.Serial(str(link), 1_000_000, timeout=0.2) as port:
            ping = b"\xff\xff\x01\x02\x01\xfb"
            port.write(ping)
            assert port.read(12) == ping + b"\xff\xff\x01\x02\x00\xfc"
            time.sleep(0.1)
            port.write(b"\xff\xff\x02\x02\x01\xfa")
            assert port.read(12) == b"\xff\xff\x02\x02\x01\xfa"


def test_wrong_fault_file_is_refused_before_anything_starts(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "faults.yaml"
    script.write_text("faults:\n  - {kind: lost, servo_id: 9}\n")
    assert main(["sim", "--link", str(tmp_path / "port"), "--faults", str(script)]) == 2
    assert "faults.0.servo_id: no servo 9" in capsys.readouterr().err
    assert not (tmp_path / "port").is_symlink()


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_signal_ends_it_cleanly_and_nothing_is_left(tmp_path: Path, number: signal.Signals) -> None:
    link = tmp_path / "deep" / "port"
    with simulator(link) as process:
        assert sorted(path.name for path in link.parent.iterdir()) == ["port", "port.control"]
        process.send_signal(number)
        assert process.wait(5.0) == 0
    assert list(link.parent.iterdir()) == []


def test_second_simulator_on_the_same_link_is_refused(link: Path) -> None:
    before = os.readlink(link)
    second = subprocess.run([*SIMULATOR, str(link)], capture_output=True, text=True, timeout=30.0, check=False)
    assert second.returncode != 0
    assert "another simulator runs here" in " ".join(second.stderr.split())
    assert os.readlink(link) == before


def test_link_replaces_a_dead_link_but_nothing_else(tmp_path: Path) -> None:
    link = tmp_path / "port"
    link.symlink_to("/dev/pts/nowhere")
    terminal = PseudoTerminal(link)
    terminal.replug()
    terminal.replug()
    assert os.readlink(link).startswith("/dev/")
    assert terminal.baud() == 1_000_000
    terminal.unplug()
    terminal.unplug()
    assert not terminal.plugged
    assert not link.is_symlink()
    link.write_text("precious")
    with pytest.raises(ConfigError, match="exists and is no symlink"):
        terminal.replug()
    assert link.read_text() == "precious"
    with pytest.raises(ConfigError, match="cannot create the link"):
        PseudoTerminal(Path("/proc/armctl/port")).replug()


def test_unread_replies_do_not_block_the_simulator(tmp_path: Path) -> None:
    terminal = PseudoTerminal(tmp_path / "port")
    terminal.replug()
    for _ in range(100):
        terminal.write(bytes(1000))
    with serial.Serial(str(tmp_path / "port"), 1_000_000) as port:
        port.write(b"abc")
        assert select.select([terminal.fileno()], [], [], 60.0)[0]  # the kernel hands them on when it gets to it
        assert terminal.read() == b"abc"
    terminal.unplug()
