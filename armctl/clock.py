"""Time as an argument.

Two kinds of time exist inside armctl: monotonic nanoseconds (everything that measures or schedules) and
epoch nanoseconds (what log files and people read). A `Clock` deals in monotonic time only.
"""

import contextlib
import os
import time
from pathlib import Path
from typing import Protocol

from armctl.messages import NS_PER_S as NS_PER_S

# What /proc/stat counts in, how exact that is, and as much of it as tells of 60 processors.
TICK_NS = NS_PER_S // os.sysconf("SC_CLK_TCK")
RESOLVED_TICKS = 2
STAT_BYTES = 4096


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
        self._now_ns = max(self._now_ns, deadline_ns)

    def advance_ns(self, duration_ns: int) -> None:
        """Move time forward.

        Raises:
            ValueError: the duration is negative.
        """
        if duration_ns < 0:
            raise ValueError(f"a clock cannot go back: {duration_ns} ns")
        self._now_ns += duration_ns


class Stalls:
    """How long the processors of a virtual machine were paused by the machine that it runs on.

    In `/proc/stat` the kernel counts the time in which each processor worked or had nothing to do. Time that has passed
    and is not counted there is a stall. A machine that is not virtual has none.
    """

    def __init__(self, clock: Clock | None = None, proc: Path = Path("/proc")) -> None:
        self._clock = clock or MonotonicClock()
        self._fd = -1
        with contextlib.suppress(OSError):
            if b" hypervisor " in (proc / "cpuinfo").read_bytes():
                self._fd = os.open(proc / "stat", os.O_RDONLY | os.O_CLOEXEC)
        self.begin()

    def __del__(self) -> None:
        if self._fd >= 0:
            os.close(self._fd)

    def begin(self) -> None:
        """Count from now on."""
        self._begin_ns, self._counted = self._clock.now_ns(), self._count()

    def since_ns(self) -> int:
        """For how long the processor that was held up longest was not run [ns]; 0 below what the kernel resolves."""
        passed_ns = self._clock.now_ns() - self._begin_ns
        counted = zip(self._counted, self._count(), strict=False)
        stalled_ns = max((passed_ns - (now - then) * TICK_NS for then, now in counted), default=0)
        return stalled_ns if stalled_ns > RESOLVED_TICKS * TICK_NS else 0

    def _count(self) -> list[int]:
        """Of each processor the kernel's ticks in which it was run or had nothing to do."""
        if self._fd < 0:
            return []
        lines = os.pread(self._fd, STAT_BYTES, 0).split(b"\n")[1:]
        # Up to softirq: the next field is what was stolen, those after it are counted twice.
        return [sum(map(int, line.split()[1:8])) for line in lines if line.startswith(b"cpu")]


def ask_for_real_time() -> None:
    """Ask that this process does not wait for others (SCHED_FIFO); it goes on as it is where that is refused.

    Late ticks, and late answers of simulated servos, come from whatever else runs on the machine.
    """
    with contextlib.suppress(OSError):  # no CAP_SYS_NICE and no RTPRIO limit
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(10))


def ask_for_precedence(pid: int | None = None) -> None:
    """Ask that a process (None: this one) goes before what else is computed (niceness -10, as the installed service
    has); it goes on without.

    Linux weighs sessions before the niceness of what is in them (sched_autogroup): one that is the process's own is
    asked for as well.
    """
    pid = os.getpid() if pid is None else pid
    with contextlib.suppress(OSError):  # no CAP_SYS_NICE and no NICE limit; or a kernel without these groups
        os.setpriority(os.PRIO_PROCESS, pid, -10)
        if os.getsid(pid) == pid:
            with open(f"/proc/{pid}/autogroup", "w", encoding="ascii") as group:
                group.write("-10")
