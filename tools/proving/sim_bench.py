"""How much virtual time a second of CPU buys: the simulated arm alone, and the whole control loop on it.

The whole loop is what soak tests run: `ControlLoop`, `ServoBus`, the Dynamixel SDK, the loopback port, the simulated
bus and arm, ten ticks a virtual second. Beside it stands MuJoCo with an arm of the same masses, friction, motor
damping and rotor inertia at the same 1 kHz, which is the physics alone: without play, whole ticks, stiction, heat,
supply, and without servos. CPU is user and system time of this process; of all rounds the best counts, being the one
least disturbed by other work.
"""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from armctl.dynamixel import ax12a
from armctl.dynamixel.packet import BROADCAST_ID, Instruction, encode_instruction
from armctl.files import load_arm
from armctl.messages import JointTrajectory, Run
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.virtual_arm import VirtualArm
from proving.figures import check, row
from proving.mujoco_arm import mjcf
from proving.rig import ARM

ROUNDS = 5
# Virtual time of a round.
SECONDS = 10.0
PERIOD_S = 0.1
PERIOD_NS = 100_000_000
# In plain Python, half holding, half moving: an hour of soak in about a minute.
SPEED_BOUND = 55.0
WORKING_RAD = np.radians([20.0, 75.0, -60.0, -45.0, -45.0, 10.0])
# There and back in `SWING_S`, a sine: up to 36 deg/s.
SWING_RAD = np.array([1.0, -0.4, 0.5, 0.4, 0.4, 1.0])
SWING_S = 10.0

# Lets so many virtual seconds pass.
Play = Callable[[float], None]


def bench(seed: int, seconds: float = SECONDS, rounds: int = ROUNDS) -> dict[str, Any]:
    """Rows and checks; `ratio` is to MuJoCo's figure."""
    peer = _speed(_mujoco(seed), seconds, rounds)
    arm, loop = _Arm(seed), _Loop(seed)
    figures = {
        ("arm at rest", "armctl, physics"): _speed(arm.rest, seconds, rounds),
        ("arm told to hold, ten times a second", "armctl, physics"): _speed(arm.hold, seconds, rounds),
        ("arm moving", "armctl, physics"): _speed(arm.move, seconds, rounds),
        ("arm moving", "MuJoCo, mj_step at 1 kHz"): peer,
        ("control loop holding", "armctl, loop to physics"): (holding := _speed(loop.hold, seconds, rounds)),
        ("control loop moving", "armctl, loop to physics"): (moving := _speed(loop.move, seconds, rounds)),
        ("control loop, half holding, half moving", "armctl, loop to physics"): (
            mixed := 2.0 / (1.0 / holding + 1.0 / moving)
        ),
    }
    return {
        "rows": [row(work, who, value, "s/s", value / peer) for (work, who), value in figures.items()],
        "checks": [check("virtual seconds per CPU second, whole loop", mixed, SPEED_BOUND, least=True)],
        "seed": seed,
    }


def _speed(play: Play, seconds: float, rounds: int) -> float:
    """Virtual seconds per second of CPU, the best of so many rounds."""
    best = 0.0
    for _ in range(rounds):
        begin_s = time.process_time()
        play(seconds)
        best = max(best, seconds / max(time.process_time() - begin_s, 1e-9))
    return best


def _swing(time_s: float) -> Any:
    """Joint positions [rad], shape (6,)."""
    return WORKING_RAD + SWING_RAD * (0.5 - 0.5 * np.cos(2.0 * np.pi * time_s / SWING_S))


class _Arm:
    """The simulated arm, told goals as bytes on its bus and read by nobody."""

    def __init__(self, seed: int) -> None:
        self._config = load_arm(ARM)
        self._arm = SimulatedArm(self._config, seed=seed)
        self._bus = SimulatedBus(self._arm)
        self._now_ns, self._swing_s = PERIOD_NS, 0.0
        self._arm.advance(self._now_ns)
        self._tell(WORKING_RAD)
        self.rest(8.0)

    def rest(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self._wait()

    def hold(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self._tell(WORKING_RAD)
            self._wait()

    def move(self, seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            self._swing_s += PERIOD_S
            self._tell(_swing(self._swing_s))
            self._wait()

    def _wait(self) -> None:
        self._now_ns += PERIOD_NS
        self._arm.advance(self._now_ns)

    def _tell(self, positions_rad: Any) -> None:
        data = bytes((ax12a.GOAL.address, 4))
        for joint, position_rad in zip(self._config.joints, positions_rad.tolist(), strict=True):
            tick, speed = round(joint.tick(position_rad)), 60
            data += bytes((joint.servo_id,)) + tick.to_bytes(2, "little") + speed.to_bytes(2, "little")
        self._bus.receive(encode_instruction(BROADCAST_ID, Instruction.SYNC_WRITE, data), self._now_ns)


class _Loop:
    """The control loop on a simulated arm, energised and in its working pose."""

    def __init__(self, seed: int) -> None:
        self._virtual = VirtualArm(SimulatedArm(load_arm(ARM), seed=seed), PERIOD_S)
        self._virtual.energise()
        self.hold(2.0)
        rest = np.array(self._virtual.goals_rad)
        shares = 0.5 - 0.5 * np.cos(np.linspace(0.0, np.pi, 81))
        self._run([(rest + share * (WORKING_RAD - rest)).tolist() for share in shares])
        self.hold(2.0)

    def hold(self, seconds: float) -> None:
        self._virtual.ticks(round(seconds / PERIOD_S))

    def move(self, seconds: float) -> None:
        """Whole swings, at least one."""
        for _ in range(max(1, round(seconds / SWING_S))):
            self._run([_swing(k * PERIOD_S).tolist() for k in range(round(SWING_S / PERIOD_S) + 1)])

    def _run(self, positions_rad: list[list[float]]) -> None:
        points = tuple(tuple(position) for position in positions_rad)
        swing = JointTrajectory(PERIOD_S, points, 0.0, PERIOD_S * (len(points) - 1), "swing")
        self._virtual.carry_out(Run(self._virtual.next_id(), swing))


def _mujoco(seed: int) -> Play:
    """MuJoCo's step of an arm with the same masses, friction, damping and rotor inertia; motors follow the swing."""
    import mujoco

    simulated = SimulatedArm(load_arm(ARM), seed=seed)
    spec = simulated.spec
    friction_Nm = sum(spec.friction_Nm) / 2.0
    damping = spec.stall_torque_Nm / spec.no_load_speed_rad_s
    stiffness = spec.stall_torque_Nm / (32.0 * ax12a.TICK_RAD)  # the compliance slope's
    joint = (
        f'frictionloss="{friction_Nm}" damping="{damping}" armature="{spec.rotor_inertia_kg_m2}" '
        f'stiffness="{stiffness}"'
    )
    model = mujoco.MjModel.from_xml_string(mjcf(simulated.chain.rows, simulated.points_kg, joint=joint, wrist=True))
    data = mujoco.MjData(model)
    data.qpos[:] = WORKING_RAD

    def play(seconds: float) -> None:
        for _ in range(round(seconds / PERIOD_S)):
            model.qpos_spring[:] = _swing(data.time)
            mujoco.mj_step(model, data, round(PERIOD_S / model.opt.timestep))

    return play
