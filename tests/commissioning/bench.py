"""A simulated arm on a virtual clock, and a hand that holds it in any posture."""

from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np

from armctl.clock import NS_PER_S
from armctl.commissioning.calibration import Touch, read_ticks
from armctl.config import ArmConfig
from armctl.files import load_arm
from armctl.kinematics import robots
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.hand import Hand
from armctl.sim.spec import ArmSpec
from armctl.sim.virtual_arm import VirtualArm


class PosingHand(Hand):
    """Carries every joint of a limp arm to where it is told, and holds it there."""

    CARRY_S = 2.5

    def __init__(self, arm: SimulatedArm) -> None:
        super().__init__(arm.config, arm.chain, lambda: arm.time_s, arm.true_positions)
        self._simulated = arm
        self._from_rad: FloatArray | None = None

    @property
    def holding(self) -> bool:
        return self._from_rad is not None

    def carry(self, posture_rad: FloatArray) -> None:
        """Begin to move towards a posture [rad], shape (n,)."""
        now_s = self._simulated.time_s
        self._from_rad = np.array(self.aim(now_s)[0]) if self.holding else self._simulated.true_positions()
        self._begin_s, self._to_rad = now_s, posture_rad

    def aim(self, time_s: float) -> tuple[list[float], list[float]]:
        assert self._from_rad is not None
        way = self._to_rad - self._from_rad
        u = min((time_s - self._begin_s) / self.CARRY_S, 1.0)
        speed = 0.0 if u == 1.0 else 6.0 * u * (1.0 - u) / self.CARRY_S
        return (self._from_rad + u * u * (3.0 - 2.0 * u) * way).tolist(), (speed * way).tolist()


class Bench:
    """Everything between a test and a simulated arm."""

    def __init__(
        self, *, seed: int = 0, latency_ms: float = 0.0, spec: ArmSpec | None = None, simulated: ArmConfig | None = None
    ) -> None:
        self.config = load_arm("ax12-line")
        self.arm = SimulatedArm(simulated or self.config, seed=seed, spec=spec or ArmSpec())
        self.servos = self.arm.servos
        virtual = VirtualArm(self.arm, wire=SimulatedBus(self.arm, latency_ms=latency_ms, seed=seed))
        self.clock, self.line, self.port, self.bus = virtual.clock, virtual.wire, virtual.port, virtual.bus
        self.arm.advance(self.clock.now_ns())
        self.bus.open()

    def elapsed_s(self, begin_ns: int) -> float:
        return (self.clock.now_ns() - begin_ns) / NS_PER_S


@contextmanager
def unwritten(bench: Bench) -> Iterator[None]:
    """No servo may be written meanwhile."""
    before = [servo.writes for servo in bench.servos]
    yield
    assert [servo.writes for servo in bench.servos] == before


def postures(arm: ArmConfig, count: int, rng: np.random.Generator) -> FloatArray:
    """Postures that touch a low sheet, a step or the air above it, in every way the limits allow; shape (m, n)."""
    chain = robots.get(arm.robot, arm.lengths_m).chain
    limits = np.array([joint.limits_rad for joint in arm.joints])
    margin = np.radians(8.0)
    found: list[FloatArray] = []
    while len(found) < count:
        q = rng.uniform(limits[:, 0] + margin, limits[:, 1] - margin)
        x, y, z = tool_position(chain, q[: chain.n])
        if 0.0 <= z <= 0.3 and np.hypot(x, y) > 0.08:
            found.append(q)
    return np.array(found)


def touch_points(bench: Bench, count: int, rng: np.random.Generator, *, touch_error_m: float = 0.0) -> list[Touch]:
    """Guide the limp arm through `count` postures; each point is known but for the touch error."""
    hand = bench.arm.hand = PosingHand(bench.arm)
    touches = []
    for posture in postures(bench.config, count, rng):
        hand.carry(posture)
        bench.clock.advance_ns(3 * NS_PER_S)
        bench.bus.read_sample()
        ticks = read_ticks(bench.bus, bench.config.joints, bench.clock)
        true_m = bench.arm.true_tool_position() + touch_error_m * rng.standard_normal(3)
        touches.append(Touch(point_m=tuple(true_m.tolist()), ticks=ticks))
    return touches


def planted(config: ArmConfig, rng: np.random.Generator, *, tick: float, length_m: float) -> ArmConfig:
    """The arm as it truly is: zeros off by up to `tick`, every length off by `length_m` one way or the other."""
    known_m = robots.get(config.robot).lengths_m
    lengths = {name: value + length_m * float(rng.choice([-1, 1])) for name, value in known_m.items()}
    zeros = [{"zero_tick": joint.zero_tick + float(rng.uniform(-tick, tick))} for joint in config.joints]
    joints = tuple(joint.model_copy(update=zero) for joint, zero in zip(config.joints, zeros, strict=True))
    return config.model_copy(update={"lengths_m": lengths, "joints": joints})


# An arm that is exactly as its calibration says.
EXACT = ArmSpec(zero_offset_tick=0.0)
