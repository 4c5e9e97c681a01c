"""Connecting: what makes the servos behind a bus unfit for an arm.

Rules:

1. It goes on in steps, each of them one request or a short listening, so that whoever has other things to do on the bus
   does them in between. Before each step it says how long a silent servo makes it.
2. What a reply that comes late on a busy machine may look like (a silent servo, a second one with its id, a slow
   adapter) is believed only if it shows again and again.
3. Between two steps the port's allowance for the adapter is that of the samples.
"""

from collections.abc import Generator, Sequence
from statistics import median
from typing import TypeVar

from armctl.dynamixel import ax12a
from armctl.dynamixel.bus import BUS_NOISE, NO_REPLY, PORT_GONE, STATUS_BLOCK, Reply, ServoBus
from armctl.dynamixel.fitness import DOUBLED, SILENT, ServoJoint, bus_dead, problem, slow_adapter, table_problems, whose
from armctl.dynamixel.packet import OVERHEAD_BYTES
from armctl.dynamixel.port import ADAPTER_LATENCY_MS, MARGIN_MS, NS_PER_MS, QUIET_MS, RETURN_DELAY_WORST_US
from armctl.messages import Problem

# For how long a busy machine may make replies late.
PATIENCE_NS = 300 * NS_PER_MS
# Allowance while identifying: an adapter with the 16 ms latency timer is slow, not silent.
IDENTIFY_LATENCY_MS = 20.0
# Six reads with this much each fit half a tick of 100 ms; the usual timers are 1 and 16 ms.
SLOW_ADAPTER_MS = 8.0
# Reads of changing registers per servo that tell two servos with one id.
DUPLICATE_PROBES = 3
# How long the line is to be silent before each reading that confirms a suspicion, and at one go.
CONFIRM_QUIET_MS = (20.0, 40.0, 80.0, 160.0)
# How often that is done before two servos are told of: a cable that garbles one reply in ten may do so once.
CONFIRMATIONS = 2
LISTEN_MS = 10.0
# Listenings to a line that does not fall silent.
LISTENINGS = 30
# Further readings of an adapter that seems slow.
LATENCY_PROBES = 6

EEPROM = (0, ax12a.EEPROM_END)
FOREVER_NS = 2**63

T = TypeVar("T")
# Yields how long the next step may take [ns]; nothing is done before it is asked for.
Steps = Generator[int, None, T]


class Identification:
    """Identifying the servos of an arm, now and then a little.

    Args:
        arm: What the arm is called.
    """

    def __init__(self, bus: ServoBus, joints: Sequence[ServoJoint], arm: str) -> None:
        self._port, self._steps = bus.port, identify(bus, joints, arm)
        self._needs_ns = next(self._steps)

    def advance(self, until_ns: int = FOREVER_NS) -> tuple[Problem, ...] | None:
        """Go on for as long as silent servos let it end in time, at least by a step.

        Returns:
            Everything that makes the bus unfit; None: it has not come to its end.
        """
        now_ns = self._port.begin_round()
        self._port.begin_round(min(PATIENCE_NS, until_ns - now_ns))
        try:
            while True:
                self._needs_ns = next(self._steps)
                if self._port.clock.now_ns() + self._needs_ns > until_ns:
                    return None
        except StopIteration as end:
            return tuple(end.value)


def identify(bus: ServoBus, joints: Sequence[ServoJoint], arm: str) -> Steps[tuple[Problem, ...]]:
    """Everything that makes this bus unfit for an arm with these joints; empty: fit.

    Also measures the adapter's latency, and says in `bus.firmware` what the servos run.
    """
    yield 0
    problems = whose((yield from _problems(bus, joints)), arm) if bus.is_open else []
    return tuple(problems) if bus.is_open else (Problem(PORT_GONE, bus.closed_because),)


def _problems(bus: ServoBus, joints: Sequence[ServoJoint]) -> Steps[list[Problem]]:
    port, tables = bus.port, list[Reply]()
    for joint in joints:
        tables.append((yield from _read_table(bus, joint, tries=2)))
    if all(table.problem for table in tables):
        bus.allow_latency(ADAPTER_LATENCY_MS)
        garbled = any(table.problem == BUS_NOISE for table in tables)
        return [bus_dead(len(tables), garbled, port.port_name, port.baudrate)]
    for quiet_ms in CONFIRM_QUIET_MS:
        if not any(table.problem for table in tables):
            break
        yield from _silence(bus, quiet_ms)
        for index, joint in enumerate(joints):
            if tables[index].problem:
                tables[index] = yield from _read_table(bus, joint)
    bus.firmware = tuple(-1 if it.problem else ax12a.register_value(ax12a.FIRMWARE, it.data, 0) for it in tables)
    problems = yield from _adapter_problems(bus, joints, tables)
    for joint, table in zip(joints, tables, strict=True):
        if table.problem == NO_REPLY:
            problems.append(problem("SERVO_SILENT", joint, SILENT))
        elif table.problem or (yield from _answers_twice(bus, joint.servo_id)):
            problems.append(problem("DUPLICATE_ID", joint, DOUBLED))
        else:
            problems += table_problems(joint, table.data, port.port_name)
    return problems


