"""The arm every simulator test plays with, on its bus, and the bytes that move it."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pytest
import yaml

from armctl.clock import NS_PER_S
from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.ax12a import Register
from armctl.dynamixel.packet import BROADCAST_ID, BadChecksum, Decoder, Instruction, Packet, encode_instruction
from armctl.files import load_arm
from armctl.kinematics.transform import FloatArray
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault, Faults
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec

WORKING_RAD: FloatArray = np.radians([0.0, 75.0, -60.0, -45.0, -45.0, 0.0])


def turned(base_rad: float) -> FloatArray:
    """The working pose with its base turned."""
    pose = WORKING_RAD.copy()
    pose[0] += base_rad
    return pose


def read(servo_id: int, register: Register = ax12a.PRESENT_POSITION, size: int | None = None) -> bytes:
    """The packet that reads a register, or so many bytes from there on."""
    return encode_instruction(servo_id, Instruction.READ, bytes((register.address, size or register.size)))


def write(servo_id: int, register: Register, value: int) -> bytes:
    """The packet that writes a register."""
    data = bytes((register.address,)) + value.to_bytes(register.size, "little")
    return encode_instruction(servo_id, Instruction.WRITE, data)


@pytest.fixture(scope="session")
def arm() -> ArmConfig:
    return load_arm("ax12-line")


def refusals(of: str) -> list[tuple[str, str]]:
    """What is refused, and what is said of it."""
    return list(yaml.safe_load(Path(__file__).with_name("refusals.yaml").read_text(encoding="utf-8"))[of].items())


class Bench:
    """A simulated arm on its bus; time begins at 1 s and moves when told to."""

    def __init__(self, arm: ArmConfig, *script: Fault, seed: int = 0, spec: ArmSpec = DEFAULT_SPEC) -> None:
        self.arm = SimulatedArm(arm, seed=seed, spec=spec, faults=Faults(script, seed=seed))
        self.bus = SimulatedBus(self.arm, seed=seed)
        self.now_ns = NS_PER_S
        self.arm.advance(self.now_ns)

    def wait(self, seconds: float) -> None:
        self.now_ns += round(seconds * 1e9)
        self.arm.advance(self.now_ns)

    def goto(self, positions_rad: FloatArray, speed: int | Sequence[int] = 100, wait_s: float = 0.0) -> None:
        """SYNC_WRITE of goals (clamped to the limits) and moving speeds [register units]."""
        speeds = [speed] * len(positions_rad) if isinstance(speed, int) else speed
        data = bytes((ax12a.GOAL.address, 4))
        for joint, position, units in zip(self.arm.config.joints, positions_rad.tolist(), speeds, strict=True):
            low, high = joint.limits_tick
            tick = min(max(round(joint.tick(position)), low), high)
            data += bytes((joint.servo_id,)) + tick.to_bytes(2, "little") + units.to_bytes(2, "little")
        self.bus.receive(encode_instruction(BROADCAST_ID, Instruction.SYNC_WRITE, data), self.now_ns)
        self.wait(wait_s)

    def hold(self) -> None:
        """The arm in its working pose, at rest."""
        self.goto(WORKING_RAD, wait_s=6.0)

    def limp(self) -> None:
        for servo in self.arm.servos:
            servo.set(ax12a.TORQUE_ENABLE, 0)

    def ask(self, request: bytes) -> list[tuple[int, int]]:
        """Every byte that comes back within 50 ms, with its time since the request's begin [ns]."""
        begin_ns = self.now_ns
        self.bus.receive(request, begin_ns)
        self.wait(0.05)
        heard = []
        while (at := self.bus.arrival_ns()) is not None and at <= self.now_ns:
            heard += [(at - begin_ns, value) for value in self.bus.transmit(at)]
        return heard

    def hear(self, request: bytes) -> bytes:
        return bytes(value for _, value in self.ask(request))

    def packets(self, request: bytes) -> list[Packet | BadChecksum]:
        return Decoder().feed(self.hear(request))

    def error(self, servo_id: int) -> int:
        """The error bits in the one reply of a servo that is read."""
        (reply,) = self.packets(read(servo_id))
        assert isinstance(reply, Packet)
        return reply.code

    def begin(self, kind: str, servo_id: int | None = None, value: float | None = None) -> int:
        """Let a fault begin now; its number."""
        number = self.arm.faults.begin(Fault(kind=kind, servo_id=servo_id, value=value), self.arm.time_s)
        self.arm.advance(self.now_ns)
        return number

    def end(self, number: int) -> None:
        self.arm.faults.end(number)
        self.wait(0.001)


@pytest.fixture
def bench(arm: ArmConfig) -> Bench:
    return Bench(arm)


@pytest.fixture
def held(bench: Bench) -> Bench:
    """A bench whose arm holds its working pose."""
    bench.hold()
    return bench
