"""Guards the second half of the episodes, see `test_episodes.py`; a file of its own, so that two workers share them."""

import pytest

from tests.guard.episodes import CHUNKS, FILE, played
from tests.guard.kept import load


@pytest.mark.parametrize("numbers", CHUNKS[len(CHUNKS) // 2 :], ids=str)
def test_the_other_episodes_have_the_bytes_and_the_records_they_had(numbers: range) -> None:
    kept = load(FILE)
    assert played(numbers) == {name: kept[name] for name in (f"{number:03}" for number in numbers)}
