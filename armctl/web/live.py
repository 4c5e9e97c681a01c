"""The daemon's snapshots as a stream that Foxglove, Lichtblick and PlotJuggler read.

Rules.
1. A process of its own, a client of the daemon's socket: it never touches the serial port, and whatever happens to
   it, the arm does not notice.
2. It listens on the loopback interface only and takes nothing: no capability is offered that would write.
3. Topics, types and bytes are the log's, made by the same functions. What a snapshot does not tell is not sent:
   raw registers, goals and requests stand in the log only. `/armctl/status` carries the whole snapshot as JSON.
4. A message's time is when the daemon had sampled, by this machine's wall clock.
"""

from __future__ import annotations

import json
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import closing, suppress
from typing import TYPE_CHECKING, Any

import numpy as np

from armctl.client import Client
from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.errors import ArmctlError, ConfigError, NoDaemon
from armctl.host.snapshot import JOINT_KEYS
from armctl.kinematics import robots
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.transform import quaternion_from_matrix
from armctl.kinematics.urdf import moving_frames, urdf
from armctl.messages import Event, Fault, Inputs, JointState, Mode, Outputs, Sample, ServoReading, TickRecord, ToolPose
from armctl.recording import channels
from armctl.recording.schemas import full_name, schema_text, short_name

if TYPE_CHECKING:
    from foxglove import Channel
    from foxglove.websocket import ChannelView
    from foxglove.websocket import Client as Viewer

HOST = "127.0.0.1"
RETRY_S = 1.0
STATUS = channels.Topic("/armctl/status", full_name("std_msgs/String"))
SOURCE = "armctl.live"
STALE_S = 0.2
_TOLD = (
    channels.JOINT_STATES, channels.TF, channels.TF_STATIC, channels.TCP_POSE, channels.DIAGNOSTICS, channels.ROSOUT,
    channels.ROBOT_DESCRIPTION,
)  # fmt: skip
# Every topic of the stream.
PUBLISHED: dict[str, channels.Topic] = {**{name: channels.TOPICS[name] for name in _TOLD}, STATUS.name: STATUS}


class Encoder:
    """Snapshots to messages of the log; for one daemon.

    Args:
        arm: The calibration the daemon runs with: frames and description come from it.
    """

    def __init__(self, arm: ArmConfig) -> None:
        self._arm = arm
        self._robot: Robot = robots.get(arm.robot, arm.lengths_m)
        self._state = ""
        self._faults: list[Event] = []

    def latched(self, epoch_ns: int) -> list[channels.Message]:
        """What a viewer needs once: the description and the frames that do not move."""
        description = channels.string_message(channels.ROBOT_DESCRIPTION, urdf(self._arm, self._robot))
        return [description, channels.static_transforms(epoch_ns, self._arm, self._robot)]

    def messages(self, snapshot: dict[str, Any], epoch_ns: int) -> list[channels.Message]:
        """Everything one snapshot says.

        Args:
            epoch_ns: When it was sampled.
        Raises:
            ConfigError: it is of another arm than this encoder's.
        """
        self._check(snapshot)
        events: list[Event] = []
        if snapshot["state"] != self._state:
            events.append(Event("info", "STATE", f"{self._state or 'first seen'} -> {snapshot['state']}"))
        faults = [Event("error", fault["code"], fault["text"], fault["servo_id"]) for fault in snapshot["faults"]]
        events += [fault for fault in faults if fault not in self._faults]
        self._state, self._faults = snapshot["state"], faults
        messages = [channels.string_message(STATUS.name, json.dumps(snapshot, allow_nan=False))]
        if snapshot["state"] in set(Mode) and snapshot["tick"] is not None:  # else nothing is known of the arm yet
            record, anchor = self._record(snapshot), channels.Anchor(epoch_ns, 0)
            rows = channels.output_rows(record, anchor, self._arm, self._robot)
            messages += [(row.topic, row.value()) for row in rows if row.topic in PUBLISHED]
            messages.append(channels.diagnostics(record, anchor, self._arm))
        messages += [(channels.ROSOUT, channels.log_line(event, epoch_ns, SOURCE)) for event in events]
        return messages

    def _check(self, snapshot: dict[str, Any]) -> None:
        servos = [(joint["name"], joint["servo_id"]) for joint in snapshot["joints"]]
        if snapshot["arm_id"] != self._arm.arm_id or servos != [(j.name, j.servo_id) for j in self._arm.joints]:
            problem = f"is not the arm of the daemon, {snapshot['arm_id']}"
            raise ConfigError(self._arm.arm_id, "", problem, "name its calibration with --arm NAME|FILE")

    def _record(self, snapshot: dict[str, Any]) -> TickRecord:
        """The tick a snapshot is of, as far as it tells."""
        joints = tuple(_joint(joint) for joint in snapshot["joints"])
        readings = tuple(
            ServoReading(servo.servo_id, b"", 0, joints[servo.of].age_s < STALE_S, problem=_problem(joints[servo.of]))
            for servo in self._arm.servos
        )
        outputs = Outputs(
            mode=Mode(snapshot["state"]),
            faults=tuple(Fault(fault["code"], fault["text"], 0, fault["servo_id"]) for fault in snapshot["faults"]),
            joints=joints,
            tool=self._tool(snapshot, joints),
        )
        return TickRecord(Inputs(snapshot["tick"] or 0, 0, Sample(0, readings)), outputs)

    def _tool(self, snapshot: dict[str, Any], joints: tuple[JointState, ...]) -> ToolPose | None:
        if snapshot["tool"] is None:
            return None
        q = np.array([joint.position_rad for joint in joints])
        turn = moving_frames(self._arm, self._robot, q)[self._robot.chain.n - 1][:3, :3]
        x, y, z = snapshot["tool"]["position_m"]
        return ToolPose((x, y, z), quaternion_from_matrix(turn))


