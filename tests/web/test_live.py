"""The live view: what a viewer is sent equals what the daemon says."""

import json
import struct
import sys
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from websockets.sync.client import ClientConnection, connect

from armctl.cli import main
from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.errors import ArmctlError, ConfigError, NoDaemon
from armctl.host.snapshot import JOINT_KEYS, Statistics, arm_snapshot
from armctl.kinematics.transform import matrix_from_quaternion, rpy_from_matrix
from armctl.recording.cdr import schema_codec
from armctl.web import live
from tests.recording.factory import ARM, make_records
from tests.scenarios.bench import DEADLINE_S, Program, bench, simulator

MESSAGE = struct.Struct("<BIQ")
EPOCH_NS = 1_750_000_000_000_000_001


RECORD = make_records(30)[-1]  # the arm moves


def snapshot(**changes: Any) -> dict[str, Any]:
    """A daemon's snapshot of an arm that holds, as its clients get it."""
    told = arm_snapshot(ARM, RECORD, Statistics(), RECORD.inputs.now_ns + NS_PER_S // 200)
    plain: dict[str, Any] = json.loads(json.dumps(told))
    return {**plain, "arm_id": ARM.arm_id, "state": "holding", "fault": None, "faults": [], **changes}


FAULT = {"code": "HOT", "text": "servo 3 at 66 degC", "servo_id": 3, "since_s": 1.0, "arm": "", "next": ""}


# ------------------------------------------------------------------------------------------------- the encoder


def test_a_snapshot_becomes_the_messages_of_a_tick() -> None:
    data = snapshot()
    messages = dict(live.Encoder(ARM).messages(data, EPOCH_NS))
    assert json.loads(messages["/armctl/status"]["data"]) == data
    assert messages["/joint_states"]["name"] == list(ARM.joint_names)
    for told, key in (("position", "position_rad"), ("effort", "load_ratio")):
        assert messages["/joint_states"][told] == [joint[key] for joint in data["joints"]]
    assert list(messages["/tcp_pose"]["pose"]["position"].values()) == data["tool"]["position_m"]
    assert [t["child_frame_id"] for t in messages["/tf"]["transforms"]] == [f"link_{i}" for i in range(1, 7)]
    for topic in ("/joint_states", "/tcp_pose", "/diagnostics"):
        stamp = messages[topic]["header"]["stamp"]
        assert stamp["sec"] * NS_PER_S + stamp["nanosec"] == EPOCH_NS


def test_every_message_fits_the_schema_it_is_announced_with() -> None:
    encoder = live.Encoder(ARM)
    messages = [*encoder.latched(EPOCH_NS), *encoder.messages(snapshot(faults=[FAULT], state="faulted"), EPOCH_NS)]
    assert {topic for topic, _ in messages} == set(live.PUBLISHED)
    for topic, value in messages:
        codec = live.PUBLISHED[topic].codec
        assert codec.encode(codec.decode(codec.encode(value))) == codec.encode(value)


def test_a_change_of_state_and_a_fault_are_told_once() -> None:
    encoder = live.Encoder(ARM)
    said = [
        [value["msg"] for topic, value in encoder.messages(data, EPOCH_NS) if topic == "/rosout"]
        for data in [snapshot()] * 2 + [snapshot(state="faulted", faults=[FAULT])] * 2
    ]
    assert said == [
        ["STATE: first seen -> holding"],
        [],
        ["STATE: holding -> faulted", "HOT (servo 3): servo 3 at 66 degC"],
        [],
    ]


def test_what_is_not_known_is_not_sent() -> None:
    unknown = [joint | dict.fromkeys(JOINT_KEYS) for joint in snapshot()["joints"]]
    limp = snapshot(joints=unknown, tool=None, state="off")
    messages = dict(live.Encoder(ARM).messages(limp, EPOCH_NS))
    assert messages["/joint_states"]["name"] == []
    assert not {"/tf", "/tcp_pose"} & messages.keys()
    assert [status["message"] for status in messages["/diagnostics"]["status"]][1:] == ["never answered"] * 6
    starting = dict(live.Encoder(ARM).messages({**limp, "state": "starting", "tick": None}, EPOCH_NS))
    assert starting.keys() == {"/armctl/status", "/rosout"}


def test_a_servo_that_stopped_answering_is_shown_as_such() -> None:
    data = snapshot()
    data["joints"][2]["age_s"] = 3.0
    status = dict(live.Encoder(ARM).messages(data, EPOCH_NS))["/diagnostics"]["status"]
    assert (status[3]["level"], status[3]["message"]) == (1, "no reply for 3.0 s")


def test_the_daemon_of_another_arm_is_refused() -> None:
    with pytest.raises(ConfigError, match="--arm NAME"):
        live.Encoder(ARM).messages(snapshot(arm_id="other"), EPOCH_NS)


def test_without_the_package_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "foxglove", None)
    with pytest.raises(ArmctlError, match=r"armctl\[live\]"):
        live.Stream(0)


# -------------------------------------------------------------------------------------------------- the server


