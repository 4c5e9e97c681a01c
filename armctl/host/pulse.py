"""Heartbeats between the host and its control process: a process that hangs closes no socket.

Every `BEAT_S` the host says that it is there, in memory that both share (`heartbeat` in control/link.py); a control
process that hears nothing for 0.3 s slows the arm down (`Inbox` in control/process.py). And every time it looks whether
the next tick is overdue: a control process that hangs is killed, so that another one adopts the arm.
"""

import asyncio
import logging
from typing import Protocol

BEAT_S = 0.05
# How much later than its period a tick may come.
OVERDUE_S = 0.5
# Longest wait for the first tick.
START_S = 20.0

logger = logging.getLogger(__name__)


class Heart(Protocol):
    """A control process as far as it can hang."""

    def beat(self) -> None: ...
    def kill(self) -> None: ...


class Pulse:
    """How long the next tick may still take.

    Counted in looks, not by a clock: a host that hung itself has not looked meanwhile, and a slow one looks less often.
    """

    def __init__(self, period_s: float, overdue_s: float = OVERDUE_S) -> None:
        self._usual_s = period_s + overdue_s
        self._left_s = START_S

    def ticked(self) -> None:
        """A tick has come."""
        self._left_s = self._usual_s

    def overdue(self) -> bool:
        """Look once, `BEAT_S` after the last time: whether the tick should have come."""
        self._left_s -= BEAT_S
        return self._left_s < 0.0


async def beat(control: Heart, pulse: Pulse) -> None:
    """Say that the host is there, until a tick is overdue; then end the control process."""
    while not pulse.overdue():
        control.beat()
        await asyncio.sleep(BEAT_S)
    logger.error("the control process hangs: no tick came in time; it is killed, and another one adopts the arm")
    control.kill()
