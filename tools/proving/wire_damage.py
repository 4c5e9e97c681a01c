"""Damage on the wire, both ways: whatever it is told to be, it is not told to be something else.

An arm takes torque, swings and lets go, on the virtual clock, while a share of all packets of the host and of all
replies comes damaged: bits turned over, bytes missing, ends cut off, packets lost. What ends a motion or refuses a
request may say that the bus is noisy or that somebody did not answer. Any other cause is one that is not there: nobody
else writes, no servo has restarted, the arm stands still.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from armctl.clock import VirtualClock
from armctl.messages import Command, Mode, Release, Run, TorqueOn
from armctl.sim.arm import SimulatedArm
from armctl.sim.bus import SimulatedBus
from armctl.sim.faults import Fault, Faults
from armctl.sim.loopback import LoopbackPort
from armctl.sim.virtual_arm import FIRST_TICKS, VirtualArm
from armctl.trajectory.approach import approach_trajectory
from armctl.trajectory.preflight import DrivenArm
from proving.arms import arm_of, drawn
from proving.requests import PERIOD_S
from proving.rules import RED
from proving.story import DAMAGES
from proving.watch import damaged

SHARES = (0.01, 0.05, 0.1)
TRIALS = 200
REPLIES = ("corrupted", "truncated", "lost")
# What may be told of a damaged line: that something did not arrive, on either way. A damaged length can make every
# servo wait for half a second, and then they are silent indeed.
RIGHT = frozenset({"NO_REPLY", "NOT_TAKEN", "BUS_NOISE", "SERVO_SILENT", "BUS_DEAD"})
RULE = "diagnosis"
# So often a torque-on that is refused is asked for again; so long anything may take.
TRIES = 6
PATIENCE_TICKS = 200
SWING_RAD = 0.35


class DamagedPort(LoopbackPort):
    """A port on a line that damages a share of what the host says."""

    def __init__(self, bus: SimulatedBus, clock: VirtualClock, share: float, seed: int) -> None:
        super().__init__(bus, clock)
        self._share, self._rng = share, np.random.default_rng((seed, 3))

    def _send(self, packet: bytes) -> int:
        arrives = packet
        if self._rng.random() < self._share:
            arrives = damaged(packet, str(self._rng.choice(DAMAGES)), self._rng)
        if arrives:
            super()._send(arrives)
        else:
            self._check()
        return len(packet)


@dataclass
class Told:
    """What the trials at one share of damage were told."""

    runs: int = 0
    done: int = 0
    codes: Counter[str] = field(default_factory=Counter)
    # Of wrong ones: the seed and the words.
    wrong: list[tuple[int, str]] = field(default_factory=list)


def trial(seed: int, share: float, told: Told) -> None:
    """One arm, taken from limp to a swing and back."""
    arm = arm_of(drawn(seed, seed % 1000))
    faults = [Fault(kind=kind, probability=share / len(REPLIES)) for kind in REPLIES]
    body = SimulatedArm(arm, seed=seed, faults=Faults(faults, seed=seed))
    virtual = VirtualArm(body, PERIOD_S, make_port=lambda bus, clock: DamagedPort(bus, clock, share, seed))
    virtual.start()
    virtual.ticks(FIRST_TICKS + 2)
    told.runs += 1
    codes: dict[str, str] = {}

    def carried_out(command: Command) -> bool:
        """Whether it is answered well, once the arm has been let go; what is told meanwhile is noted."""
        while virtual.loop.state.mode is Mode.RELEASING:
            virtual.tick()
        commands: tuple[Command, ...] = (command,)
        for _ in range(PATIENCE_TICKS):
            outputs, commands = virtual.tick(*commands).outputs, ()
            if outputs.fault is not None:
                codes[outputs.fault.code] = outputs.fault.text
                return False
            for reply in outputs.replies:
                if not reply.ok:
                    codes.setdefault(reply.code, reply.message)
                return reply.ok
        return False

    done = any(virtual.loop.state.fault is None and carried_out(TorqueOn(virtual.next_id())) for _ in range(TRIES))
    if done and virtual.loop.state.mode is Mode.HOLDING:
        q = virtual.goals_rad
        target = [
            a + (SWING_RAD if a < sum(joint.limits_rad) / 2.0 else -SWING_RAD)
            for a, joint in zip(q, arm.joints, strict=True)
        ]
        swing = approach_trajectory(q, target, DrivenArm(arm, virtual.robot, PERIOD_S), "swing")
        done = carried_out(Run(virtual.next_id(), swing))
    if virtual.loop.state.fault is None:
        carried_out(Release(virtual.next_id()))
    told.done += done
    told.codes.update(codes.keys())
    told.wrong += [(seed, f"{code}: {text}") for code, text in codes.items() if code not in RIGHT]


def prove(seed: int, trials: int = TRIALS) -> dict[str, Any]:
    """So many trials at each share; a wrong word is a violation, or red while its rule is."""
    rows, wrong = [], 0
    for share in SHARES:
        told = Told()
        for number in range(trials):
            trial(seed * 100_000 + number, share, told)
        wrong += len(told.wrong)
        rows.append(
            {
                "share": share,
                "runs": told.runs,
                "done": told.done,
                "codes": dict(told.codes),
                "wrong": [f"seed {number}: {text}" for number, text in told.wrong[:10]],
            }
        )
    return {
        "runs": sum(row["runs"] for row in rows),
        "violations": 0 if RULE in RED else wrong,
        "red": wrong if RULE in RED else 0,
        "damage": rows,
    }
