"""A virtual arm of which some packets arrive damaged, and what a hand-made story needs of it."""

import math
from collections.abc import Callable, Sequence

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import Instruction
from armctl.files import load_arm
from armctl.messages import JointTrajectory, Mode, Reply, Run, TickRecord, TorqueOn
from armctl.sim.arm import SimulatedArm
from armctl.sim.faults import Fault
from armctl.sim.loopback import LoopbackPort
from armctl.sim.spec import DEFAULT_SPEC, ArmSpec
from armctl.sim.virtual_arm import VirtualArm

ARM = load_arm("ax12-line")
# Nearly stretched out along the table: much weight at the shoulder.
STRETCHED_DEG = (0.0, 20.0, -10.0, -10.0, 0.0, 0.0)


def is_goal(packet: bytes) -> bool:
    return packet[4] == Instruction.SYNC_WRITE


def writes(packet: bytes, register: ax12a.Register, servo_id: int) -> bool:
    return packet[2] == servo_id and packet[4] == Instruction.WRITE and packet[5] == register.address


class DamagingPort(LoopbackPort):
    """A port on whose line some packets get a wrong checksum."""

    damages: Callable[[bytes], bool] = staticmethod(lambda _packet: False)

    def _send(self, packet: bytes) -> int:
        damaged = packet[:-1] + bytes((packet[-1] ^ 0x55,)) if self.damages(packet) else packet
        super()._send(damaged)
        return len(packet)


class Rig(VirtualArm):
    """A virtual arm that remembers what it said."""

    port: DamagingPort

    def __init__(self, seed: int = 3, spec: ArmSpec = DEFAULT_SPEC, arm: ArmConfig = ARM) -> None:
        super().__init__(SimulatedArm(arm, seed=seed, spec=spec), make_port=DamagingPort)
        self.records: list[TickRecord] = []
        self.on_tick = self.records.append
        self.start()
        self.ticks(3)

    def holding(self) -> "Rig":
        self.ticks(16, TorqueOn(900))
        assert self.mode() is Mode.HOLDING
        return self

    def at(self, deg: Sequence[float] = STRETCHED_DEG) -> "Rig":
        """Holding in a pose."""
        self.ticks(110, Run(901, self.way(deg)))
        assert self.replies()[901].ok
        return self

    def way(self, deg: Sequence[float], seconds: float = 5.0) -> JointTrajectory:
        """A straight line in joint space from where the arm is told to be."""
        count, begin = round(seconds / 0.1), self.goals_rad
        end = [value * math.pi / 180.0 for value in deg]
        points = tuple(
            tuple(a + (b - a) * k / count for a, b in zip(begin, end, strict=True)) for k in range(count + 1)
        )
        return JointTrajectory(0.1, points, label="way")

    def turned(self, delta_deg: float, joint: int = 0, seconds: float = 3.0) -> JointTrajectory:
        """One joint turned by so much."""
        deg = [value * 180.0 / math.pi for value in self.goals_rad]
        deg[joint] += delta_deg
        return self.way(deg, seconds)

    def fault(self, kind: str, servo_id: int | None = None, **more: float) -> int:
        """A fault from now on; its number."""
        sim = self.simulated
        return sim.faults.begin(Fault(kind=kind, servo_id=servo_id, **more), sim.time_s)  # type: ignore[arg-type]

    def mode(self) -> Mode:
        return self.loop.state.mode

    def code(self) -> str:
        return self.loop.state.fault.code if self.loop.state.fault else ""

    def replies(self) -> dict[int, Reply]:
        return {reply.request_id: reply for record in self.records for reply in record.outputs.replies}

    def codes(self) -> list[str]:
        return [event.code for record in self.records for event in record.outputs.events]

    def stiff(self) -> list[int]:
        """Ids of the servos that have torque."""
        return [servo.servo_id for servo in self.simulated.servos if servo.torque_enabled]

    def outputs(self) -> list[float]:
        """Of every motor, as a share of its strength."""
        return [abs(servo.output) for servo in self.simulated.servos]

    def joint_deg(self, joint: int) -> float:
        return float(self.simulated.true_positions()[joint]) * 180.0 / math.pi
