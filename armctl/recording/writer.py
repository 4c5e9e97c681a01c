"""One log file, written so that a kill at any moment costs at most what came after the last flush.

Rules.
1. The file is PATH.part while it is written, and becomes PATH when it is closed; PATH is never replaced.
2. All schemas and channels stand in the first chunk, and once more in an attachment before it: if that chunk
   is damaged the others can still be read.
3. `flush` ends the chunk and syncs the data to the disk; the first one also the folder that names the file.
4. A file opens alone: description, calibration, configuration, static transforms and a keyframe come first.
5. The part is locked while it is written, so that nobody recovers it under its writer.
"""

import json
import os
import platform
from collections.abc import Callable, Iterable, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import yaml
from mcap.records import Attachment

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig, Config
from armctl.errors import LogError
from armctl.kinematics.robots.robot import Robot
from armctl.kinematics.urdf import urdf
from armctl.messages import Event, TickRecord
from armctl.recording import channels, provenance
from armctl.recording.channels import TOPICS, Anchor, Message, Row, TickEncoder
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import DISK, PART, Disk, publish, writing
from armctl.recording.schemas import schema_text

# Attachment: schemas, channels and everything of the metadata record, with a checksum over it.
SEED = "armctl.json"
DIAGNOSTICS_PERIOD_NS = NS_PER_S


class LogContext(NamedTuple):
    """What every file of one daemon has in common."""

    arm: ArmConfig
    robot: Robot
    config: Config
    port: str
    period_s: float
    # Firmware versions of the servos in joint order; empty while they are not known.
    firmware: tuple[int, ...] = ()


