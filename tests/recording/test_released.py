"""Logs of every release and of what came before it (`released/`): each is judged, or says who wrote it.

A release adds its own: forty-five ticks of `make_records`, written by its own code.
"""

from pathlib import Path

import pytest

from armctl.recording import reader, timeline
from armctl.recording.entry import describe
from armctl.recording.replay import check
from tests.recording.refusals import cannot

RELEASED = Path(__file__).with_name("released")
# By name, the ticks of each.
TICKS = {"0.2.0-first": 60, "0.2.0": 45}


def test_every_log_that_is_kept_is_looked_at() -> None:
    assert {path.stem for path in RELEASED.iterdir()} == TICKS.keys()


@pytest.mark.parametrize("name", TICKS)
def test_a_log_of_an_earlier_armctl_is_read_shown_and_listed(name: str) -> None:
    path = RELEASED / f"{name}.mcap"
    found = reader.info(path)
    assert (found.complete, found.topics["/armctl/cycle"]) == (True, TICKS[name])
    shown = timeline.load(path)
    assert (len(shown.tick), shown.states[0][1]) == (TICKS[name], "off")
    assert "moving" in [state for _, state in shown.states]
    entry = describe(path)
    assert (entry.version, entry.problem, entry.complete) == ("0.2.0", "", True)
    assert {event[2] for event in entry.events} >= {"PLAN_BEGIN"}
    assert len(entry.minutes) == 6


def test_a_log_of_the_release_is_judged_bit_for_bit() -> None:
    result = check(RELEASED / "0.2.0.mcap")
    assert (result.judged, result.mismatches, result.passed_over) == (45, 0, False)


def test_a_log_whose_state_nobody_knows_any_more_says_who_wrote_it_and_how_to_run_that_one() -> None:
    """The first builds of 0.2.0 numbered the phases of the control step, and did not say their commit."""
    who = r"made by other sources of armctl 0\.2\.0 \(commit unknown\): check it with that one"
    cannot(check, RELEASED / "0.2.0-first.mcap", why=who)
    cannot(check, RELEASED / "0.2.0-first.mcap", why=r"git checkout \$\(git rev-list -1 --before=@1750000000 HEAD\)")
