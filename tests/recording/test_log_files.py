"""Files: written, cut, damaged, read, recovered, replayed."""

import errno
import json
import os
import random
from collections import Counter
from contextlib import suppress
from io import BufferedWriter
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap.writer import CompressionType
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from armctl.config import ArmConfig, Config, parse_yaml, validate
from armctl.control.step import step
from armctl.errors import LogError
from armctl.messages import Event, Inputs, Outputs
from armctl.recording import reader, recordings
from armctl.recording.channels import TOPICS
from armctl.recording.chunks import ChunkWriter
from armctl.recording.disk import Disk, PartInUse, new_file, publish
from armctl.recording.log_file import LogFile
from armctl.recording.recover import recover, recover_folder
from armctl.recording.replay import check, log_setup
from armctl.recording.writer import LogWriter
from tests.recording.altered import without_first_joint
from tests.recording.factory import ANCHOR, ARM, CONTEXT, PERIOD_S, ROBOT, make_records, times_s
from tests.recording.logs import add_string_channel, foreign, messages, write
from tests.recording.refusals import cannot
from tests.recording.rig import failing

RECORDS = make_records(100, keyframe_ticks=40)


# ------------------------------------------------------------------------------------------------ whole files


def test_rosbags_plays_static_topics_to_those_who_come_late(log: Path) -> None:
    with AnyReader([log]) as bag:
        offered: dict[str, Any] = {c.topic: c.ext.offered_qos_profiles[0] for c in bag.connections}  # type: ignore[union-attr]
    qos = {topic: (profile.durability.name, profile.reliability.name) for topic, profile in offered.items()}
    late = dict.fromkeys(("/tf_static", "/robot_description"), ("TRANSIENT_LOCAL", "RELIABLE"))
    assert qos == dict.fromkeys(TOPICS, ("VOLATILE", "RELIABLE")) | late


def test_mcap_reads_every_message_with_checksums(log: Path) -> None:
    with log.open("rb") as stream:
        stock = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
        assert stock.get_header().profile == "ros2"
        found = [(c.topic, m.log_time, m.sequence, m.data) for _, c, m in stock.iter_messages(log_time_order=False)]
        decoded = sum(1 for _ in stock.iter_decoded_messages())
        assert [a.name for a in stock.iter_attachments()][1:] == ["robot.urdf", "config.yaml", "calibration.yaml"]
        assert [m.name for m in stock.iter_metadata()] == ["armctl"]
    assert found == [tuple(message) for message in messages(log)]
    assert decoded == len(found)


def test_log_time_sequence_and_header_belong_to_the_tick(log: Path) -> None:
    for message in reader.read(log):
        if "header" in message.value:
            stamp = message.value["header"]["stamp"]
            assert stamp["sec"] * 10**9 + stamp["nanosec"] == message.log_time_ns
            assert message.log_time_ns == ANCHOR.epoch_ns(RECORDS[message.sequence].inputs.sample.time_ns)


def test_every_input_can_be_rebuilt_from_the_log(log: Path) -> None:
    seen: list[Inputs] = []

    def note(state: Any, inputs: Inputs, arm: ArmConfig, robot: Any, period_s: float) -> tuple[Any, Outputs]:
        seen.append(inputs)
        return step(state, inputs, arm, robot, period_s)

    check(log, step=note)
    assert seen == [record.inputs for record in RECORDS]


def test_the_file_says_what_it_is_a_log_of(log: Path) -> None:
    with LogFile(log) as file:
        setup, facts = log_setup(file), file.facts
        assert file.metadata["armctl"] == facts
        assert (facts["arm_id"], facts["calibration_hash"]) == (ARM.arm_id, ARM.calibration_hash)
        config = validate(Config, parse_yaml(file.text("config.yaml"), "config"), "config")
    assert (setup.arm, setup.arm.calibration_hash) == (ARM, ARM.calibration_hash)
    assert (setup.robot.lengths_m, setup.period_s, setup.anchor) == (ROBOT.lengths_m, PERIOD_S, ANCHOR)
    assert config == CONTEXT.config


def test_static_topics_come_once_and_first(log: Path) -> None:
    topics = [message.topic for message in messages(log)]
    assert topics[:2] == ["/robot_description", "/tf_static"]
    assert topics.count("/robot_description") == topics.count("/tf_static") == 1


def test_diagnostics_come_at_1_hz_and_on_change(log: Path) -> None:
    changes = sum(a.outputs.mode != b.outputs.mode for a, b in pairwise(RECORDS))
    assert changes == 4
    assert 10 + changes - 4 <= reader.info(log).topics["/diagnostics"] <= 10 + changes


def test_joint_states_come_as_arrays(log: Path) -> None:
    track = recordings.load(log)
    assert track.joint_names == ARM.joint_names
    np.testing.assert_allclose(track.time_s, times_s(RECORDS), atol=1e-9)
    expected = [[joint.position_rad for joint in record.outputs.joints] for record in RECORDS]
    np.testing.assert_array_equal(track.positions_rad, expected)


