"""Timed replay: where in a log the reader is, at any rate, forwards and back.

Rules.
1. `Player` knows no clock and no screen: its caller says how much time passed and what key was pressed.
2. Time never runs beyond the log: it stops at the end, or begins again where it loops.
3. Seeking and pausing change where time is, never how fast it runs.
"""

from collections.abc import Callable
from dataclasses import dataclass

from armctl.clock import NS_PER_S, Clock

SEEK_S = 5.0
FRAME_S = 0.05
SLOWEST, FASTEST = 0.01, 1000.0


@dataclass
class Player:
    """A position in a log of `duration_s` seconds."""

    duration_s: float
    rate: float = 1.0
    loop: bool = False
    at_s: float = 0.0
    paused: bool = False
    # Whether the viewer asked to leave.
    left: bool = False

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to show."""
        return self.left or (self.at_s >= self.duration_s and not self.loop and not self.paused)

    def advance(self, passed_s: float) -> None:
        """Let `passed_s` seconds of the viewer's time pass."""
        if self.paused:
            return
        at_s = self.at_s + passed_s * self.rate
        if self.loop and at_s > self.duration_s:
            at_s = at_s % self.duration_s if self.duration_s > 0.0 else 0.0
        self.at_s = min(at_s, self.duration_s)

    def seek(self, by_s: float) -> None:
        """Move by so many seconds of the log."""
        self.at_s = min(max(self.at_s + by_s, 0.0), self.duration_s)

    def press(self, key: str) -> None:
        """What a key does; other keys do nothing."""
        match key:
            case " ":
                self.paused = not self.paused
            case "left":
                self.seek(-SEEK_S)
            case "right":
                self.seek(SEEK_S)
            case "l":
                self.loop = not self.loop
            case "+" | "-":
                self.rate = min(max(self.rate * (2.0 if key == "+" else 0.5), SLOWEST), FASTEST)
            case "q":
                self.left = True


# Gives the next key, or nothing once so many seconds are over.
Wait = Callable[[float], str]


def play(player: Player, show: Callable[[Player], None], wait: Wait, clock: Clock, frame_s: float = FRAME_S) -> None:
    """Show the log from where the player is to its end, a picture every `frame_s` seconds."""
    shown_ns = clock.now_ns()
    while True:
        show(player)
        if player.ended:
            return
        key = wait(frame_s)
        now_ns = clock.now_ns()
        player.advance((now_ns - shown_ns) / NS_PER_S)
        shown_ns = now_ns
        player.press(key)
