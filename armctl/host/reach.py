"""Reaching for a point, and gripping what is there: several short motions, one recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Literal

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.host.host import Host, Leg
from armctl.host.lease import Client
from armctl.kinematics.chain import tool_position
from armctl.messages import JointTrajectory
from armctl.trajectory import grasp
from armctl.trajectory.grasp import Grasp

HELD_SHARE = 0.5
"""Of the load asked for: with less the gripper has lost what it held."""
_THERE = 4
"""The leg after which the tool is at the point."""


@dataclass(frozen=True)
class Wanted:
    """What is to be reached, and how; see `trajectory.grasp`."""

    point_m: tuple[float, float, float]
    gripper: Literal["stay", "grip", "let_go"] = "stay"
    ik: grasp.Method = "closed"
    seed: int = 0
    off_m: float = 0.05
    along: grasp.Along = "above"


async def reach(host: Host, client: Client, wanted: Wanted) -> dict[str, Any]:
    """Approach, straight to the point, and there stay, or grip or let go and back off; recorded and measured.

    Raises:
        RequestRefused: UNREACHABLE with the nearest distance, NO_GRIPPER, pre-flight (every reason), BUSY, stopped or
            failed on the way.
        LogError: the recording cannot be made.
    """
    legs = _Legs(host, wanted)
    name, done = await host.execute(client, "reach", legs.all(), {"event": "REACH", **asdict(wanted)})
    n = host.robot.chain.n
    q = np.array([leg.watch.positions_rad[-1][:n] for leg in done])
    place = tool_position(host.robot.chain, q)
    error_mm = 1e3 * np.linalg.norm(place[_THERE] - np.array(wanted.point_m))
    result: dict[str, Any] = {
        "recording": name,
        "position_error_mm": float(error_mm),
        "position_m": place[_THERE].tolist(),
        "joints_rad": q[_THERE].tolist(),
        "target_rad": legs.planned.path_rad[-1].tolist(),
        "method": wanted.ik,
        "duration_s": (done[-1].watch.time_ns[-1] - done[0].watch.time_ns[0]) / NS_PER_S,
        "gripped": None,
    }
    if wanted.gripper == "stay":
        return result
    index, gripper = grasp.gripper_of(host.arm, host.robot)
    now = host.status()["joints"][index]
    held = abs(now["load_ratio"]) >= HELD_SHARE * gripper.load_ratio
    met = any(leg.reply.code == "GRIPPED" for leg in done)
    return {
        **result,
        "gripped": (met and held) if wanted.gripper == "grip" else False,
        "gripper": {"joint": gripper.joint, "position_rad": now["position_rad"], "load_ratio": now["load_ratio"]},
        "lifted_m": place[-1].tolist(),
    }


class _Legs:
    """The legs of one reach; the way is planned when the first is made, before anything moves."""

    def __init__(self, host: Host, wanted: Wanted) -> None:
        self._host, self._wanted = host, wanted
        self._grasp: Grasp | None = None

    @property
    def planned(self) -> Grasp:
        assert self._grasp is not None
        return self._grasp

    def all(self) -> list[Leg]:
        there: list[Leg] = [self._approach, self._align_begin, self._straight, self._align_end, self._align_end]
        act: dict[str, list[Leg]] = {
            "stay": [],
            "grip": [self._close, self._back],
            "let_go": [self._open, self._back],
        }
        return there + act[self._wanted.gripper]

    def _approach(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        host, wanted = self._host, self._wanted
        if wanted.gripper != "stay":
            grasp.gripper_of(host.arm, host.robot)
        try:
            self._grasp = grasp.plan_grasp(
                wanted.point_m,
                q_now,
                host.arm,
                host.robot,
                host.period_s,
                method=wanted.ik,
                seed=wanted.seed,
                off_m=wanted.off_m,
                along=wanted.along,
            )
        except UnreachableTarget as error:
            raise RequestRefused("UNREACHABLE", str(error)) from None
        opening = wanted.gripper == "grip"
        return grasp.approach(self._grasp, q_now, host.arm, host.robot, host.period_s, opening=opening)

    def _align_begin(self, q_now: Sequence[float], q_measured: Sequence[float]) -> JointTrajectory:
        host = self._host
        return grasp.align(self.planned.path_rad[0], q_now, q_measured, host.arm, host.robot, host.period_s)

    def _straight(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        host = self._host
        return grasp.straight(self.planned.path_rad, q_now, host.arm, host.robot, host.period_s)

    def _align_end(self, q_now: Sequence[float], q_measured: Sequence[float]) -> JointTrajectory:
        host = self._host
        return grasp.align(self.planned.path_rad[-1], q_now, q_measured, host.arm, host.robot, host.period_s)

    def _close(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        return grasp.closing(q_now, self._host.arm, self._host.robot, self._host.period_s)

    def _open(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        return grasp.opening(q_now, self._host.arm, self._host.robot, self._host.period_s)

    def _back(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        host = self._host
        return grasp.straight(self.planned.path_rad[::-1], q_now, host.arm, host.robot, host.period_s)
