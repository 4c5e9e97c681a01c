"""Timed replay: laws of the player, and the loop on a clock that only the keys move."""

from collections.abc import Iterable, Sequence

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.clock import NS_PER_S, VirtualClock
from armctl.recording.player import FASTEST, SEEK_S, SLOWEST, Player, Wait, play

KEYS = st.sampled_from(["", " ", "left", "right", "l", "+", "-", "x"])


@given(
    duration_s=st.floats(0.0, 1e4),
    rate=st.floats(SLOWEST, FASTEST),
    loop=st.booleans(),
    steps=st.lists(st.tuples(st.floats(0.0, 100.0), KEYS), max_size=30),
)
def test_time_never_leaves_the_log(duration_s: float, rate: float, loop: bool, steps: list[tuple[float, str]]) -> None:
    player = Player(duration_s, rate=rate, loop=loop)
    for passed_s, key in steps:
        player.advance(passed_s)
        player.press(key)
        assert 0.0 <= player.at_s <= duration_s
        assert SLOWEST <= player.rate <= FASTEST


@given(rate=st.floats(0.1, 10.0), parts=st.lists(st.floats(0.0, 5.0), min_size=1, max_size=20))
def test_time_runs_at_the_rate_however_it_is_cut_up(rate: float, parts: list[float]) -> None:
    player = Player(1e6, rate=rate)
    for part in parts:
        player.advance(part)
    assert player.at_s == pytest.approx(rate * sum(parts), abs=1e-9)


def test_a_pause_stops_time_and_seeking_still_moves_it() -> None:
    player = Player(60.0, at_s=10.0)
    player.press(" ")
    player.advance(5.0)
    assert player.at_s == 10.0
    player.press("right")
    assert player.at_s == 10.0 + SEEK_S
    player.press(" ")
    player.advance(1.0)
    assert player.at_s == 16.0


def test_a_loop_begins_again_and_only_leaving_ends_it() -> None:
    player = Player(10.0, loop=True, at_s=9.0)
    player.advance(2.5)
    assert (player.at_s, player.ended) == (1.5, False)
    player.press("q")
    assert player.ended


def test_a_pause_at_the_end_does_not_end_the_replay() -> None:
    player = Player(10.0, at_s=9.0)
    player.press(" ")
    player.press("right")
    assert (player.at_s, player.ended) == (10.0, False)
    player.press("left")
    player.press(" ")
    assert not player.ended


def waiting(clock: VirtualClock, script: Iterable[str] = ()) -> Wait:
    """A key at every picture as long as there are some; waiting moves the clock."""
    keys = iter(script)

    def wait(timeout_s: float) -> str:
        clock.advance_ns(round(timeout_s * NS_PER_S))
        return next(keys, "")

    return wait


def shown(player: Player, script: Sequence[str], frame_s: float) -> list[float]:
    clock = VirtualClock()
    pictures: list[float] = []
    play(player, lambda now: pictures.append(round(now.at_s, 6)), waiting(clock, script), clock, frame_s)
    return pictures


def test_every_picture_from_the_first_to_the_last_is_shown_and_keys_work_meanwhile() -> None:
    assert shown(Player(2.0), [], 0.5) == [0.0, 0.5, 1.0, 1.5, 2.0]
    assert shown(Player(2.0, rate=2.0, at_s=0.5), [], 0.5) == [0.5, 1.5, 2.0]
    assert shown(Player(0.0), [], 0.5) == [0.0]
    assert shown(Player(20.0), ["", " ", "", "right", " ", "q"], 1.0) == [0.0, 1.0, 2.0, 2.0, 7.0, 7.0, 8.0]
