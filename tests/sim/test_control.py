"""The control socket: its methods on virtual time, its server without a program around it."""

import contextlib
import json
import select
import socket
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from armctl.clock import NS_PER_S, VirtualClock
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import ConfigError, PortBusy, PortMissing
from armctl.sim.arm import SimulatedArm
from armctl.sim.control import TRUTH_PERIOD_NS, TRUTH_S, Controls, SimulatorClient, TruthRing, control_path
from armctl.sim.control_server import MAX_LINE_BYTES, ControlServer
from tests.sim.conftest import refusals


class FakePlug:
    plugged = True

    def unplug(self) -> None:
        self.plugged = False

    def replug(self) -> None:
        self.plugged = True


class Desk:
    """The methods, on an arm whose clock stands still."""

    def __init__(self, arm: ArmConfig) -> None:
        self.clock = VirtualClock()
        self.arm = SimulatedArm(arm)
        self.ring = TruthRing()
        self.plug = FakePlug()
        self.controls = Controls(self.arm, self.ring, self.plug, self.clock.now_ns)

    def ask(self, method: str, **params: Any) -> dict[str, Any]:
        return self.say(json.dumps({"method": method, "params": params}).encode())

    def say(self, line: bytes) -> dict[str, Any]:
        answer: dict[str, Any] = json.loads("".join(self.controls.answer(line)))
        return answer


@pytest.fixture
def desk(arm: ArmConfig) -> Desk:
    return Desk(arm)


def test_guide_takes_the_arm_and_let_go_leaves_it(desk: Desk) -> None:
    line = {"from": [0.18, -0.1, 0.1], "to": [0.18, 0.1, 0.1]}
    result = desk.ask("guide", **line, seed=1, duration_s=4)["result"]
    assert result["end_s"] - result["begin_s"] == pytest.approx(4.0)
    assert desk.ask("state")["result"]["guided"] is True
    assert desk.ask("let_go") == {"result": {}}
    assert desk.ask("state")["result"]["guided"] is False
    assert desk.ask("guide", **line, seed=1)["result"]["duration_s"] > 4.0


def test_hold_takes_the_joints_of_which_the_state_tells(desk: Desk) -> None:
    joints = desk.ask("state")["result"]["joints"]
    assert joints[0].keys() == {"name", "limits_deg", "rest_deg"}
    assert desk.ask("hold", joints_rad=[0.0] * len(joints), free=2)["result"]["duration_s"] >= 1.0
    assert desk.ask("state")["result"]["guided"] is True


def test_state_tells_the_truth_about_joints_and_servos(desk: Desk, arm: ArmConfig) -> None:
    state = desk.ask("state")["result"]
    assert state["joints_rad"] == pytest.approx([joint.rest_rad for joint in arm.joints])
    assert state["tool_m"] == pytest.approx(desk.arm.true_tool_position().tolist())
    assert [servo["servo_id"] for servo in state["servos"]] == list(arm.servo_ids)
    assert not any(servo["torque_enabled"] for servo in state["servos"])


def test_plug_is_pulled_and_put_back(desk: Desk) -> None:
    desk.ask("unplug")
    assert desk.ask("state")["result"]["plugged"] is False
    desk.ask("replug")
    assert desk.plug.plugged


def test_fault_begins_is_listed_and_ends(desk: Desk) -> None:
    assert desk.ask("faults") == {"result": {"faults": []}}
    number = desk.ask("fault_begin", kind="mute", servo_id=2, duration_s=3)["result"]["id"]
    later = desk.ask("fault_begin", kind="late", value=12, count=2, begin_s=5)["result"]["id"]
    mute, late = desk.ask("faults")["result"]["faults"]
    assert (mute["id"], mute["kind"], mute["servo_id"], mute["active"]) == (number, "mute", 2, True)
    assert (late["id"], late["value"], late["active"], late["end_s"]) == (later, 12.0, False, None)
    desk.clock.advance_ns(3 * NS_PER_S)
    assert [fault["id"] for fault in desk.ask("faults")["result"]["faults"]] == [later]
    assert desk.ask("fault_end", id=later) == {"result": {}}
    assert desk.ask("faults") == {"result": {"faults": []}}


def test_state_shows_supply_heat_and_light(desk: Desk) -> None:
    desk.ask("fault_begin", kind="brown_out", servo_id=2, value=5)
    desk.arm.servos[0].set(ax12a.ALARM_LED, ax12a.ErrorBit.VOLTAGE)
    state = desk.ask("state")["result"]
    assert [servo["led"] for servo in state["servos"]] == ["blinking"] + ["off"] * 5
    assert {(servo["voltage_V"], servo["temperature_degC"]) for servo in state["servos"]} == {(5.0, 30.0)}
    assert state["time_s"] == 0.0


