"""A simulated arm as somebody put it together, with mistakes, and the person who stands beside it in its set-up."""

import math
import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armctl.clock import VirtualClock
from armctl.commissioning.finding import Opened, Prepared
from armctl.config import ArmConfig
from armctl.dynamixel.bus import ServoBus
from armctl.files import load_arm
from armctl.kinematics.chain import forward_kinematics
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault
from armctl.sim.hand import Hand
from armctl.sim.spec import DEFAULT_SPEC
from armctl.sim.virtual_arm import VirtualArm
from proving.reading import TICK_DEG, TICK_MAX

HORN_DEG = 40.0
# EEPROM registers of the e-manual that the truth is read from: addresses of id and baud.
ID_AT, BAUD_AT = 3, 4
BAUDS = (34, 16, 3)
PERIOD_S = 0.1
# In the base frame: x ahead, y left, z up.
WAYS = {"forward": (0, 1), "backward": (0, -1), "left": (1, 1), "right": (1, -1), "up": (2, 1), "down": (2, -1)}
VIEWS = {"front": 0, "left": 1, "above": 2}


class SteadyHand(Hand):
    """Leads every joint of a limp arm to where it is wanted, and holds it there, but for one that it leaves free."""

    CARRY_S = 2.0

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm.config, arm.chain, lambda: arm.time_s, arm.true_positions)
        self._arm = arm
        self._from_rad: np.ndarray | None = None
        self.to_rad = np.zeros(0)
        self._begin_s = 0.0
        # The joint that it does not hold.
        self.free: int | None = None

    @property
    def holding(self) -> bool:
        return self._from_rad is not None

    def carry(self, to_rad: np.ndarray) -> None:
        """Begin to lead the joints there [rad], shape (joints,)."""
        now_s = self._arm.time_s
        self._from_rad = np.array(self.aim(now_s)[0]) if self.holding else self._arm.true_positions()
        self._begin_s, self.to_rad, self.free = now_s, to_rad, None

    def release(self) -> None:
        self._from_rad = None

    def aim(self, time_s: float) -> tuple[list[float], list[float]]:
        assert self._from_rad is not None
        u = min((time_s - self._begin_s) / self.CARRY_S, 1.0)
        way = self.to_rad - self._from_rad
        aims = (self._from_rad + u * u * (3.0 - 2.0 * u) * way).tolist()
        speeds = (6.0 * u * (1.0 - u) / self.CARRY_S * way).tolist()
        if (free := self.free) is not None:  # goes along with what the joint does by itself
            joint, servo = self._arm.config.joints[free], self._arm.servos[free]
            aims[free] = joint.position_rad(servo.shaft_rad / math.radians(TICK_DEG))
            speeds[free] = joint.direction * servo.velocity_rad_s
        return aims, speeds


class WatchedBus(SimulatedBus):
    """The line to the servos, and what is seen of the arm whenever a packet is on it."""

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm)
        # What must not have been, and the person's word that something may move now.
        self.broken: list[str] = []
        self.allowed: set[int] = set()
        # Of the servo that had torque last: where the joints truly were when it got it, and farthest from there.
        self.began_rad = self.farthest_rad = np.zeros(0)
        self._powered: tuple[bool, ...] = ()

    def receive(self, data: bytes, now_ns: int) -> None:
        super().receive(data, now_ns)
        powered = tuple(servo.torque_enabled for servo in self.arm.servos)
        if not any(powered):
            self._powered = powered
            return
        positions = self.arm.true_positions()
        if powered != self._powered:
            self._powered, self.began_rad, self.farthest_rad = powered, positions, positions
        if np.abs(positions - self.began_rad).max() > np.abs(self.farthest_rad - self.began_rad).max():
            self.farthest_rad = positions
        for index, (joint, q) in enumerate(zip(self.arm.config.joints, np.degrees(positions), strict=True)):
            low, high = (
                limit + sign * self.arm.spec.stop_deg for limit, sign in zip(joint.limits_deg, (-1, 1), strict=True)
            )
            if powered[index] and not low < q < high:
                self.broken.append(f"{joint.name} is at a stop with torque on, {q:.1f} deg")
            if powered[index] and index not in self.allowed:
                self.broken.append(f"{joint.name} has torque, and nobody said that it is free")


@dataclass
class Arm:
    """A simulated arm as it was put together, and what was done to it."""

    kind: ArmConfig
    true: ArmConfig
    defects: tuple[str, ...]
    # Joints with a horn whose range the servo does not see.
    blind: tuple[str, ...]
    simulated: SimulatedArm
    wire: WatchedBus
    virtual: VirtualArm


