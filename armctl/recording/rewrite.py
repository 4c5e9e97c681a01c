"""A log's messages into a new file, byte for byte: what recovery, compaction, trimming and merging have in common."""

from collections.abc import Iterable

from armctl.clock import NS_PER_S
from armctl.recording.cdr import Value
from armctl.recording.chunks import ChunkWriter
from armctl.recording.log_file import LogFile, LogMessage
from armctl.recording.replay import RECOVERED


class Rewrite:
    """Messages of one log, or of several alike, into a new file; its head is written at once.

    Args:
        name, facts: A metadata record that says what was done; the log's own of that name is not taken over.
    """

    def __init__(self, log: LogFile, writer: ChunkWriter, name: str = "", facts: dict[str, str] | None = None) -> None:
        # Number of messages written so far.
        self.messages = 0
        self._begin_ns, self._end_ns = 2**64, 0
        self._log, self._writer = log, writer
        self._channels: dict[str, int] = {}
        self._schemas: dict[int, int] = {}
        self._kept = {name, RECOVERED}
        self._register()
        self.keep()
        self._kept.discard(RECOVERED)  # true of a log's end: of several logs the last one's stands, at the end
        if facts is not None:
            writer.add_metadata(name, facts)

    def follow(self, log: LogFile) -> None:
        """Go on with the messages of another log."""
        self._log, self._schemas = log, {}

    def add(self, messages: Iterable[LogMessage]) -> int:
        """Messages of the log, as they are; how many the new file holds."""
        for message in messages:
            if message.topic not in self._channels:
                self._register()
            self._add(message.topic, message.data, message)
        return self.messages

    def say(self, topic: str, value: Value, at: LogMessage) -> None:
        """A message of the new file's own, at the time of another."""
        self._add(topic, self._log.codec(topic).encode(value), at)

    def keep(self) -> None:
        """Attachments and metadata that the log has shown so far and the new file does not have."""
        for attachment in self._log.attachments.values():
            if attachment.name not in self._kept:
                self._writer.add_attachment(attachment)
        for name, facts in self._log.metadata.items():
            if name not in self._kept:
                # A metadata record has no checksum of its own; the seed, which says the same of our files, has.
                self._writer.add_metadata(name, self._log.facts if name == "armctl" else facts)
        self._kept |= {*self._log.attachments, *self._log.metadata}

    @property
    def duration_s(self) -> float:
        return max(0, self._end_ns - self._begin_ns) / NS_PER_S

    def _add(self, topic: str, data: bytes, at: LogMessage) -> None:
        self._writer.add_message(self._channels[topic], at.log_time_ns, at.sequence, data)
        self._begin_ns, self._end_ns = min(self._begin_ns, at.log_time_ns), max(self._end_ns, at.log_time_ns)
        self.messages += 1

    def _register(self) -> None:
        """Channels of the log that the new file does not have yet, in their order, so that they keep their numbers."""
        for channel in self._log.channels.values():
            if channel.topic in self._channels:
                continue
            schema = self._log.schemas.get(channel.schema_id)
            if schema is not None and schema.id not in self._schemas:
                self._schemas[schema.id] = self._writer.add_schema(schema.name, schema.encoding, schema.data)
            about = channel.message_encoding, self._schemas.get(channel.schema_id, 0), channel.metadata
            self._channels[channel.topic] = self._writer.add_channel(channel.topic, *about)
