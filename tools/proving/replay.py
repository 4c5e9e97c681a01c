"""Whether `armctl replay --check` judges everything: the logs of episodes, sound, with one value changed, and cut.

1. An episode of the soak (`episode.py`: faults, kills, clears, jogs, corrections, on every kind of arm) is logged and
   checked: no mismatch, no tick skipped, as many judged as the mcap package finds cycles. Only a control process that
   was started again may leave a gap.
2. One leaf of one output is changed in the log, by the mcap and rosbags packages: the check finds a difference.
3. The log is cut by 1 to 99 %: the check never gives it a clean bill.

What a log holds is read and changed by those packages alone.
"""

import logging
import math
import random
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

from mcap.reader import make_reader
from mcap.records import Message
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from armctl.config import Config
from armctl.errors import LogError
from armctl.recording import replay
from armctl.recording.writer import LogContext, LogWriter
from proving.damage import FLUSH_TICKS, UnsyncedDisk
from proving.episode import Episode
from proving.requests import PERIOD_S
from proving.scenes import SCENES_FROM
from proving.soak import drawn_by, finite

EPISODES = 200
# Of every log.
MUTANTS, CUTS = 4, 3
# The log of an episode ends after so many; its beginning has torque on, motions and the first troubles.
MOST_TICKS = 600
MOST_EXAMPLES = 10
CYCLE = "/armctl/cycle"
# Topics of outputs, and the fields of them that are none.
OUTPUTS: dict[str, tuple[str, ...]] = {
    "/joint_states": (), "/joint_commands": (), "/tf": (), "/tcp_pose": (), "/joint_trajectory": (), "/diagnostics": (),
    "/armctl/writes": ("confirmed",), "/armctl/command": (), "/rosout": (),
    CYCLE: (
        "tick", "now_ns", "time_ns", "late_ns", "lateness_us", "bus_us", "write_us", "retries", "dropped", "port_open",
        "inputs_only", "goal_sent", "overrun",
    ),
}  # fmt: skip
Leaf = tuple[str, Callable[[Any], None], Any]


def prove(
    seed: int = 1, *, episodes: int = EPISODES, workers: int = 2, tell: Callable[[str], None] = print
) -> dict[str, Any]:
    """The proof, on so many processes."""
    tally, examples, fields = Counter[str](), list[str](), Counter[str]()
    with ProcessPoolExecutor(workers, mp_context=get_context("spawn")) as pool:
        jobs = {pool.submit(judged, seed, number): number for number in numbers(episodes)}
        for done, job in enumerate(as_completed(jobs), 1):
            found, wrong, caught = job.result()
            tally.update(found)
            fields.update(caught)
            examples += [f"episode {jobs[job]}: {text}" for text in wrong]
            if wrong or done % 20 == 0:
                tell(f"{done} of {len(jobs)}: {wrong[0] if wrong else 'as it should be'}")
    figures = {
        key: tally[key] for key in ("judged", "skipped", "mismatches", "gaps", "mutants", "caught", "cuts", "clean")
    }
    return {
        "runs": episodes,
        "violations": len(examples),
        **figures,
        "fields": dict(sorted(fields.items())),
        "examples": examples[:MOST_EXAMPLES],
        "seed": seed,
    }


def numbers(episodes: int) -> list[int]:
    """Which ones are played: every fourth is a scene, drawn for one kind of trouble."""
    return [SCENES_FROM + index if index % 4 == 3 else index for index in range(episodes)]