@pytest.mark.parametrize("samples", [0, 1, 99, 100, 101, 250])
def test_truth_answers_in_pieces_that_make_one_object(desk: Desk, samples: int) -> None:
    for k in range(300):
        desk.ring.add(k * TRUTH_PERIOD_NS, desk.arm.true_positions() + 1e-3 * k)
    result = desk.ask("truth", begin_ns=10 * TRUTH_PERIOD_NS, end_ns=(10 + samples - 1) * TRUTH_PERIOD_NS)["result"]
    assert result["time_ns"] == [(10 + k) * TRUTH_PERIOD_NS for k in range(samples)]
    assert len(result["tool_m"]) == len(result["joints_rad"]) == samples
    if samples:
        first = desk.arm.true_positions() + 1e-2
        assert result["joints_rad"][0] == first.tolist()
        assert result["tool_m"][0] == desk.arm.tool_positions(first).tolist()


def test_ring_forgets_the_oldest_first() -> None:
    ring = TruthRing()
    size = TRUTH_S * NS_PER_S // TRUTH_PERIOD_NS
    assert TRUTH_S >= 900
    for k in range(size + 5):
        ring.add(k, np.array([k, -k], dtype=np.float64))
    assert [(time, joints.tolist()) for time, joints in ring.between(0, 10)] == [(k, [k, -k]) for k in range(5, 11)]
    assert len(ring.between(size + 4, 10**18)) == 1


@pytest.mark.parametrize(("line", "why"), [("[" * 5000, ""), *refusals("requests")])
def test_refusals_say_why(desk: Desk, line: str, why: str) -> None:
    answer = desk.say(line.encode())
    assert list(answer) == ["error"]
    assert why in answer["error"]
    assert not desk.arm.hand.holding


def serve(server: ControlServer, rounds: int = 20) -> None:
    for _ in range(rounds):
        readable, writable, _ = select.select(server.readers(), server.writers(), [], 0.0)
        server.serve([*readable, *writable])


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return control_path(tmp_path / "port")


def connect(path: Path) -> socket.socket:
    client = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    client.settimeout(1.0)
    client.connect(str(path))
    return client


def test_server_answers_each_line_in_order_however_it_is_cut(path: Path) -> None:
    server = ControlServer(path, lambda line: iter((line.decode(), "!")))
    with connect(path) as client:
        client.sendall(b"one\ntw")
        serve(server)
        client.sendall(b"o\n")
        serve(server)
        assert client.recv(100) == b"one!\ntwo!\n"
    serve(server)
    assert len(server.readers()) == 1
    server.close()
    assert not path.exists()


def test_endless_line_ends_the_connection_and_nothing_else(path: Path) -> None:
    server = ControlServer(path, lambda line: iter((line.decode(),)))
    with connect(path) as flood, connect(path) as client:
        serve(server)
        flood.setblocking(False)
        for _ in range(20):
            with contextlib.suppress(OSError):
                flood.send(bytes(MAX_LINE_BYTES))
            serve(server)
        assert len(server.readers()) == 2
        client.sendall(b"still here\n")
        serve(server)
        assert client.recv(100) == b"still here\n"
    server.close()


def test_client_that_leaves_before_its_answer_is_forgotten(path: Path) -> None:
    server = ControlServer(path, lambda line: iter(["x" * 100_000] * 50))
    with connect(path) as client:
        client.sendall(b"a\n")
        serve(server)
        assert len(server.writers()) == 1
    serve(server)
    assert server.writers() == []
    server.close()


def test_second_simulator_is_refused_and_a_dead_ones_socket_replaced(path: Path) -> None:
    server = ControlServer(path, lambda line: iter(()))
    with pytest.raises(PortBusy, match="another simulator"):
        ControlServer(path, lambda line: iter(()))
    server._listener.close()  # killed: the socket's file stays
    assert path.exists()
    ControlServer(path, lambda line: iter(())).close()


def test_paths_that_cannot_be_listened_on_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="107 bytes"):
        ControlServer(tmp_path / ("x" * 120), lambda line: iter(()))
    precious = tmp_path / "precious"
    precious.write_text("data")
    for path in (precious, precious / "port.control"):
        with pytest.raises(ConfigError, match="cannot listen"):
            ControlServer(path, lambda line: iter(()))
    assert precious.read_text() == "data"


def test_client_without_a_simulator_is_told_so(path: Path) -> None:
    with pytest.raises(PortMissing, match="no simulator listens"):
        SimulatorClient(path)
