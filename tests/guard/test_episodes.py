"""Guards the bytes on the wire and the tick records of the first half of 200 episodes of the soak, faults included.

`episodes.json` is made anew (see `episodes.py`) only by a commit that says why.
"""

import pytest

from tests.guard.episodes import CHUNKS, EPISODES, FAULTS, FILE, happenings, played
from tests.guard.kept import load


@pytest.mark.parametrize("numbers", CHUNKS[: len(CHUNKS) // 2], ids=str)
def test_the_first_episodes_have_the_bytes_and_the_records_they_had(numbers: range) -> None:
    kept = load(FILE)
    assert played(numbers) == {name: kept[name] for name in (f"{number:03}" for number in numbers)}


def test_the_episodes_have_every_fault_kills_late_ticks_host_losses_and_tampering() -> None:
    often = happenings()
    assert often.keys() >= FAULTS, f"missing: {FAULTS - often.keys()}"
    assert min(often[name] for name in ("Kill", "Late", "HostGone", "Tamper")) >= 10, often
    assert len(load(FILE)) == EPISODES
