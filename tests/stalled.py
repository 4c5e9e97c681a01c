"""What the kernel of a virtual machine counts of its processors, which its host machine does not always run."""

import os
from pathlib import Path

from armctl.clock import NS_PER_S, Stalls, VirtualClock

TICK_NS = NS_PER_S // os.sysconf("SC_CLK_TCK")
GUEST, OWN = "fpu hypervisor lm", "fpu lm"


class Machine:
    """Two processors, and a folder like /proc that tells of them."""

    def __init__(self, folder: Path, clock: VirtualClock | None = None, flags: str = GUEST) -> None:
        self.folder, self.clock, self.counted = folder, clock or VirtualClock(), [100, 200]
        (folder / "cpuinfo").write_text(f"processor : 0\nflags\t\t: {flags}\n")
        self.run(0)
        self.stalls = Stalls(self.clock, folder)

    def run(self, ticks: int, processors: tuple[int, ...] = (0, 1)) -> None:
        """Let time pass in which these processors are run; what the others lose is stolen sooner or later."""
        self.clock.advance_ns(ticks * TICK_NS)
        for index in processors:
            self.counted[index] += ticks
        rows = [f"cpu{index} {count - 9} 1 2 3 2 1 0 {7 * count} 5 5" for index, count in enumerate(self.counted)]
        (self.folder / "stat").write_text("\n".join(["cpu  1 2 3 4 5 6 7 8 9 10", *rows, "intr 5 1 1", ""]))
