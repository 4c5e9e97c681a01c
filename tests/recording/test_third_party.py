"""Others read an hour of log completely: their counts and values are those of armctl's own reader."""

import json
import re
import shutil
import sys
from collections import Counter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.reader import make_reader
from rosbags.highlevel import AnyReader

from armctl.clock import NS_PER_S
from armctl.recording import reader
from armctl.recording.channels import CYCLE, JOINT_STATES, SERVOS, WIRE
from armctl.recording.columns import Texts
from armctl.recording.compact import compact
from armctl.recording.log_file import LogFile
from proving.log_rig import repeated
from tests.recording.factory import ANCHOR, make_records, times_s
from tests.recording.logs import write
from tests.recording.programs import told_by

NODE = Path(__file__).parent / "node"
P = 2**31 - 1
TICKS = 36_000
MINUTE = make_records(600)


@pytest.fixture(scope="module")
def hour(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A compacted log of an hour at 10 Hz: a minute of the control step, repeated at later times."""
    path = tmp_path_factory.mktemp("hour") / "armctl-20250615T150645Z.mcap"
    assert compact(write(path, repeated(MINUTE, TICKS), flush_ticks=9, wire_ticks=50))
    return path


@pytest.fixture(scope="module")
def held(hour: Path) -> reader.LogInfo:
    info = reader.info(hour)
    assert info.complete
    assert info.duration_s == pytest.approx(times_s(MINUTE)[1] + (TICKS - 2) / 10.0)
    assert (info.topics[CYCLE], info.messages) == (TICKS, sum(info.topics.values()))
    assert info.start_s == pytest.approx(ANCHOR.epoch_ns(MINUTE[0].inputs.sample.time_ns) / NS_PER_S)
    return info


def test_mcap_reads_every_message_with_checksums_and_finds_what_armctl_finds(hour: Path) -> None:
    with hour.open("rb") as stream, LogFile(hour) as log:
        stock = make_reader(stream, validate_crcs=True)
        found = stock.iter_messages(log_time_order=False)
        for (_, channel, message), ours in zip(found, log.messages(), strict=True):
            assert (channel.topic, message.log_time, message.sequence, message.data) == ours


def test_rosbags_reads_every_message_and_the_same_values(hour: Path, held: reader.LogInfo) -> None:
    counts: Counter[str] = Counter()
    positions, registers, wire = [], [], list[tuple[int, bool, bytes]]()
    with AnyReader([hour]) as bag:
        for connection, _, data in bag.messages():
            counts[connection.topic] += 1
            message: Any = bag.deserialize(data, connection.msgtype)
            if connection.topic == JOINT_STATES:
                positions.append(message.position.tolist())
            elif connection.topic == SERVOS:
                registers.append([servo.registers.tolist() for servo in message.servos])
            elif connection.topic == WIRE:
                wire += [(piece.time_ns, piece.sent, piece.data.tobytes()) for piece in message.pieces]
    assert counts == held.topics
    assert wire == [piece for tick in range(0, TICKS, 50) for piece in MINUTE[tick % 600].wire]
    tables = reader.read_columns(hour, (JOINT_STATES, SERVOS))
    [states], [servos] = tables[JOINT_STATES], tables[SERVOS]
    assert states.numbers("position").tolist() == positions
    ours = [servos.numbers(f"servos[{index}].registers").tolist() for index in range(6)]
    assert [list(one) for one in zip(*ours, strict=True)] == registers


def test_rerun_checks_the_file_and_counts_the_same_messages(hour: Path, held: reader.LogInfo) -> None:
    rerun = Path(sys.executable).parent / "rerun"
    checked = re.findall(r"^(\S+)\s+\d+\s+\d+\s+(/\S+)", told_by(rerun, "mcap", "check", hour), re.MULTILINE)
    assert {topic: verdict for verdict, topic in checked} == dict.fromkeys(held.topics, "ok")
    counted = re.findall(r"^\s*\d+\s+(/\S+)\s+(\d+)\s", told_by(rerun, "mcap", "info", hour), re.MULTILINE)
    assert {topic: int(count) for topic, count in counted} == held.topics


def test_mcap_core_under_node_reads_every_message_and_the_same_values(hour: Path, held: reader.LogInfo) -> None:
    node = shutil.which("node")
    if node is None or not (NODE / "node_modules").is_dir():
        pytest.skip(f"needs Node and its packages: npm ci --prefix {NODE}")
    found = json.loads(told_by(node, NODE / "read.mjs", hour))
    assert {topic: total[0] for topic, total in found.items()} == held.topics
    for topic, tables in reader.read_columns(hour).items():
        fractions, integers, texts = 0.0, 0, 0
        for table in tables:
            for column in table.columns.values():
                if isinstance(column, Texts):
                    texts += sum(map(len, column.tolist()))
                    continue
                whole = column == np.floor(column) if column.dtype.kind == "f" else np.ones(column.shape, bool)
                fractions += float(column[~whole].sum())
                integers += int(np.mod(column[whole].astype(np.int64), P).sum())
        assert found[topic][1] == pytest.approx(fractions, rel=1e-11), topic
        assert found[topic][2:] == [integers % P, texts], topic
