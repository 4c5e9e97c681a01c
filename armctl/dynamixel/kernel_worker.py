"""Whether the kernel keeps up with handing received bytes on.

What a terminal receives, serial or pseudo, a worker of the kernel carries to whoever reads. It has ordinary priority:
busy processes hold it up for milliseconds, now and then for most of a second, also where the reader has real-time
priority. A reply that is kept back so looks like a servo that does not answer. But one worker serves all terminals, in
order: a byte sent through a terminal of one's own arrives behind every reply that has come before.
"""

import os
import select
import tty

from armctl.clock import NS_PER_S, Clock


class KernelWorker:
    """A terminal of one's own, to send a byte through."""

    def __init__(self) -> None:
        self._near, self._far = os.openpty()
        tty.setraw(self._far)
        # Edge-triggered: asking a terminal that has no bytes would itself wait for the worker, however long.
        self._arrivals = select.epoll()
        self._arrivals.register(self._far, select.EPOLLIN | select.EPOLLET)
        self._count = 0

    def close(self) -> None:
        self._arrivals.close()
        os.close(self._near)
        os.close(self._far)

    def delay_ns(self, clock: Clock, until_ns: int) -> int:
        """How long the worker takes to hand a byte on [ns]; it is waited for until `until_ns` at most."""
        begin_ns = clock.now_ns()
        self._count = self._count % 255 + 1
        os.write(self._near, bytes((self._count,)))
        while (left_ns := until_ns - clock.now_ns()) > 0:
            if not select.select((self._arrivals,), (), (), left_ns / NS_PER_S)[0]:
                break
            if self._arrivals.poll(0) and os.read(self._far, 256)[-1] == self._count:
                break
        return clock.now_ns() - begin_ns