def assembled(seed: int, defects: Sequence[str], kind: str, clock: VirtualClock | None = None) -> Arm:
    """An arm of a kind with these defects, at joints that the seed draws, and the factory's angle limits.

    Args:
        clock: That of its begin; None: one of its own.
    """
    rng, made = np.random.default_rng((seed, 31)), load_arm(kind)
    n = len(made.joints)
    joints = list(made.joints)
    order = rng.permutation(n).tolist()
    a, b, c, d = (order[k % n] for k in range(4))
    blind: tuple[str, ...] = ()
    if "swapped" in defects:
        ids = joints[a].servo_id, joints[b].servo_id
        joints[a], joints[b] = (joints[k].model_copy(update={"servo_id": i}) for k, i in ((a, ids[1]), (b, ids[0])))
    if "reversed" in defects:
        middle = math.radians(sum(joints[c].limits_deg) / 2.0)
        zero = joints[c].tick(middle) + joints[c].direction * middle / math.radians(TICK_DEG)
        joints[c] = joints[c].model_copy(update={"direction": -joints[c].direction, "zero_tick": zero})
    if "horn" in defects:
        off = float(rng.uniform(5.0, HORN_DEG) * rng.choice((-1, 1))) / TICK_DEG
        joints[d] = joints[d].model_copy(update={"zero_tick": joints[d].zero_tick + off})
        stops = [joints[d].tick(math.radians(limit)) for limit in joints[d].limits_deg]
        blind = (joints[d].name,) if min(stops) < 12.0 or max(stops) > TICK_MAX - 12.0 else ()
    true = made.model_copy(update={"joints": tuple(joints)})
    simulated = SimulatedArm(true, seed=seed, spec=replace(DEFAULT_SPEC, zero_offset_tick=0.0))
    servos, low, high = simulated.servos, 6, 8
    for servo in servos:
        servo.table[low : low + 2], servo.table[high : high + 2] = b"\0\0", TICK_MAX.to_bytes(2, "little")
    if "strange" in defects:
        servos[b].table[ID_AT] = 77
    if "shared" in defects:
        servos[a].table[ID_AT] = servos[d].table[ID_AT]
    if "baud" in defects:
        servos[c].table[BAUD_AT] = BAUDS[seed % len(BAUDS)]
    wire = WatchedBus(simulated)
    virtual = VirtualArm(simulated, PERIOD_S, clock=clock, wire=wire)
    simulated.advance(virtual.clock.now_ns())
    if "missing" in defects:
        simulated.faults.begin(Fault(kind="mute", servo_id=true.servo_ids[b]), simulated.time_s)
    simulated.hand = SteadyHand(simulated)
    return Arm(made, true, tuple(defects), blind, simulated, wire, virtual)


