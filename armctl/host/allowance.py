"""What one user may take of the daemon, so that nobody can fill it for others. No I/O; time is an argument.

Rules.
1. Each user has `USER_PLACES` connections. One more takes the place of that user's own connection that is silent
   longest, those that never asked first; one in use (it commands, subscribes or waits for an answer) is not taken.
2. All users together have `PLACES`. One more takes a place of the user who has most of them, in the same order, and
   then one in use, unless it commands.
   A user who connects again and again is sent away before anything is made for the connection.
3. A line is charged by its bytes before it is parsed, `TOKEN_BYTES` a token: to its connection, and a long one to its
   user as well, whatever connection it comes by. What is not paid for is not parsed, but for short lines: one of
   those may be `stop`.
4. A connection is not read for `REST_S` after a long line that is not paid for, for `LONG_REST_S` once its user sends
   more of those than `UNPAID_RATE`, and for `REST_S` after a short line beyond `USER_SHORT_RATE`. So a flood is held
   up in its sender and does not keep the daemon busy.
"""

from collections import Counter
from collections.abc import Collection
from typing import Protocol, TypeVar

from armctl.errors import RequestRefused

USER_PLACES = 192
PLACES = 384
# Requests a second of one connection, and at once.
RATE = 200.0
BURST = 400.0
# Tokens of a user's for long lines: one of 64 KiB a second, and two at once.
USER_LONG_RATE = 256.0
USER_LONG_BURST = 512.0
# Short lines of a user's, a second and at once.
USER_SHORT_RATE = 2000.0
# New connections of a user's, a second and at once.
COMINGS_RATE = 100.0
COMINGS_BURST = 400.0
TOKEN_BYTES = 256
# A line up to this long is looked at even when it is not paid for.
SHORT_BYTES = 1024
REST_S = 0.1
LONG_REST_S = 0.5
UNPAID_RATE = 40.0
STOP_IS_SERVED = "`armctl stop` is served regardless, on its own socket"


class TokenBucket:
    """Allowance of `rate` tokens a second with bursts up to `burst`; time is an argument."""

    def __init__(self, rate: float, burst: float, now_s: float) -> None:
        self._rate, self._burst = rate, burst
        self._tokens, self._since_s = burst, now_s

    def take(self, now_s: float, tokens: float = 1.0) -> bool:
        """Whether so many tokens are there now; only then they are taken."""
        self._tokens = min(self._burst, self._tokens + (now_s - self._since_s) * self._rate)
        self._since_s = now_s
        if self._tokens < tokens:
            return False
        self._tokens -= tokens
        return True


class User:
    """What all connections of a user may send."""

    def __init__(self, now_s: float) -> None:
        self.long = TokenBucket(USER_LONG_RATE, USER_LONG_BURST, now_s)
        self.short = TokenBucket(USER_SHORT_RATE, USER_SHORT_RATE, now_s)
        self.unpaid = TokenBucket(UNPAID_RATE, UNPAID_RATE, now_s)
        self.comings = TokenBucket(COMINGS_RATE, COMINGS_BURST, now_s)


class Account:
    """What one connection may send, on its own allowance and its user's."""

    def __init__(self, user: User, now_s: float) -> None:
        self._own, self._user = TokenBucket(RATE, BURST, now_s), user

    def charge(self, size: int, now_s: float) -> tuple[bool, float]:
        """Charge a line of so many bytes.

        Returns:
            Whether it is paid for, and how long [s] the connection is to rest after it.
        """
        tokens = max(1.0, -(-size // TOKEN_BYTES))
        paid = self._own.take(now_s, tokens)
        if size <= SHORT_BYTES:
            return paid, 0.0 if self._user.short.take(now_s) else REST_S
        paid = paid and self._user.long.take(now_s, tokens)
        return paid, 0.0 if paid else REST_S if self._user.unpaid.take(now_s) else LONG_REST_S


class Guest(Protocol):
    """A connection, as far as its place is concerned."""

    uid: int
    # Whether it ever sent a whole request, and when it sent its last line [s].
    asked: bool
    heard_s: float

    @property
    def in_use(self) -> bool: ...

    @property
    def commanding(self) -> bool: ...


G = TypeVar("G", bound=Guest)


def make_room(guests: Collection[G], uid: int) -> G | None:
    """Who has to go so that this user gets a place; None: there is room.

    Raises:
        RequestRefused: code BUSY, there is none to be had.
    """
    held = Counter(guest.uid for guest in guests)
    if held[uid] >= USER_PLACES:
        victims = [guest for guest in guests if guest.uid == uid and not guest.in_use]
        problem = f"uid {uid} has {held[uid]} connections, all in use; a user may have {USER_PLACES}"
    elif len(guests) >= PLACES:
        greedy, most = held.most_common(1)[0]
        own = held[uid] >= most
        whose = uid if own else greedy
        victims = [guest for guest in guests if guest.uid == whose and not (guest.in_use if own else guest.commanding)]
        problem = f"{len(guests)} connections are open, all in use; {PLACES} are allowed"
    else:
        return None
    if not victims:
        raise RequestRefused("BUSY", f"{problem}; close one ({STOP_IS_SERVED})")
    return min(victims, key=lambda guest: (guest.in_use, guest.asked, guest.heard_s))


def unpaid(size: int) -> RequestRefused:
    cost = f"it costs as much as {size // TOKEN_BYTES} short ones"
    rates = f"{RATE:g} of these a second, and its user {USER_LONG_RATE * TOKEN_BYTES:.0f} bytes of long lines"
    return RequestRefused("RATE_LIMIT", f"a line of {size} bytes is not read: {cost}; a connection has {rates}; wait")


def displaced(victim: str, newcomer: str) -> RequestRefused:
    why = f"{USER_PLACES} connections a user or {PLACES} in all are open, and it was silent longest"
    remedy = "connect again when there is something to ask"
    return RequestRefused("BUSY", f"{victim} gives its place to {newcomer}: {why}; {remedy}")


def too_often(uid: int) -> RequestRefused:
    problem = f"uid {uid} connects more than {COMINGS_RATE:g} times a second"
    return RequestRefused("RATE_LIMIT", f"{problem}; keep a connection, or wait ({STOP_IS_SERVED})")


def too_slow(name: str, unfinished: int, within_s: float) -> RequestRefused:
    if unfinished:
        what = f"its line of {unfinished} bytes so far is not finished after {within_s:g} s; send a request at once"
    else:
        what = f"it sent no whole request within {within_s:g} s; connect when there is something to ask"
    return RequestRefused("IDLE", f"{name} is disconnected: {what}")