class Viewer:
    """What Foxglove does: take the announced channels, subscribe, decode by their schemas."""

    def __init__(self, socket: ClientConnection) -> None:
        self._socket = socket
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        while len(self.channels) < len(live.PUBLISHED):
            said = json.loads(socket.recv(timeout=10.0))
            if said["op"] == "serverInfo":
                self.info = said
            elif said["op"] == "advertise":
                self.channels |= {channel["topic"]: channel for channel in said["channels"]}
        self._topics = dict(enumerate(self.channels))

    def subscribe(self) -> None:
        wanted = [{"id": number, "channelId": self.channels[topic]["id"]} for number, topic in self._topics.items()]
        self._socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))

    def messages(self) -> Iterator[tuple[str, int, Any]]:
        """(topic, log time, message) as they come."""
        while True:
            data = self._socket.recv(timeout=10.0)
            if isinstance(data, bytes) and data[0] == 1:
                _, number, time_ns = MESSAGE.unpack_from(data)
                channel = self.channels[self._topics[number]]
                codec = schema_codec(channel["schemaName"], channel["schema"])
                yield channel["topic"], time_ns, codec.decode(data[MESSAGE.size :])


def viewer(port: int) -> ClientConnection:
    return connect(f"ws://127.0.0.1:{port}", subprotocols=["foxglove.sdk.v1"])  # type: ignore[list-item]


def test_a_taken_port_is_refused_with_a_remedy() -> None:
    with closing(live.Stream(0)) as stream, pytest.raises(ArmctlError, match="--port"):
        live.Stream(stream.port)


def test_the_server_offers_nothing_that_writes_and_announces_the_schemas_of_the_log() -> None:
    with closing(live.Stream(0)) as stream, viewer(stream.port) as socket:
        found = Viewer(socket)
    assert found.info["capabilities"] == []
    assert set(found.channels) == set(live.PUBLISHED)
    for topic, channel in found.channels.items():
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        assert channel["schemaName"] == live.PUBLISHED[topic].type


@contextmanager
def live_view(folder: Path, socket: Path) -> Iterator[int]:
    """`armctl live` as a person starts it; its port."""
    command = ("live", "--port", "0", "--socket", str(socket), "--arm", "ax12-line")
    running = Program.start(folder, "live", "-m", "armctl", *command)
    try:
        assert running.said.startswith("ready ws://127.0.0.1:")
        yield int(running.said.rpartition(":")[2])
    finally:
        running.end()


@pytest.mark.pty
def test_a_viewer_sees_what_the_daemon_says_of_the_same_tick() -> None:
    with simulator() as arm, bench(arm.port) as b:
        b.start_daemon()
        b.until(lambda now: now["tool"] is not None)
        snapshots = b.client().subscribe()
        with live_view(b.folder, b.socket) as port, viewer(port) as socket:
            found = Viewer(socket)
            found.subscribe()
            seen: dict[int, dict[str, Any]] = {}
            once: set[str] = set()
            for topic, time_ns, value in found.messages():
                if topic in ("/robot_description", "/tf_static"):
                    once.add(topic)
                    continue
                seen.setdefault(time_ns, {})[topic] = value
                if len(once) == 2 and sum("/diagnostics" in messages for messages in seen.values()) > 5:
                    break
        ticks = {
            json.loads(one["/armctl/status"]["data"])["tick"]: one for one in seen.values() if "/armctl/status" in one
        }
        compared = 0
        while compared < 3:
            now = next(snapshots)
            assert now["tick"] <= max(ticks), "the daemon and the view share no tick"
            if not {"/joint_states", "/tcp_pose"} <= ticks.get(now["tick"], {}).keys():
                continue
            compared += 1
            joints, pose = ticks[now["tick"]]["/joint_states"], ticks[now["tick"]]["/tcp_pose"]["pose"]
            for told, key in (("position", "position_rad"), ("velocity", "velocity_rad_s"), ("effort", "load_ratio")):
                assert joints[told] == [joint[key] for joint in now["joints"]]
            assert list(pose["position"].values()) == now["tool"]["position_m"]
            R = matrix_from_quaternion(tuple(pose["orientation"].values()))
            assert rpy_from_matrix(R) == pytest.approx(tuple(now["tool"]["rpy_rad"]), abs=1e-9)
        assert -1.0 < ((time.time_ns() - max(seen)) / NS_PER_S) < DEADLINE_S


class Restarted(Client):
    """A daemon that ends after one snapshot, and is back; the person leaves then."""

    connections = 0

    def __init__(self, *_: object) -> None:
        Restarted.connections += 1

    def close(self) -> None: ...

    def subscribe(self) -> Iterator[dict[str, Any]]:
        yield snapshot()
        raise NoDaemon("it closed the connection") if Restarted.connections == 1 else KeyboardInterrupt


def test_a_daemon_that_was_restarted_is_found_again(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(live, "Client", Restarted)
    said: list[str] = []
    ports: list[int] = []
    with pytest.raises(KeyboardInterrupt):
        live.serve(None, ARM, 0, ports.append, said.append)
    assert said == ["it closed the connection; waiting for it", "the daemon is back"]
    assert len(ports) == 1


def test_a_layout_is_written_and_never_over_another_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "layout.json"
    assert main(["live", "--layout", str(path), "--json"]) == 0
    layout = json.loads(path.read_text())
    assert json.loads(capsys.readouterr().out) == {"layout": str(path)}

    def panels(node: Any) -> set[str]:
        return {node} if isinstance(node, str) else panels(node["first"]) | panels(node["second"])

    assert panels(layout["layout"]) <= layout["configById"].keys()
    assert main(["live", "--layout", str(path)]) == 1
    assert json.loads(path.read_text()) == layout