def judged(seed: int, number: int) -> tuple[Counter[str], list[str], Counter[str]]:
    """One episode: what was counted, what is wrong, and which fields were changed and caught."""
    logging.disable(logging.CRITICAL)
    rng, tally, wrong, caught = random.Random(f"{seed} {number}"), Counter[str](), list[str](), Counter[str]()
    with tempfile.TemporaryDirectory(prefix="armctl-replay-") as folder:
        log, begun = written(seed, number, Path(folder))
        if not begun:
            return tally, wrong, caught
        result = replay.check(log)
        cycles = sum(channel.topic == CYCLE for _, channel, _ in messages(log))
        tally.update(judged=result.judged, skipped=result.skipped, mismatches=result.mismatches, gaps=len(result.gaps))
        if result.mismatches or result.skipped or result.judged != cycles or result.not_compared:
            wrong.append(f"{result.judged} of {cycles} judged, {result.skipped} skipped: {result.first_mismatch}")
        if len(result.gaps) != begun - 1:
            wrong.append(f"{len(result.gaps)} gaps, and the control process was started {begun} times")
        for _ in range(MUTANTS):
            other = Path(folder) / "mutant.mcap"
            field = changed(log, other, rng)
            tally["mutants"] += 1
            if replay.check(other).mismatches:
                tally["caught"] += 1
                caught[field] += 1
            else:
                wrong.append(f"{field} was changed, and nobody noticed")
        whole = log.read_bytes()
        for _ in range(CUTS):
            percent = rng.randint(1, 99)
            log.write_bytes(whole[: len(whole) * (100 - percent) // 100])
            tally["cuts"] += 1
            if clean(log):
                tally["clean"] += 1
                wrong.append(f"cut by {percent} % it is given a clean bill")
    return tally, wrong, caught


def clean(log: Path) -> bool:
    """Whether the check says that all is well."""
    try:
        result = replay.check(log)
    except LogError:
        return False
    return not (result.mismatches or result.skipped or result.gaps)


def written(seed: int, number: int, folder: Path) -> tuple[Path, int]:
    """The log of an episode, and how many control processes are in it; it ends where a command is no JSON."""
    on, story = drawn_by(seed, number)
    context = LogContext(on.arm, on.robot, Config(), "loopback", PERIOD_S)
    writer = LogWriter(folder / "episode.mcap", context, disk=UnsyncedDisk())
    begun, ticks, over = 0, 0, False

    def take(record: Any) -> None:
        nonlocal begun, ticks, over
        over |= ticks == MOST_TICKS or not all(map(finite, record.inputs.commands))
        if not over:
            ticks += 1
            begun += record.inputs.tick == 0
            writer.write_tick(record)
            if ticks % FLUSH_TICKS == 0:
                writer.flush()  # as the recorder does: a cut is to leave something

    Episode(story, on, log=take).play()
    writer.close()
    return writer.path, begun


def messages(log: Path) -> Iterator[tuple[Any, Any, Message]]:
    """Everything in a log, by the mcap package, in the order of the file."""
    with log.open("rb") as stream:
        yield from make_reader(stream, validate_crcs=True).iter_messages(log_time_order=False)


def changed(log: Path, other: Path, rng: random.Random) -> str:
    """The log with one leaf of one output changed; which one."""
    store = get_typestore(Stores.ROS2_JAZZY)
    places: dict[str, list[int]] = {}
    schemas: dict[str, tuple[str, str]] = {}
    for place, (schema, channel, message) in enumerate(messages(log)):
        told = channel.topic != "/armctl/command" or b'"reply"' in message.data
        if channel.topic in OUTPUTS and told and (channel.topic != "/rosout" or b"armctl.control\0" in message.data):
            places.setdefault(channel.topic, []).append(place)
            schemas[channel.topic] = schema.name, schema.data.decode()
    topic = rng.choice(sorted(places))
    chosen, (name, text) = rng.choice(places[topic]), schemas[topic]
    types = get_types_from_msg(text, name)
    store.register({kind: fields for kind, fields in types.items() if kind not in store.fielddefs})
    field = ""
    with log.open("rb") as source, other.open("wb") as stream:
        reader, writer = make_reader(source), Writer(stream)
        writer.start("ros2", "proving")
        for attachment in reader.iter_attachments():
            writer.add_attachment(
                attachment.create_time, attachment.log_time, attachment.name, attachment.media_type, attachment.data
            )
        for metadata in reader.iter_metadata():
            writer.add_metadata(metadata.name, metadata.metadata)
        ids: dict[int, int] = {}
        kinds: dict[int, int] = {}
        summary = reader.get_summary()
        assert summary is not None
        for channel in summary.channels.values():
            schema = summary.schemas[channel.schema_id]
            if schema.id not in kinds:
                kinds[schema.id] = writer.register_schema(schema.name, schema.encoding, schema.data)
            ids[channel.id] = writer.register_channel(
                channel.topic, channel.message_encoding, kinds[schema.id], channel.metadata
            )
        for place, (_, channel, message) in enumerate(messages(log)):
            data = message.data
            if place == chosen:
                value = store.deserialize_cdr(data, name)
                where, put, leaf = rng.choice(list(leaves(value, topic, OUTPUTS[topic])))
                put(another(leaf))
                data, field = bytes(store.serialize_cdr(value, name)), where
            writer.add_message(ids[channel.id], message.log_time, data, message.publish_time, message.sequence)
        writer.finish()  # type: ignore[no-untyped-call]
    return field


def leaves(value: Any, name: str, passed_over: tuple[str, ...]) -> Iterator[Leaf]:
    """Name, setter and value of every leaf of a message; members of lists have the list's name.

    Constants of a type, which rosbags shows as fields, stand in no message: their names are in capitals.
    """
    for key in vars(value):
        part = getattr(value, key)
        if key in passed_over or key == "__msgtype__" or key.isupper():
            continue
        where = f"{name}.{key}"
        if hasattr(part, "__msgtype__"):
            yield from leaves(part, where, passed_over)
        elif isinstance(part, list) or hasattr(part, "dtype"):
            if hasattr(part, "dtype"):
                part = part.copy()  # what rosbags has read cannot be written to
                object.__setattr__(value, key, part)
            for index, member in enumerate(part):
                if hasattr(member, "__msgtype__"):
                    yield from leaves(member, where, passed_over)
                else:
                    yield where, partial(part.__setitem__, index), member
        else:
            yield where, partial(object.__setattr__, value, key), part


def another(leaf: Any) -> Any:
    """The value next to a leaf's."""
    if isinstance(leaf, str):
        return f"{leaf[:-1]}{'y' if leaf.endswith('x') else 'x'}"
    if isinstance(leaf, bool):
        return not leaf
    if isinstance(leaf, float):
        return math.nextafter(float(leaf), math.inf)
    return leaf - 1 if leaf > 0 else leaf + 1
