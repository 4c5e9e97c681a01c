"""What a user may take: places and bytes, by the laws that nobody takes them from others."""

from collections import Counter
from dataclasses import dataclass

import pytest
from hypothesis import given
from hypothesis import strategies as st

from armctl.errors import RequestRefused
from armctl.host import allowance
from armctl.host.allowance import (
    LONG_REST_S,
    PLACES,
    REST_S,
    SHORT_BYTES,
    USER_PLACES,
    Account,
    TokenBucket,
    User,
    make_room,
)

KIB64 = 65536


@dataclass(eq=False)
class Guest:
    uid: int
    asked: bool = False
    heard_s: float = 0.0
    in_use: bool = False
    commanding: bool = False


COMERS = st.lists(st.tuples(st.integers(0, 3), st.booleans(), st.booleans(), st.booleans()), max_size=700)


def come(guests: list[Guest], newcomer: Guest) -> Guest | None:
    """Who left for a newcomer, which is there now."""
    victim = make_room(guests, newcomer.uid)
    if victim is not None:
        guests.remove(victim)
    guests.append(newcomer)
    return victim


@given(COMERS)
def test_nobody_is_displaced_or_refused_for_another_user_who_has_more(
    comers: list[tuple[int, bool, bool, bool]],
) -> None:
    guests: list[Guest] = []
    for at_s, (uid, asked, in_use, commanding) in enumerate(comers):
        held = Counter(guest.uid for guest in guests)
        try:
            victim = come(guests, Guest(uid, asked, at_s, in_use or commanding, commanding))
        except RequestRefused:
            assert (
                held[uid] == USER_PLACES
                or held[uid] == max(held.values())
                or all(guest.commanding for guest in guests if held[guest.uid] == max(held.values()))
            )
            continue
        assert victim is None or (victim.uid == uid and not victim.in_use) or held[victim.uid] > held[uid]
        assert victim is None or not victim.commanding
        assert len(guests) <= PLACES
        assert max(Counter(guest.uid for guest in guests).values()) <= USER_PLACES


def test_however_many_connections_one_user_holds_another_gets_in_and_the_user_too_while_any_is_idle() -> None:
    guests = [Guest(1, in_use=True) for _ in range(USER_PLACES)]
    with pytest.raises(RequestRefused, match=f"uid 1 has {USER_PLACES} connections, all in use.*armctl stop"):
        make_room(guests, 1)
    assert make_room(guests, 2) is None
    guests += [Guest(2, in_use=True) for _ in range(PLACES - USER_PLACES)]
    displaced = [come(guests, Guest(3, in_use=True)) for _ in range(20)]
    assert {guest.uid for guest in displaced if guest} == {1, 2}
    assert sum(guest.uid == 3 for guest in guests) == 20


def test_who_never_asked_goes_first_then_who_is_silent_longest_and_never_who_is_in_use() -> None:
    guests = [Guest(1, in_use=True, heard_s=0.0) for _ in range(USER_PLACES - 3)]
    guests += [Guest(1, asked=True, heard_s=2.0), Guest(1, asked=True, heard_s=1.0), Guest(1, heard_s=9.0)]
    order = [come(guests, Guest(1, asked=True, heard_s=10.0, in_use=True)) for _ in range(3)]
    assert [guest and (guest.asked, guest.heard_s) for guest in order] == [(False, 9.0), (True, 1.0), (True, 2.0)]


def test_a_long_line_costs_as_much_as_as_many_short_ones() -> None:
    accounts = [Account(User(0.0), 0.0) for _ in range(2)]
    assert accounts[0].charge(KIB64, 0.0) == (True, 0.0)
    assert all(accounts[1].charge(60, 0.0)[0] for _ in range(KIB64 // allowance.TOKEN_BYTES))
    left = [sum(account.charge(60, 0.0)[0] for _ in range(1000)) for account in accounts]
    assert left[0] == left[1] < 1000


@given(st.lists(st.tuples(st.integers(0, 19), st.integers(1, KIB64), st.floats(0.0, 0.2)), max_size=300))
def test_a_user_gets_no_more_by_opening_more_connections(lines: list[tuple[int, int, float]]) -> None:
    user, now_s, tokens, short = User(0.0), 0.0, 0, 0
    accounts = [Account(user, 0.0) for _ in range(20)]
    for number, size, step_s in lines:
        now_s += step_s
        paid, rest_s = accounts[number].charge(size, now_s)
        assert rest_s in (0.0, REST_S, LONG_REST_S)
        tokens += -(-size // allowance.TOKEN_BYTES) * (paid and size > SHORT_BYTES)
        short += not rest_s and size <= SHORT_BYTES
        assert tokens <= allowance.USER_LONG_BURST + allowance.USER_LONG_RATE * now_s + 1e-6
        assert short <= allowance.USER_SHORT_RATE * (1.0 + now_s)
        assert paid or rest_s or size <= SHORT_BYTES


def test_a_flood_is_held_up_and_leaves_the_users_other_connections_their_short_requests() -> None:
    user = User(0.0)
    flooders, other = [Account(user, 0.0) for _ in range(3)], Account(user, 0.0)
    assert [flooders[0].charge(KIB64, 0.0) for _ in range(9)] == [(True, 0.0)] + [(False, REST_S)] * 8
    unpaid = [flooders[2].charge(KIB64, 0.0)[1] for _ in range(1 + int(allowance.UNPAID_RATE))]
    assert (unpaid[1], unpaid[-1]) == (REST_S, LONG_REST_S)
    rests = [flooders[1].charge(60, 0.0)[1] for _ in range(int(allowance.USER_SHORT_RATE) + 1)]
    assert (rests[0], rests[-2], rests[-1]) == (0.0, 0.0, REST_S)
    assert other.charge(60, 0.0) == (True, REST_S)


@given(st.lists(st.floats(0.0, 1.0), min_size=1, max_size=300))
def test_a_token_bucket_never_grants_more_than_burst_and_rate(steps_s: list[float]) -> None:
    bucket, now_s, granted = TokenBucket(20.0, 10.0, 0.0), 0.0, 0
    for step_s in steps_s:
        now_s += step_s
        granted += bucket.take(now_s)
        assert granted <= 10.0 + 20.0 * now_s + 1e-6


def test_a_token_bucket_serves_a_burst_and_then_the_rate() -> None:
    bucket = TokenBucket(200.0, 400.0, 0.0)
    assert sum(bucket.take(0.0) for _ in range(1000)) == 400
    assert sum(bucket.take(1.0) for _ in range(1000)) == 200
