"""Who stands at the arm of an episode: sees what `armctl status` shows, and can lend a hand.

Each doing is a generator of one tick's commands.
"""

from __future__ import annotations

import math
from collections.abc import Generator
from typing import TYPE_CHECKING

import numpy as np

from armctl.config import ArmConfig
from armctl.dynamixel import ax12a
from armctl.errors import UnreachableTarget
from armctl.kinematics.chain import tool_position
from armctl.kinematics.robots.robot import Robot
from armctl.messages import Command, Mode, Reply, TickRecord, TorqueOn
from proving.requests import PERIOD_S, Requests
from proving.story import Garble, Story, Strike, Wish, Word

if TYPE_CHECKING:
    from proving.episode import Episode

Doing = Generator[tuple[Command, ...], None, None]


class Person:
    """One person, and what is seen of the arm."""

    def __init__(self, story: Story, arm: ArmConfig, robot: Robot, episode: Episode) -> None:
        self._arm, self._robot, self._episode = arm, robot, episode
        self._wishes = [line for line in story.lines if isinstance(line, Wish)]
        self._words = [line for line in story.lines if isinstance(line, Word)]
        self._faults = [line.fault for line in story.lines if isinstance(line, Strike)]
        self._garbled = [line for line in story.lines if isinstance(line, Garble)]
        self._requests = Requests(arm, robot, episode.postures)
        self._request_id = 0
        self._replies: dict[int, Reply] = {}
        self._record: TickRecord | None = None
        self._doing: Doing | None = None
        self._now_s = 0.0

    def persisting(self, energising: bool = False) -> str:
        """Why no fault can be cleared now, as the simulator knows; empty: nothing that must forbid it.

        Args:
            energising: Whether the same tick has begun to switch torque on: what little there is comes from that.
        """
        faults, servos = self._episode.body.faults, self._episode.body.servos
        for kind in ("mute", "dead_bus", "unplug"):
            planned = faults.in_force(kind)
            # Begun after this tick's reading it is next tick's business.
            if planned is not None and planned.begin_s < self._now_s - PERIOD_S:
                return f"{kind} is in force"
        if any(servo.temperature_degC >= self._arm.temperature_limit_degC + 1.0 for servo in servos):
            return "a servo is hot"
        on = self._stiff()
        explained = any(faults.in_force(kind) is not None for kind in ("brown_out", "trip", "second_writer"))
        if any(on) and not all(on) and not explained:
            return "some servos are limp while others hold"
        if self._weak() and not energising:
            return "a servo holds with a part of its torque"
        return ""

    def _weak(self) -> bool:
        """Whether a servo has torque, but not what its calibration asks for."""
        return any(
            servo.torque_enabled
            and servo.get(ax12a.TORQUE_LIMIT) < round(ax12a.LOAD_MAX * one.joint.torque_limit_ratio)
            for servo, one in zip(self._episode.body.servos, self._arm.servos, strict=True)
        )

    @property
    def _mode(self) -> Mode:
        assert self._record is not None
        return self._record.outputs.mode

    @property
    def _code(self) -> str:
        assert self._record is not None
        fault = self._record.outputs.fault
        return "" if fault is None else fault.code

    def _commanded(self) -> list[float] | None:
        """Where the arm is commanded to be [rad], as the host knows it: by the goals the servos show."""
        assert self._record is not None
        found = []
        for joint, reading in zip(self._arm.joints, self._record.inputs.sample.servos, strict=False):
            if not reading.registers:
                return None
            found.append(joint.position_rad(ax12a.register_value(ax12a.GOAL, reading.registers)))
        return found

    def _faulty_until_s(self) -> float:
        """When the last of the faults under way will end."""
        begun = [fault for fault in self._faults if fault.begin_s <= self._now_s]
        ends_s = [fault.begin_s + (fault.duration_s or 0.0) for fault in begun]
        ends_s += [line.at_s + line.duration_s for line in self._garbled if line.at_s <= self._now_s]
        return max(ends_s, default=-math.inf)

    def _id(self) -> int:
        self._request_id += 1
        return self._request_id

    def _ask(self, command: Command, patience_s: float) -> Doing:
        """Say it, and wait for the answer, a fault, or until it takes too long."""
        request_id = getattr(command, "request_id")  # noqa: B009
        until_s = self._now_s + patience_s
        yield (command,)
        while request_id not in self._replies and not self._code and self._now_s < until_s:
            yield ()

    def _wait(self, duration_s: float) -> Doing:
        until_s = self._now_s + duration_s
        while self._now_s < until_s:
            yield ()

    def _power_up(self, rng: np.random.Generator, lifted: bool = False) -> Doing:
        """Torque on; a limp arm away from its rest, or one to be lifted, is carried to some posture and supported."""
        if self._mode is not Mode.OFF or any(self._stiff()):
            return
        hand = self._episode.body.hand
        rest = np.array([joint.rest_rad for joint in self._arm.joints])
        lying = np.abs(self._episode.body.true_positions() - rest).max() < math.radians(4.0)
        if lifted or not lying:
            yield from self._guide(rng)
        if not self._code:
            yield from self._ask(TorqueOn(self._id()), 3.0)
        if self._code:  # whoever supports an arm goes on until its card is followed
            return
        if hand.holding:
            yield from self._wait(0.3)
        hand.release()

    def _stiff(self) -> list[bool]:
        """Which joints resist a hand; a status that is a tick behind does not show it."""
        return [servo.torque_enabled and servo.get(ax12a.TORQUE_LIMIT) > 0 for servo in self._episode.body.servos]

    def _let_go(self) -> Doing:
        """A hand that was still at the arm when another program took over."""
        yield from self._wait(1.0)
        self._episode.body.hand.release()

    def _guide(self, rng: np.random.Generator) -> Doing:
        """A hand leads the limp arm along a short line; it stays at the arm."""
        postures = self._episode.postures
        q = postures[int(rng.integers(len(postures)))]
        point = tool_position(self._robot.chain, q[: self._robot.chain.n])
        body = self._episode.body
        try:
            when = body.hand.guide(point, 0.97 * point, seed=int(rng.integers(1000)), duration_s=0.5)
        except UnreachableTarget:  # whatever the hand cannot do, it leaves
            return
        yield from self._wait(when.duration_s)