def test_ticks_in_which_a_joint_was_unknown_are_left_out_of_the_arrays(tmp_path: Path) -> None:
    track = recordings.load(write(tmp_path / "a.mcap", [without_first_joint(RECORDS[0]), *RECORDS[1:]]))
    assert track.positions_rad.shape == (99, 6)


def test_a_file_without_ticks_is_a_log_all_the_same(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", [])
    assert set(reader.info(path).topics) == {"/robot_description", "/tf_static"}
    cannot(recordings.load, path, why="no joint states")
    cannot(check, path, why="no keyframe")


def test_a_note_is_kept_and_disturbs_no_replay_and_closing_twice_is_harmless(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", CONTEXT, anchor=ANCHOR)
    for record in RECORDS:
        writer.write_note(json.dumps({"request": record.inputs.tick}), record.inputs.now_ns)
        writer.write_event(Event("info", "NOTE", "by the recorder"), record.inputs.now_ns)
        writer.write_tick(record)
    writer.close()
    writer.close()
    assert [*tmp_path.iterdir()] == [writer.path]
    assert check(writer.path).mismatches == 0
    assert '{"request": 0}' in [m.value["data"] for m in reader.read(writer.path, ["/armctl/command"])]


# -------------------------------------------------------------------------------------------------- the writer


def test_an_existing_file_is_never_overwritten(tmp_path: Path, log: Path) -> None:
    for name in ("a.mcap", "a.mcap.part"):
        taken = tmp_path / name
        taken.write_bytes(b"mine")
        cannot(LogWriter, tmp_path / "a.mcap", CONTEXT, why=r"a\.mcap")
        assert taken.read_bytes() == b"mine"
        taken.unlink()


def test_a_name_taken_meanwhile_keeps_both(tmp_path: Path) -> None:
    writer = LogWriter(tmp_path / "a.mcap", CONTEXT, anchor=ANCHOR)
    writer.write_tick(RECORDS[0])
    writer.path.write_bytes(b"mine")
    cannot(writer.close, why="appeared meanwhile")
    writer.abandon()
    assert writer.path.read_bytes() == b"mine"
    assert reader.info(writer.part).complete


def test_file_systems_without_links_get_the_file_too(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "link", failing(errno.EPERM))
    assert reader.info(write(tmp_path / "a.mcap", RECORDS[:5])).complete
    (tmp_path / "b.part").write_bytes(b"")
    with pytest.raises(OSError, match="not permitted"):
        publish(tmp_path / "b.part", tmp_path / "a.mcap")


def test_where_no_file_or_no_head_can_be_written_nothing_is_left(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_bytes(b"")
    cannot(LogWriter, tmp_path / "file" / "a.mcap", CONTEXT, why="cannot be written")
    monkeypatch.setattr(ChunkWriter, "add_metadata", failing(errno.ENOSPC))
    cannot(LogWriter, tmp_path / "a.mcap", CONTEXT, why="No space left")
    assert [*tmp_path.iterdir()] == [tmp_path / "file"]


# ------------------------------------------------------------------------------------------------ cut, damaged


def test_any_bytes_behind_the_magic_are_read_or_are_a_log_error(tmp_path: Path, log: Path) -> None:
    rng = random.Random(3)
    head = log.read_bytes()[:40_000]
    path = tmp_path / "noise.mcap"
    for _ in range(60):
        noise = bytearray(head)
        for _ in range(rng.randrange(1, 40)):
            at, length = rng.randrange(8, len(noise)), rng.randrange(1, 30)
            noise[at : at + length] = rng.randbytes(length)
        path.write_bytes(noise)
        for attempt in (reader.info, check, recordings.load, lambda p: list(reader.read(p))):
            with suppress(LogError):
                attempt(path)


@pytest.mark.parametrize("content", [b"", b"not a log at all", b"\x89MCAP0\r"])
def test_what_is_no_log_or_missing_is_a_log_error(tmp_path: Path, content: bytes) -> None:
    path = tmp_path / "x.mcap"
    path.write_bytes(content)
    cannot(reader.info, path, why=r"x\.mcap")
    for act in (reader.info, recover):
        cannot(act, tmp_path / "none.mcap", why="No such file")


@pytest.mark.parametrize("compression", list(CompressionType))
def test_logs_of_others_are_read_by_their_own_schemas(tmp_path: Path, compression: CompressionType) -> None:
    path = tmp_path / "foreign.mcap"
    with foreign(path, compression) as writer:
        writer.add_message(add_string_channel(writer), 5, b"\x00\x01\x00\x00\x02\x00\x00\x00a\x00", 5)
    (message,) = reader.read(path)
    assert message == ("/chatter", 5, 0, {"data": "a"})
    assert reader.info(path).complete
    cannot(check, path, why="not written by armctl")
    cannot(recordings.load, path, why="no joint states")
    cannot(LogFile(path).codec, "/other", why="no topic /other")
    assert reader.info(recover(path).path).messages == 1


def test_encodings_armctl_does_not_know_are_a_log_error(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with foreign(path) as writer:
        writer.add_message(writer.register_channel("/json", "json", 0), 5, b"{}", 5)
        bad = writer.register_schema("std_msgs/msg/String", "ros2msg", b"\xff")
        writer.add_message(writer.register_channel("/bad", "cdr", bad), 5, b"{}", 5)
    assert reader.info(path).topics == {"/json": 1, "/bad": 1}
    cannot(list, reader.read(path, ["/json"]), why="ros2msg schema")
    cannot(list, reader.read(path, ["/bad"]), why="damaged")


def test_messages_outside_chunks_are_not_trusted(tmp_path: Path) -> None:
    path = tmp_path / "foreign.mcap"
    with foreign(path, use_chunking=False) as writer:
        writer.add_message(writer.register_channel("/json", "json", 0), 5, b"{}", 5)
    assert (reader.info(path).messages, reader.info(path).complete) == (0, False)


@pytest.mark.parametrize("replacing", [False, True])
def test_a_file_that_another_process_is_making_is_left_to_it(tmp_path: Path, replacing: bool) -> None:
    path = tmp_path / "a.csv"
    with new_file(path, replacing=replacing) as stream:
        stream.write(b"theirs")
        with (
            pytest.raises(PartInUse, match=r"a\.csv\.unfinished: is being written"),
            new_file(path, replacing=replacing),
        ):
            pass
    assert [(file.name, file.read_bytes()) for file in tmp_path.iterdir()] == [("a.csv", b"theirs")]


class TakenBefore(Disk):
    """Another process is quicker to make the unfinished file."""

    def create(self, path: Path) -> BufferedWriter:
        path.write_bytes(b"theirs")
        return super().create(path)


class TakenAfter(Disk):
    """Another process begins the same file as soon as this one has its name."""

    def replace(self, old: Path, new: Path) -> None:
        super().replace(old, new)
        old.write_bytes(b"theirs")


@pytest.mark.parametrize(("disk", "made"), [(TakenBefore(), b"before"), (TakenAfter(), b"mine")])
def test_an_unfinished_file_that_another_process_made_meanwhile_stays(tmp_path: Path, disk: Disk, made: bytes) -> None:
    path = tmp_path / "a.csv"
    path.write_bytes(b"before")
    with suppress(LogError), new_file(path, disk, replacing=True) as stream:
        stream.write(b"mine")
    assert (path.read_bytes(), (tmp_path / "a.csv.unfinished").read_bytes()) == (made, b"theirs")


# ---------------------------------------------------------------------------------------------------- recovery


def test_the_start_recovers_every_part_but_those_being_written(tmp_path: Path, log: Path) -> None:
    (tmp_path / "a.mcap.part").write_bytes(log.read_bytes()[:-100])
    (tmp_path / "a.mcap").write_bytes(b"taken")
    (tmp_path / "empty.mcap.part").write_bytes(b"")
    (tmp_path / "link.mcap.part").symlink_to(log)
    live = LogWriter(tmp_path / "live.mcap", CONTEXT, anchor=ANCHOR)
    live.write_tick(RECORDS[0])
    with pytest.raises(PartInUse, match="being written"):
        recover(live.part)
    recover_folder(tmp_path)
    names = ["a-recovered.mcap", "a.mcap", "empty.mcap.part.broken", "link.mcap.part", "live.mcap.part"]
    assert sorted(p.name for p in tmp_path.iterdir()) == names
    live.close()
    recover_folder(tmp_path / "nowhere")


def stock(path: Path) -> Counter[str] | None:
    """Messages of every topic as the mcap package finds them; None where it fails."""
    try:
        with path.open("rb") as stream:
            return Counter(channel.topic for _, channel, _ in make_reader(stream, validate_crcs=True).iter_messages())
    except Exception:  # it has no common type of error
        return None


def test_a_file_is_complete_if_stock_readers_read_all_of_it_whatever_is_spoilt_in_its_end(tmp_path: Path) -> None:
    whole = write(tmp_path / "a.mcap", RECORDS[:5]).read_bytes()
    told = reader.info(tmp_path / "a.mcap")
    assert told.complete
    assert told.summary_ok
    begin = int.from_bytes(whole[-8 - 20 : -8 - 12], "little")
    path, rng, failed = tmp_path / "b.mcap", random.Random(1), 0
    places = [*rng.sample(range(begin, len(whole) - 37), 150), *range(len(whole) - 37, len(whole))]
    for place in places:
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 1 << rng.randrange(8)]) + whole[place + 1 :])
        info = reader.info(path)
        assert info.complete == (stock(path) == Counter(told.topics)), place
        assert info.messages == told.messages
        assert not info.summary_ok
        failed += not info.complete
    assert failed > 20
    for cut in range(begin, len(whole), 97):
        path.write_bytes(whole[:cut])
        assert not reader.info(path).complete
        assert stock(path) is None


def test_a_damaged_summary_is_mended(tmp_path: Path) -> None:
    path = write(tmp_path / "a.mcap", RECORDS[:5])
    before, data = messages(path), bytearray(path.read_bytes())
    data[-100] ^= 1
    path.write_bytes(data)
    mended = recover(path).path
    assert messages(mended) == before
    assert reader.info(mended).summary_ok
