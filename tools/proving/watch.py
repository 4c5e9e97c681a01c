"""The servos of an arm seen from outside, packet by packet: what the judge of an episode looks at."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from itertools import chain, repeat

import numpy as np

from armctl.clock import NS_PER_S, VirtualClock
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.gravity import PointMasses
from armctl.sim.loopback import LoopbackPort
from proving.evidence import Sent, Servo, Strain
from proving.invariants import Judge
from proving.reading import (
    BROADCAST_ID,
    GOAL,
    MOVING_SPEED,
    PING,
    PRESENT_POSITION,
    READ,
    REG_WRITE,
    STATUS_BEGIN,
    STATUS_SIZE,
    SYNC_WRITE,
    TICK_MAX,
    TORQUE_ENABLE,
    TORQUE_LIMIT,
    WRITE,
    Arm,
    At,
)
from proving.readings import Heard

# Bytes of a good reply to a READ of 24..49.
STATUS_REPLY = STATUS_SIZE + 6
# A reply from so far off the servo's own sensor is another's: noise and 1 ms of motion are less.
ELSEWHERE_TICKS = 8.0
# The supply at which a motor gives its stall torque.
RATED_V = 12.0
# What an arm may carry at its tool.
CARRIED_KG = 0.15
# Of the stall torque of its table a sound motor may have so much.
WEAK = 0.8
# Places in such a reply behind its header.
TORQUE_AT = 3 + TORQUE_ENABLE.address - STATUS_BEGIN
GOAL_AT = 3 + GOAL.address - STATUS_BEGIN
POSITION_AT = 3 + PRESENT_POSITION.address - STATUS_BEGIN
WATCHED = (TORQUE_LIMIT, GOAL, MOVING_SPEED)


class Killed(BaseException):
    """SIGKILL, as far as code can tell: nothing catches it."""


class WatchedPort(LoopbackPort):
    """A port that shows the judge what passes."""

    def __init__(self, bus: SimulatedBus, clock: VirtualClock, watch: Watch) -> None:
        super().__init__(bus, clock)
        self._watch = watch

    def _check(self) -> None:
        # To ask whether the adapter is plugged in moves the whole arm first; most of the time nothing can unplug it.
        if self._watch.unpluggable or not self.is_open:
            super()._check()

    def readPort(self, length: int) -> bytes:
        data = super().readPort(length)
        self._watch.received += data
        return data

    def _send(self, packet: bytes) -> int:
        watch = self._watch
        watch.before(packet, self.clock.now_ns())
        arrives = watch.spoil(packet, self.clock.now_ns())
        if arrives:
            super()._send(arrives)
        else:
            self._check()
        watch.after(self.clock.now_ns())
        return len(packet)


class Watch:
    """The servos of an arm, seen from outside: before and after each packet, and once a tick."""

    def __init__(self, arm: Arm, body: SimulatedArm, judge: Judge) -> None:
        self.received = bytearray()
        # Everything the host ever said.
        self.wire = hashlib.blake2b(digest_size=16)
        self.packets = 0
        # Raises `Killed` once so many packets are sent.
        self.kill_at = -1
        # What becomes of a packet of the host on its way to the servos.
        self.spoil: Callable[[bytes, int], bytes] = lambda packet, now_ns: packet
        # Whether the adapter may be out of the host.
        self.unpluggable = False
        # When it surely will not be.
        self._plugged_ns = -1
        self._body, self._judge, self._arm = body, judge, arm
        self._index = {servo_id: i for i, servo_id in enumerate(arm.servo_ids)}
        self._heads = {servo_id: bytes((0xFF, 0xFF, servo_id, STATUS_REPLY - 4)) for servo_id in arm.servo_ids}
        # Which servo was asked for its status last, and when [ns].
        self._pending: int | None = None
        self._pending_ns = 0
        # Of the whole arm: what holds a joint up takes its weight, which nobody can tell from a push.
        self._carried = PointMasses(body.chain, (*body.points_kg[:-1], body.points_kg[-1] + CARRIED_KG))
        self._writes = [-1] * len(body.servos)
        self._servos = [Servo(False, 0, 0, 0, 0.0, 0) for _ in body.servos]
        # Whether this tick's readings are not a sample's alone.
        self._identifying = False
        # How often each servo was asked for its status in this tick.
        self._asked: dict[int, int] = {}
        # Which of them were heard.
        self._heard: set[int] = set()
        self._sent: list[Sent] = []
        self._before: list[Servo] = []
        # The good replies of this tick, and when whose EEPROM was read last [ns].
        self.replies: dict[int, Heard] = {}
        self.identified_ns: dict[int, int] = {}

    def now_s(self, now_ns: int) -> float:
        """The judge's time: the clock's."""
        return now_ns / NS_PER_S - 1.0

    def unplugged(self, until_s: float) -> None:
        """The adapter will be out of the host, and back at that time."""
        self.unpluggable = True
        self._plugged_ns = max(self._plugged_ns, round((until_s + 1.1) * NS_PER_S))

    def before(self, packet: bytes, now_ns: int) -> None:
        """A packet is about to leave the host."""
        if self.packets == self.kill_at:  # before the first of a tick
            raise Killed
        self.packets += 1
        self.wire.update(packet)
        self.hear(now_ns)
        self._sent = []
        if packet[4] == READ:
            if packet[5] == STATUS_BEGIN:
                self._pending, self._pending_ns = packet[2], now_ns
                index = self._index[packet[2]]
                # A sample goes through the servos once, and asks none again that it has heard.
                self._identifying |= index in self._heard or index < max(self._asked, default=0)
                self._asked[index] = self._asked.get(index, 0) + 1
            else:
                self._identifying = True
                self.identified_ns[packet[2]] = now_ns
            return
        if packet[4] == PING:
            return
        self._sent = list(_writes(packet, self._index))
        # The servos act on a packet's last byte; where the arm is by then does not depend on who asks first.
        self._body.advance(now_ns + len(packet) * 10_000)
        self._before = [_copy(servo) for servo in self.servos()]

    def after(self, now_ns: int) -> None:
        """It has arrived."""
        if self._sent:
            self._judge.wrote(self.now_s(now_ns), self._sent, self._before, self.servos())
            self._sent = []
        if self.packets == self.kill_at:
            raise Killed

    def hear(self, now_ns: int) -> None:
        """Whatever has come from the servo asked last is all that came."""
        pending, received = self._pending, self.received
        at = -1 if pending is None else received.find(self._heads[pending])
        while pending is not None and at >= 0:  # what looks like its head may be the rest of a broken reply
            reply = received[at + 2 : at + STATUS_REPLY]
            if len(reply) == STATUS_REPLY - 2 and sum(reply) & 0xFF == 0xFF:
                index = self._index[pending]
                self.replies[index] = Heard(reply[2], bytes(reply[3:-1]))
                torque, goal = reply[TORQUE_AT], reply[GOAL_AT] | reply[GOAL_AT + 1] << 8
                position = reply[POSITION_AT] | reply[POSITION_AT + 1] << 8
                asked_s = self.now_s(self._pending_ns)
                self._judge.heard(self.now_s(now_ns), index, position, goal if torque else None, asked_s=asked_s)
                self._heard.add(index)
                if abs(position - self._sensed(index)) > ELSEWHERE_TICKS:
                    self._judge.told_elsewhere(self.now_s(now_ns), index)
                break
            at = received.find(self._heads[pending], at + 1)
        self._pending = None
        received.clear()

    def end_tick(self, now_ns: int, complete: bool) -> None:
        """The control process has done what it does in a tick; `complete`: and its port is there."""
        self.hear(now_ns)
        self.unpluggable &= now_ns <= self._plugged_ns
        faults = self._body.faults
        # A reply that comes while the line is being drained is heard here, and rightly not there.
        late = faults.in_force("late") or faults.in_force("latency")
        sampled = complete and not self._identifying and not late
        asked = self._asked if sampled else {}
        unheard = [(index, often) for index, often in asked.items() if index not in self._heard]
        self._judge.polled(self.now_s(now_ns), unheard, len(self._heard) if sampled else 0, sum(asked.values()))
        self._asked.clear()
        self._heard.clear()
        self._identifying = False

    def servos(self) -> Sequence[Servo]:
        """Every servo now; the list is the same one each time."""
        for i, (servo, known) in enumerate(zip(self._body.servos, self._servos, strict=True)):
            known.shaft_tick = servo.position_tick
            known.sensed_tick = self._sensed(i)
            if servo.writes != self._writes[i]:
                self._writes[i] = servo.writes
                known.limit, known.goal, known.speed = (_value(servo.table, register) for register in WATCHED)
                known.torque = servo.torque_enabled and known.limit > 0
        return self._servos

    def _sensed(self, i: int) -> int:
        """What a servo's own sensor reads, without noise."""
        servo = self._body.servos[i]
        shown = math.floor(servo.position_tick + 0.5) if servo.frozen_tick is None else servo.frozen_tick
        return min(max(shown, 0), TICK_MAX)  # what ten bits can say of it

    def strains(self) -> list[Strain]:
        """What each motor works, and what its servo feels, now."""
        joints = self._body._joints
        carried = self._carried.loads([joint.position_rad() for joint in joints])
        # Two on one shaft bear half each, if both can.
        bears: list[tuple[float, float]] = [
            (joint.gravity_Nm, joint.direction * Nm)
            for joint, (Nm, _) in zip(joints, chain(carried, repeat((0.0, 0.0))), strict=False)
        ]
        for k, second in enumerate(self._arm.servos):
            if second.beside >= 0:
                first = second.beside
                share = 0.5 if all(joints[i].drive.enabled and not joints[i].dead_motor for i in (first, k)) else 1.0
                gravity_Nm, carrying_Nm = bears[first]
                bears[first] = share * gravity_Nm, share * carrying_Nm
                way = share * second.direction * self._arm.servos[first].direction
                bears[k] = way * gravity_Nm, way * carrying_Nm
        return [
            Strain(
                joint.servo.output,
                -gravity_Nm / (full_Nm := joint.stall_Nm * max(joint.servo.voltage_V, 1.0) / RATED_V),
                joint.servo.voltage_V,
                joint.servo.temperature_degC,
                -carrying_Nm / (WEAK * full_Nm),
            )
            for joint, (gravity_Nm, carrying_Nm) in zip(joints, bears, strict=True)
        ]


