"""What really happened to a simulated arm, kept for those who compare."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from armctl.kinematics.transform import FloatArray

TRUTH_S = 1200
TRUTH_PERIOD_NS = 10_000_000


@dataclass(frozen=True)
class Truth:
    """What really happened, every 10 ms."""

    # Monotonic, shape (m,).
    time_ns: NDArray[np.int64]
    # Shape (m, 3).
    tool_m: FloatArray
    # Shape (m, n).
    joints_rad: FloatArray


class TruthRing:
    """True joint positions, the newest `TRUTH_S` of them."""

    def __init__(self, joints: int) -> None:
        size = TRUTH_S * 1_000_000_000 // TRUTH_PERIOD_NS
        self._time_ns = np.zeros(size, dtype=np.int64)
        self._joints_rad = np.zeros((size, joints))
        self._count = 0

    def add(self, time_ns: int, joints_rad: FloatArray) -> None:
        """Keep one sample; times must not decrease."""
        at = self._count % self._time_ns.size
        self._time_ns[at] = time_ns
        self._joints_rad[at] = joints_rad
        self._count += 1

    def between(self, begin_ns: int, end_ns: int) -> tuple[NDArray[np.int64], FloatArray]:
        """Times [ns], shape (m,), and joint positions [rad], shape (m, n), with begin_ns <= time <= end_ns."""
        size = self._time_ns.size
        oldest = max(0, self._count - size)
        order = np.arange(oldest, self._count) % size
        times = self._time_ns[order]
        chosen = order[np.searchsorted(times, begin_ns) : np.searchsorted(times, end_ns, side="right")]
        return self._time_ns[chosen], self._joints_rad[chosen]
