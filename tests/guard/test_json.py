"""Guards the `--json` output of every command: each key of what repeats, keys and types of what does not.

`commands.json` is made anew (see `commands.py`) only by a commit that says why. A difference names command and key.
"""

import pytest

from tests.guard.commands import FILE, answers, names, on_an_arm
from tests.guard.kept import load


def test_commands_without_an_arm_answer_as_they_did() -> None:
    assert answers() == load(FILE)["answers"]


@pytest.mark.pty
def test_answers_of_commands_on_an_arm_have_the_keys_types_codes_and_states_they_had() -> None:
    assert on_an_arm() == load(FILE)["on an arm"]


def test_every_command_is_guarded() -> None:
    guarded = [line for part in load(FILE).values() for line in part]
    missing = [name for name in names() if not any(f"{line} ".startswith(f"{name} ") for line in guarded)]
    assert not missing, f"give these a line in commands.py: {missing}"