def _joint(joint: dict[str, Any]) -> JointState:
    if joint["position_rad"] is None:
        return JointState(False, 0.0, 0.0, 0.0, 0.0, 0.0, False, 0.0)
    return JointState(known=True, **{key: joint[key] for key in JOINT_KEYS})


def _problem(state: JointState) -> str:
    return "" if not state.known or state.age_s < STALE_S else f"no reply for {state.age_s:.1f} s"


class Stream:
    """The WebSocket server.

    Args:
        port: 0: any that is free.
    Raises:
        ArmctlError: foxglove-sdk is missing, or the port is taken.
    """

    def __init__(self, port: int) -> None:
        try:
            import foxglove
            from foxglove.websocket import ServerListener
        except ImportError:
            raise ArmctlError("the live view needs foxglove-sdk; install it with: pip install 'armctl[live]'") from None
        # Filled by a thread of the SDK.
        wanted = self._wanted = deque[str]()

        class Listener(ServerListener):
            def on_subscribe(self, client: Viewer, channel: ChannelView) -> None:
                wanted.append(channel.topic)

        context = self._context = foxglove.Context()  # kept: channels of a context that is gone are not announced
        self._channels: dict[str, Channel] = {}
        for topic in PUBLISHED.values():
            text = schema_text(short_name(topic.type)).encode()
            schema = foxglove.Schema(name=topic.type, encoding="ros2msg", data=text)
            self._channels[topic.name] = foxglove.Channel(
                topic.name, schema=schema, message_encoding="cdr", metadata=topic.metadata, context=context
            )
        try:
            self._server = foxglove.start_server(
                name="armctl", host=HOST, port=port, capabilities=[], server_listener=Listener(), context=context
            )
        except (OSError, RuntimeError) as error:
            raise ArmctlError(f"{HOST}:{port}: cannot listen there: {error}; choose another with --port") from None
        self.port: int = self._server.port

    def send(self, messages: list[channels.Message], epoch_ns: int) -> None:
        """Hand messages to every viewer that asked for their topics."""
        for topic, value in messages:
            self._channels[topic].log(PUBLISHED[topic].codec.encode(value), log_time=epoch_ns)

    def newly_wanted(self) -> set[str]:
        """Topics somebody has subscribed to since the last call."""
        return {self._wanted.popleft() for _ in range(len(self._wanted))}

    def close(self) -> None:
        self._server.stop()


def publish(stream: Stream, arm: ArmConfig, snapshots: Iterator[dict[str, Any]]) -> None:
    """Pass snapshots on until there are no more.

    Raises:
        ConfigError: they are of another arm.
        NoDaemon: the daemon ended.
    """
    encoder = Encoder(arm)
    for snapshot in snapshots:
        epoch_ns = time.time_ns() - round((snapshot["age_s"] or 0.0) * NS_PER_S)
        wanted = stream.newly_wanted()
        stream.send([message for message in encoder.latched(epoch_ns) if message[0] in wanted], epoch_ns)
        stream.send(encoder.messages(snapshot, epoch_ns), epoch_ns)


def serve(
    socket: str | None, arm: ArmConfig, port: int, ready: Callable[[int], None], say: Callable[[str], None]
) -> None:
    """Pass the daemon's snapshots on until interrupted; a daemon that was restarted is found again.

    Args:
        ready: Called with the port once viewers can connect.
        say: Tells a person what happened.
    Raises:
        NoDaemon: none answers at the beginning.
        ArmctlError: as `Stream` and `publish`.
    """
    client = Client(socket)
    with closing(Stream(port)) as stream:
        ready(stream.port)
        while True:
            try:
                with client:
                    publish(stream, arm, client.subscribe())
            except NoDaemon as error:
                say(f"{error}; waiting for it")
            client = _reconnected(socket)
            say("the daemon is back")


def _reconnected(socket: str | None) -> Client:
    while True:
        with suppress(NoDaemon):
            return Client(socket)
        time.sleep(RETRY_S)