def _value(table: bytearray, register: At) -> int:
    return int.from_bytes(table[register.address : register.address + register.size], "little")


def _copy(servo: Servo) -> Servo:
    return Servo(servo.torque, servo.goal, servo.speed, servo.limit, servo.shaft_tick, servo.sensed_tick)


def _writes(packet: bytes, index: dict[int, int]) -> list[Sent]:
    """What a packet of the host tells each servo."""
    parameters = packet[5:-1]
    if packet[4] in (WRITE, REG_WRITE):
        asked = index.values() if packet[2] == BROADCAST_ID else (index[packet[2]],)
        return [Sent(i, parameters[0], parameters[1:]) for i in asked]
    if packet[4] == SYNC_WRITE:
        size = parameters[1] + 1
        rows = [parameters[at : at + size] for at in range(2, len(parameters), size)]
        return [Sent(index[row[0]], parameters[0], row[1:]) for row in rows]
    return [Sent(i, 0, b"\0") for i in index.values()]  # RESET and whatever else changes the table


def damaged(packet: bytes, how: str, rng: np.random.Generator) -> bytes:
    """What is left of a packet of the host: nothing of it, a part, all but a byte, or all with a bit turned over."""
    if how == "dropped":
        return b""
    if how == "cut":
        return packet[: int(rng.integers(1, len(packet)))]
    while True:
        at = int(rng.integers(len(packet)))
        if how == "flipped":
            return packet[:at] + bytes((packet[at] ^ 1 << int(rng.integers(8)),)) + packet[at + 1 :]
        left = packet[:at] + packet[at + 1 :]
        if sum(left[2:]) & 0xFF:  # else the next packet's first byte would make a good checksum
            return left