class LogWriter:
    """One MCAP file; for one thread.

    Args:
        path: Final name.
        previous: Name of the file before this one.
        anchor: Clock anchor of the file; now, if none is given.
        disk: Where the file goes.
    Raises:
        LogError: the name is taken, or the file cannot be written. After an error of any method the only
            thing left to do is `abandon`.
    """

    def __init__(
        self, path: Path, context: LogContext, *, previous: str = "", anchor: Anchor | None = None, disk: Disk = DISK
    ) -> None:
        self.path, self.part = path, path.with_name(path.name + PART)
        self.context = context
        self.anchor = anchor or Anchor.now()
        self.begin_ns = self.anchor.monotonic_ns
        self._disk = disk
        self._encoder = TickEncoder()
        self._keyframe = ""
        self._inputs_only: Sequence[TickRecord] = ()
        self._begun = self._named = False
        self._sequence = 0
        self._diagnosed: tuple[object, ...] = ()
        if path.exists():
            raise LogError(f"{path}: exists already; choose another name, nothing is overwritten")
        with writing(self.part):
            path.parent.mkdir(parents=True, exist_ok=True)
            self._stream = disk.create(self.part)
        try:
            with writing(self.part):
                self._writer = ChunkWriter(self._stream)
                self._channels = self._head(previous)
                self._stream.flush()
                self._head_bytes = self._writer.offset
        except LogError:
            self.abandon()
            with suppress(OSError):  # a disk that cannot do this either: the next start sets the part aside
                disk.remove(self.part)
            raise

    @property
    def size_bytes(self) -> int:
        """What has gone to the file since its head."""
        return self._writer.offset - self._head_bytes

    @property
    def in_place(self) -> bool:
        """Whether the part is still where it was begun."""
        try:
            return os.path.samestat(os.fstat(self._stream.fileno()), os.stat(self.part))
        except (FileNotFoundError, NotADirectoryError):
            return False
        except OSError:  # nobody can tell
            return True

    def begin(self, keyframe: str, inputs_only: Sequence[TickRecord] = ()) -> None:
        """Say before the first tick where a replay can begin.

        Args:
            keyframe: State of the control step (JSON) before the first tick that is written; empty: not known.
            inputs_only: Ticks between the keyframe and the file's own beginning. Only their inputs are written, so
                that a replay can begin at the keyframe although the file begins later.
        """
        assert not self._begun
        self._keyframe, self._inputs_only = keyframe, inputs_only

    def write_tick(self, record: TickRecord) -> None:
        """Every message of one tick."""
        anchor, arm, time_ns = self.anchor, self.context.arm, record.inputs.sample.time_ns
        epoch_ns = anchor.epoch_ns(time_ns)
        with writing(self.part):
            self._begin(time_ns)
            self._add_inputs(epoch_ns, record)
            self._add(epoch_ns, *channels.output_rows(record, anchor, arm, self.context.robot))
            self._add(epoch_ns, *channels.event_messages(record, anchor, arm))
            if record.dropped:
                text = f"{record.dropped} tick records were lost before tick {record.inputs.tick}"
                self.write_event(Event("warning", "DROPPED", text), time_ns)
            now = (time_ns // DIAGNOSTICS_PERIOD_NS, record.outputs.mode, record.outputs.faults)
            if now != self._diagnosed:
                self._diagnosed = now
                self._add(epoch_ns, channels.diagnostics(record, anchor, arm))
            self._add(epoch_ns, channels.cycle_row(record, anchor))
            if record.keyframe:
                self._add(epoch_ns, channels.string_message(channels.STATE, record.keyframe))

    def write_wire(self, pieces: Iterable[tuple[int, bool, bytes]], time_ns: int) -> None:
        """What went over the wire up to a tick (see `channels.wire_message`), behind it."""
        self._say(time_ns, lambda epoch_ns: channels.wire_message(pieces, epoch_ns))

    def write_note(self, text: str, time_ns: int) -> None:
        """A note (JSON) on /armctl/command, at a monotonic time."""
        self._say(time_ns, lambda _: channels.string_message(channels.COMMAND, text))

    def write_event(self, event: Event, time_ns: int) -> None:
        """A line of the recorder's own on /rosout, at a monotonic time."""
        self._say(time_ns, lambda epoch_ns: (channels.ROSOUT, channels.log_line(event, epoch_ns, channels.RECORDING)))

    def flush(self) -> None:
        """End the chunk, and return when its data are on the disk."""
        with writing(self.part):
            self._writer.end_chunk()
            self._sync()

    def close(self) -> None:
        """Finish the file and give it its final name; without an effect once that is done.

        Raises:
            LogError: it cannot be finished, or the name was taken meanwhile.
        """
        if self._stream.closed:
            return
        with writing(self.part):
            self._begin(self.begin_ns)
            self._writer.finish()
            self._sync()
            publish(self.part, self.path, self._disk)
            self._stream.close()

    def _sync(self) -> None:
        self._disk.sync(self._stream)
        if not self._named:
            self._disk.sync_folder(self.path.parent)
            self._named = True

    def abandon(self) -> None:
        """Let go of a file that can no longer be written; the part stays, to be recovered."""
        # What Python still buffers is after the last flush: it may not fit any more, and is given up.
        try:
            self._stream.close()
        except OSError:
            self._stream.raw.close()

    def _head(self, previous: str) -> dict[str, int]:
        context = self.context
        writer, now_ns = self._writer, self.anchor.wall_ns
        facts = {
            **provenance.program(),
            **provenance.clock(),
            "host": platform.node(),
            "port": context.port,
            "simulated": str(provenance.simulated(context.port)).lower(),
            "arm_id": context.arm.arm_id,
            "firmware": " ".join(map(str, context.firmware)),
            "calibration_hash": context.arm.calibration_hash,
            "period_s": repr(context.period_s),
            "anchor_wall_ns": str(self.anchor.wall_ns),
            "anchor_monotonic_ns": str(self.anchor.monotonic_ns),
            "previous": previous,
        }
        schemas: dict[str, int] = {}
        ids: dict[str, int] = {}
        for topic in TOPICS.values():
            if topic.type not in schemas:
                schemas[topic.type] = writer.add_schema(topic.type, "ros2msg", schema_text(topic.type).encode())
            ids[topic.name] = writer.add_channel(topic.name, "cdr", schemas[topic.type], topic.metadata)
        seed = {
            "armctl": facts,
            "robot": {"name": context.robot.name, "lengths_m": context.robot.lengths_m},
            "schemas": [{"id": number, "name": name, "text": schema_text(name)} for name, number in schemas.items()],
            "channels": [
                {"id": ids[topic.name], "topic": topic.name, "schema": schemas[topic.type], "metadata": topic.metadata}
                for topic in TOPICS.values()
            ],
        }
        self._description = urdf(context.arm, context.robot)
        for name, media_type, text in (
            (SEED, "application/json", json.dumps(seed, separators=(",", ":"))),
            ("robot.urdf", "application/xml", self._description),
            ("config.yaml", "application/yaml", _yaml(context.config.model_dump(mode="json"))),
            ("calibration.yaml", "application/yaml", _yaml(context.arm.model_dump(mode="json"))),
        ):
            writer.add_attachment(Attachment(now_ns, now_ns, name, media_type, text.encode()))
        writer.add_metadata("armctl", facts)
        return ids

    def _begin(self, time_ns: int) -> None:
        """Once, before the first message: what makes the file complete in itself."""
        if self._begun:
            return
        self._begun = True
        self.begin_ns = time_ns
        epoch_ns = self.anchor.epoch_ns(time_ns)
        self._add(epoch_ns, channels.string_message(channels.ROBOT_DESCRIPTION, self._description))
        self._add(epoch_ns, channels.static_transforms(epoch_ns, self.context.arm, self.context.robot))
        if self._keyframe:
            self._add(epoch_ns, channels.string_message(channels.STATE, self._keyframe))
        for record in self._inputs_only:
            # At the time the file begins: who plays it is not to wait for what is not its own.
            self._add_inputs(epoch_ns, record)
            self._add(epoch_ns, channels.cycle_row(record, self.anchor, inputs_only=True))
        self._inputs_only = ()
        self._writer.end_chunk()
        self._head_bytes = self._writer.offset

    def _say(self, time_ns: int, message: Callable[[int], Message]) -> None:
        """Add a message between those of ticks, made of its epoch time."""
        epoch_ns = self.anchor.epoch_ns(time_ns)
        with writing(self.part):
            self._begin(time_ns)
            self._add(epoch_ns, message(epoch_ns))

    def _add_inputs(self, epoch_ns: int, record: TickRecord) -> None:
        """What the control step saw in a tick: servos, then commands in their order."""
        self._sequence = record.inputs.tick & 0xFFFFFFFF
        self._add(epoch_ns, channels.servos_row(record, self.anchor, self.context.arm))
        self._add(epoch_ns, *channels.command_messages(record))

    def _add(self, epoch_ns: int, *messages: Row | Message) -> None:
        for message in messages:
            data = self._encoder.encode(message)
            self._writer.add_message(self._channels[message[0]], epoch_ns, self._sequence, data)


def _yaml(data: dict[str, Any]) -> str:
    return yaml.safe_dump(data, sort_keys=False, allow_unicode=True)
