"""200 short episodes of the soak, and the digests of what passed on the wire and of what the control step said.

`python -m tests.guard.episodes` writes `episodes.json` anew. Do that only in a commit that says why the digests change.
All imports of the package's internals stand in this file; a rename is followed here and nowhere else.
"""

import hashlib
import json
import logging
from collections import Counter
from collections.abc import Iterable
from contextlib import ExitStack
from dataclasses import is_dataclass, replace
from typing import Any
from unittest.mock import patch

from armctl.config import Config
from armctl.messages import TickRecord
from armctl.recording.writer import LogContext
from armctl.sim.bus import SimulatedBus
from proving.episode import Episode, Stage, stage
from proving.requests import PERIOD_S
from proving.story import KINDS, Story, Strike, draw
from tests.guard.kept import save

FILE = "episodes.json"
SEED = 1
EPISODES = 200
CHUNK = 20
CHUNKS = [range(begin, begin + CHUNK) for begin in range(0, EPISODES, CHUNK)]
# Virtual time of an episode: all of them take about 80 s in plain Python.
LONGEST_S = 30.0
FAULTS = set(KINDS)


class Digests:
    """What is heard in one episode, each kind in the order in which it came."""

    def __init__(self) -> None:
        self._hashes = {name: hashlib.blake2b(digest_size=8) for name in ("host", "servos", "records")}

    def hear(self, who: str, data: bytes) -> bytes:
        """Take more bytes of one kind, and hand them on."""
        self._hashes[who].update(data)
        return data

    def record(self, record: TickRecord) -> None:
        """Take the record of a tick, but for the keyframe, which is the step's own memory."""
        for part in (record.inputs, record.outputs):
            # Not `to_json`: commands with a NaN are asked for too, and no log can hold them.
            self.hear("records", json.dumps(part, default=_plain, sort_keys=True).encode())

    def __str__(self) -> str:
        return " ".join(f"{name} {found.hexdigest()}" for name, found in self._hashes.items())


def _plain(value: Any) -> Any:
    if is_dataclass(value):
        return {name: getattr(value, name) for name in value.__dataclass_fields__}
    assert isinstance(value, bytes), f"{type(value).__name__} has no JSON form"
    return value.hex()


def story(number: int, on: Stage) -> Story:
    """The beginning of an episode."""
    whole = draw(SEED, number, on.arm)
    lines = tuple(line for line in whole.lines if line.at_s < LONGEST_S)
    return replace(whole, duration_s=min(whole.duration_s, LONGEST_S), lines=lines)


def happenings() -> Counter[str]:
    """How often each fault, and each other kind of line, stands in the episodes."""
    on = stage()
    lines = [line for number in range(EPISODES) for line in story(number, on).lines]
    return Counter(line.fault.kind if isinstance(line, Strike) else type(line).__name__ for line in lines)


def played(numbers: Iterable[int]) -> dict[str, str]:
    """The digests of episodes by their numbers.

    Raises:
        AssertionError: the judge of the soak objects to one.
    """
    found, on = {}, stage()
    logging.disable(logging.CRITICAL)
    try:
        for number in numbers:
            digests = Digests()
            with ExitStack() as tapped:
                tap(tapped, digests)
                outcome = Episode(story(number, on), on, log=digests.record).play()
            assert not outcome.violations, f"episode {number}: {outcome.violations}"
            found[f"{number:03}"] = str(digests)
    finally:
        logging.disable(logging.NOTSET)
    return found


def records(number: int) -> list[TickRecord]:
    """What the control process logs in an episode."""
    found: list[TickRecord] = []
    on = stage()
    Episode(story(number, on), on, log=found.append).play()
    return found


def context(config: Config) -> LogContext:
    """What logs of an episode's arm have in common."""
    on = stage()
    return LogContext(on.arm, on.robot, config, "loopback", PERIOD_S)


def tap(until: ExitStack, digests: Digests) -> None:
    """Hear every byte that reaches the simulated servos, and every one that they send to the host."""
    receive, transmit = SimulatedBus.receive, SimulatedBus.transmit

    def heard(bus: SimulatedBus, data: bytes, now_ns: int) -> None:
        receive(bus, digests.hear("host", data), now_ns)

    def said(bus: SimulatedBus, now_ns: int) -> bytes:
        return digests.hear("servos", transmit(bus, now_ns))

    until.enter_context(patch.object(SimulatedBus, "receive", heard))
    until.enter_context(patch.object(SimulatedBus, "transmit", said))


if __name__ == "__main__":
    save(FILE, played(range(EPISODES)))