class Person(Prepared):
    """Who stands beside a simulated arm: does what a question asks for; the answers are those of a file."""

    def __init__(self, arm: Arm, file: Path, wait: Callable[[float], None] | None = None) -> None:
        """
        Args:
            wait: Lets so many seconds pass; None: they pass in virtual time.
        """
        super().__init__(file)
        self.arm = arm
        self._wait = wait or self._pass_by
        self._muted: list[int] = []

    def ask(self, key: str, text: str, choices: Sequence[str] = ()) -> str:
        answer = super().ask(key, text, choices)
        name, _, what = key.rpartition(".")
        if what in ("one_end", "the_other_end", "open", "closed"):
            self._lead(name, what)
        elif what.isdecimal() and name in ("alone", "back"):
            self._unplug(int(what)) if name == "alone" else self._plug()
        elif what == "free":
            self._hand.free = self._index(name)
            self.arm.wire.allowed = {self._index(name)}
        elif what == "went":
            self.arm.wire.allowed = set()
            if (answer == "yes") != self._saw(text, self._index(name)):
                self.arm.wire.broken.append(f"{key}: {answer} is prepared, and it is not what is seen: {text}")
        elif key in ("middle", "bend"):
            shift = np.radians(np.linspace(-20.0, 20.0, len(self.arm.kind.joints)))
            self._hold(self._middle() + (shift if key == "bend" else 0.0))
        elif key == "zero":
            self._hold(self._named(text))
        elif key in ("rest", "motion"):
            self._hold(np.array([joint.rest_rad for joint in self.arm.kind.joints]))
            self._hand.release()
            self._wait(1.0)
            self.arm.wire.allowed = set(range(len(self.arm.kind.joints))) if key == "motion" else set()
        return answer

    @property
    def _hand(self) -> SteadyHand:
        hand = self.arm.simulated.hand
        assert isinstance(hand, SteadyHand)
        return hand

    def _index(self, name: str) -> int:
        return self.arm.kind.joint_names.index(name)

    def _middle(self) -> np.ndarray:
        return np.radians([sum(joint.limits_deg) / 2.0 for joint in self.arm.kind.joints])

    def _lead(self, name: str, end: str) -> None:
        index, gripper = self._index(name), self.arm.kind.gripper
        low, high = self.arm.kind.joints[index].limits_deg
        pushed = self.arm.simulated.spec.stop_deg + 0.5
        wanted = {"one_end": low - pushed, "the_other_end": high + pushed}
        if gripper is not None:
            wanted |= {"open": gripper.open_deg, "closed": gripper.closed_deg}
        posture = self._middle()
        posture[index] = math.radians(wanted[end])
        self._hold(posture, exactly=end in ("open", "closed"))

    def _named(self, text: str) -> np.ndarray:
        """The pose that a text names: `base 0 deg, shoulder 90 deg`."""
        posture = self._middle()
        for name, degrees in re.findall(r"(\S+) (-?\d+) deg", text):
            posture[self._index(name)] = math.radians(float(degrees))
        return posture

    def _hold(self, posture: np.ndarray, *, exactly: bool = True) -> None:
        """Bring the arm to a posture and look: what weighs on it is made up for."""
        aim = posture
        for _ in range(3 if exactly else 1):
            self._hand.carry(aim)
            self._wait(SteadyHand.CARRY_S + 0.6)
            aim = aim + (posture - self.arm.simulated.true_positions())

    def _pass_by(self, seconds: float) -> None:
        self.arm.virtual.clock.advance_ns(round(seconds * 1e9))
        self.arm.simulated.advance(self.arm.virtual.clock.now_ns())

    def _saw(self, text: str, index: int) -> bool:
        """Whether the true tool did what a question asks."""
        began, farthest = self.arm.wire.began_rad, self.arm.wire.farthest_rad
        if (way := re.search(r"go (\w+)", text)) is not None:
            axis, sign = WAYS[way[1]]
            tool_m = self.arm.simulated.tool_positions(np.stack([began, farthest]))
            return bool(sign * (tool_m[1] - tool_m[0])[axis] > 0.0)
        ccw = 1.0 if "counter-clockwise" in text else -1.0
        if (view := re.search(r"seen from (?:the )?(\w+)", text)) is None:  # beyond the chain: only the joint is seen
            return bool(ccw * (farthest[index] - began[index]) > 0.0)
        n = self.arm.simulated.chain.n
        before, after = (forward_kinematics(self.arm.simulated.chain, q[:n])[:3, :3] for q in (began, farthest))
        turn = after @ before.T
        about = (turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1])
        return bool(ccw * about[VIEWS[view[1]]] > 0.0)

    def _unplug(self, shared: int) -> None:
        """Of the servos with an id, leave the first plugged in."""
        sharing = [i for i, servo in enumerate(self.arm.simulated.servos) if servo.table[ID_AT] == shared]
        for i in sharing[1:]:
            fault = Fault(kind="mute", servo_id=self.arm.true.servo_ids[i])
            self._muted.append(self.arm.simulated.faults.begin(fault, self.arm.simulated.time_s))

    def _plug(self) -> None:
        for number in self._muted:
            self.arm.simulated.faults.end(number)
        self._muted.clear()


def prepared(arm: Arm) -> dict[str, str]:
    """What a person would answer who knows how the arm was put together."""
    went = {f"{joint.name}.went": "yes" if joint.direction == 1 else "no" for joint in arm.true.joints}
    free = {f"{joint.name}.free": "yes" for joint in arm.true.joints}
    bauds = {f"baud.{servo.table[ID_AT]}": "yes" for servo in arm.simulated.servos if servo.table[BAUD_AT] != 1}
    return went | free | bauds | {"motion": "yes"}


def opened_of(arm: Arm) -> Opened:
    """What opens the bus of a simulated arm."""

    @contextmanager
    def opened(servo_ids: Sequence[int]) -> Iterator[ServoBus]:
        arm.virtual.port.setBaudRate(1_000_000)
        bus = ServoBus(arm.virtual.port, servo_ids)
        bus.open()
        with closing(bus):
            yield bus

    return opened
