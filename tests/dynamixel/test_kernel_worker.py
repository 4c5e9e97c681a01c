"""The byte that overtakes no other: how late the kernel is, on real pseudo terminals."""

import os

import pytest

from armctl.clock import NS_PER_S, MonotonicClock
from armctl.dynamixel.kernel_worker import KernelWorker

PATIENCE_NS = 60 * NS_PER_S
SHORT_NS = 5_000_000


class StuckWorker(KernelWorker):
    """One whose bytes go no farther than `hand_on` lets them."""

    def __init__(self) -> None:
        super().__init__()
        self._through = os.dup(self._near)
        self._kept, ours = os.pipe()
        os.dup2(ours, self._near)
        os.close(ours)

    def hand_on(self) -> bytes:
        kept = os.read(self._kept, 256)
        os.write(self._through, kept)
        return kept

    def close(self) -> None:
        super().close()
        os.close(self._through)
        os.close(self._kept)


@pytest.mark.pty
def test_a_byte_comes_through_again_and_again() -> None:
    worker, clock = KernelWorker(), MonotonicClock()
    for _ in range(600):  # more than a byte can count
        assert worker.delay_ns(clock, clock.now_ns() + PATIENCE_NS) < PATIENCE_NS
    worker.close()


@pytest.mark.pty
def test_a_byte_that_does_not_come_is_waited_for_until_the_end_of_patience() -> None:
    worker, clock = StuckWorker(), MonotonicClock()
    assert worker.delay_ns(clock, clock.now_ns() + SHORT_NS) >= SHORT_NS
    worker.close()


@pytest.mark.pty
def test_a_byte_of_an_earlier_look_is_not_taken_for_this_one() -> None:
    worker, clock = StuckWorker(), MonotonicClock()
    worker.delay_ns(clock, clock.now_ns())
    assert worker.hand_on() == b"\x01"
    assert worker.delay_ns(clock, clock.now_ns() + SHORT_NS) >= SHORT_NS
    assert worker.hand_on() == b"\x02"
    worker.close()
