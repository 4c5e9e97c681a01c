"""What one user may take of the daemon, so that nobody can fill it for others. No I/O; time is an argument.

Rules.
1. Each user has `USER_PLACES` connections. One more takes the place of that user's own connection that is silent
   longest, those that never asked first; one in use (it commands, subscribes or waits for an answer) is not taken.
2. All users together have `PLACES`. One more takes a place of the user who has most of them, in the same order, and
   then one in use, unless it commands.
3. A line is charged by its bytes before it is parsed, `TOKEN_BYTES` a token: to its connection, and a long one to its
   user as well, whatever connection it comes by. What is not paid for is not parsed, but for short lines: one of
   those may be `stop`.
4. Refusals cost the user as well. Once they are not paid for either, the connection is not read for `REST_S` after
   each line: a flood is held up in its sender and does not keep the daemon busy.
"""

from collections import Counter
from collections.abc import Collection
from typing import Protocol, TypeVar

from armctl.errors import RequestRefused

USER_PLACES = 128
PLACES = 256
# Requests a second of one connection, and at once.
RATE = 200.0
BURST = 400.0
# Tokens of a user's, for long lines and refusals: two lines of 64 KiB a second, and four at once.
USER_RATE = 512.0
USER_BURST = 1024.0
TOKEN_BYTES = 256
# A line up to this long is looked at even when it is not paid for.
SHORT_BYTES = 1024
REST_S = 0.1


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


class Account:
    """What one connection may send, on its own allowance and its user's."""

    def __init__(self, user: TokenBucket, now_s: float) -> None:
        self._own, self._user = TokenBucket(RATE, BURST, now_s), user

    def charge(self, size: int, now_s: float) -> tuple[bool, float]:
        """Charge a line of so many bytes.

        Returns:
            Whether it is paid for, and how long [s] the connection is to rest after it.
        """
        tokens = max(1.0, -(-size // TOKEN_BYTES))
        if self._own.take(now_s, tokens) and (size <= SHORT_BYTES or self._user.take(now_s, tokens)):
            return True, 0.0
        return False, 0.0 if self._user.take(now_s) else REST_S


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
        victims = [
            guest
            for guest in guests
            if guest.uid == (uid if own else greedy) and not (guest.in_use if own else guest.commanding)
        ]
        problem = f"{len(guests)} connections are open, all in use; {PLACES} are allowed"
    else:
        return None
    if not victims:
        raise RequestRefused("BUSY", f"{problem}; close one (`armctl stop` is served regardless, on its own socket)")
    return min(victims, key=lambda guest: (guest.in_use, guest.asked, guest.heard_s))
