"""Guards every message, attachment and chunk of logs of every kind, as the `mcap` package reads them, and CSV files.

`logs.json` is made anew (see `logs.py`) only by a commit that says why. A difference names the kind and the topic.
"""

from tests.guard.kept import load
from tests.guard.logs import FILE, KEYFRAMES, of_every_kind


def test_logs_of_every_kind_hold_what_they_held() -> None:
    kept, found = load(FILE), of_every_kind()
    state = {name: entries.pop(KEYFRAMES, "") for name, entries in found.items()}
    kept_state = {name: entries.pop(KEYFRAMES, "") for name, entries in kept.items()}
    assert found == kept
    assert state == kept_state, "the keyframes alone differ: the control step's own memory has another form"