def _adapter_problems(bus: ServoBus, joints: Sequence[ServoJoint], tables: Sequence[Reply]) -> Steps[list[Problem]]:
    """Judge the adapter by its faster replies, less wire time and that servo's own return delay.

    By the lower quartile: a busy machine is slow now and then, a slow adapter is fast now and then, when a reply
    meets its timer just before that fires.
    """

    def added(replies: Sequence[Reply]) -> list[float]:
        return sorted(added_ms(bus, reply) for reply in replies if not reply.problem)

    latencies_ms = added(tables)
    if median(latencies_ms) > SLOW_ADAPTER_MS:
        answering = next(joint for joint, table in zip(joints, tables, strict=True) if not table.problem)
        probes = list[Reply]()
        for _ in range(LATENCY_PROBES):
            probes.append((yield from _read_table(bus, answering)))
        latencies_ms = added([*tables, *probes])
    latency_ms, allowance_ms = latencies_ms[len(latencies_ms) // 4], max(ADAPTER_LATENCY_MS, median(latencies_ms))
    slow = latency_ms > SLOW_ADAPTER_MS
    bus.allow_latency(allowance_ms if slow else min(allowance_ms, SLOW_ADAPTER_MS))
    return [slow_adapter(bus.port.port_name, latency_ms, SLOW_ADAPTER_MS)] if slow else []


def added_ms(bus: ServoBus, table: Reply) -> float:
    """What the adapter added to a servo's EEPROM on its way [ms]."""
    delay_ms = 0.002 * ax12a.register_value(ax12a.RETURN_DELAY, table.data, 0)
    return (table.elapsed_ns - _wire_ns(bus, EEPROM)) / NS_PER_MS - delay_ms


def answers_twice(bus: ServoBus, servo_id: int) -> bool:
    """Whether more than one servo answers to an id: replies with changing content collide, or follow each other.

    As far as their replies differ; False without a port. With the port's present allowance for the adapter.
    """
    steps = _answers_twice(bus, servo_id)
    try:
        while True:
            next(steps)
    except StopIteration as end:
        return bool(end.value)


def _answers_twice(bus: ServoBus, servo_id: int) -> Steps[bool]:
    doubled = 0
    for _ in range(DUPLICATE_PROBES):
        doubled += yield from _is_doubled(bus, servo_id)
    if doubled <= DUPLICATE_PROBES // 2:
        return False
    for _ in range(CONFIRMATIONS):
        doubled = 0
        for quiet_ms in CONFIRM_QUIET_MS:
            yield from _silence(bus, quiet_ms)
            doubled += yield from _is_doubled(bus, servo_id)
        if doubled < len(CONFIRM_QUIET_MS) - 1:
            return False
    return True


def _is_doubled(bus: ServoBus, servo_id: int) -> Steps[bool]:
    yield _needs_ns(bus, STATUS_BLOCK, bus.latency_ms)
    return bus.read_block(servo_id, *STATUS_BLOCK, tries=1).problem == BUS_NOISE or bus.drain() > 0


def _read_table(bus: ServoBus, joint: ServoJoint, tries: int = 1) -> Steps[Reply]:
    """A servo's EEPROM, at a slow adapter's pace."""
    reply = Reply(problem=NO_REPLY)
    for _ in range(tries):
        yield _needs_ns(bus, EEPROM, IDENTIFY_LATENCY_MS)
        bus.port.allow_latency(IDENTIFY_LATENCY_MS)
        reply = bus.read_block(joint.servo_id, *EEPROM, tries=1)
        bus.port.allow_latency(bus.latency_ms)
        if not reply.problem:
            break
    return reply


def _silence(bus: ServoBus, quiet_ms: float) -> Steps[None]:
    """Listen until the line has been silent for so long, all in all; one that goes on speaking is not waited for."""
    silent_ms = 0.0
    for _ in range(LISTENINGS):
        yield round(LISTEN_MS * NS_PER_MS)
        silent_ms = 0.0 if bus.drain(LISTEN_MS, rounds=2) else silent_ms + LISTEN_MS
        if silent_ms >= quiet_ms:
            return


def _wire_ns(bus: ServoBus, block: tuple[int, int]) -> int:
    return (2 * OVERHEAD_BYTES + 2 + block[1]) * bus.port.byte_ns


def _needs_ns(bus: ServoBus, block: tuple[int, int], latency_ms: float) -> int:
    """How long a read takes that nobody answers, until the line has fallen quiet."""
    waited_ms = RETURN_DELAY_WORST_US / 1000.0 + latency_ms + MARGIN_MS + QUIET_MS
    return _wire_ns(bus, block) + 4 * bus.port.byte_ns + round(waited_ms * NS_PER_MS)
