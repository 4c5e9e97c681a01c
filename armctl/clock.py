"""Time as an argument.

Two kinds of time exist inside armctl: monotonic nanoseconds (everything that measures or schedules) and
epoch nanoseconds (what log files and people read). A `Clock` deals in monotonic time only.
"""

import contextlib
import os
import time
from typing import Protocol

from armctl.messages import NS_PER_S as NS_PER_S


class Clock(Protocol):
    """Monotonic time and the only way to wait for it."""

    def now_ns(self) -> int:
        """Monotonic time [ns]."""

    def sleep_until_ns(self, deadline_ns: int) -> None:
        """Return at `deadline_ns` or, if it has passed, at once."""


class MonotonicClock:
    """The machine's CLOCK_MONOTONIC: one time base for all processes of a boot."""

    now_ns = staticmethod(time.monotonic_ns)

    def sleep_until_ns(self, deadline_ns: int) -> None:
        while (left_ns := deadline_ns - time.monotonic_ns()) > 0:
            time.sleep(left_ns / NS_PER_S)


class VirtualClock:
    """A clock that moves only when told to; sleeping is instantaneous."""

    def __init__(self, start_ns: int = NS_PER_S) -> None:
        self._now_ns = start_ns

    def now_ns(self) -> int:
        return self._now_ns

    def sleep_until_ns(self, deadline_ns: int) -> None:
        if deadline_ns > self._now_ns:
            self._now_ns = deadline_ns

    def advance_ns(self, duration_ns: int) -> None:
        """Move time forward.

        Raises:
            ValueError: the duration is negative.
        """
        if duration_ns < 0:
            raise ValueError(f"a clock cannot go back: {duration_ns} ns")
        self._now_ns += duration_ns


def ask_for_real_time() -> None:
    """Ask that this process does not wait for others (SCHED_FIFO); it goes on as it is where that is refused.

    Late ticks, and late answers of simulated servos, come from whatever else runs on the machine.
    """
    with contextlib.suppress(OSError):  # no CAP_SYS_NICE and no RTPRIO limit
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def ask_for_precedence() -> None:
    """Ask to go before what else is computed (niceness -10, as the installed service has); it goes on without."""
    with contextlib.suppress(OSError):  # no CAP_SYS_NICE and no NICE limit
        os.setpriority(os.PRIO_PROCESS, 0, -10)
