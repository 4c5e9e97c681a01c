"""Reaching for a point, and gripping what is there: several short motions, one recording."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from armctl.clock import NS_PER_S
from armctl.errors import RequestRefused, UnreachableTarget
from armctl.host.host import Host
from armctl.host.lease import Client
from armctl.host.watch import Leg
from armctl.kinematics.chain import tool_position
from armctl.kinematics.transform import FloatArray
from armctl.messages import JointTrajectory
from armctl.trajectory import grasp
from armctl.trajectory.grasp import ReachRequest

# Of the load asked for: with less the gripper has lost what it held.
HELD_SHARE = 0.5
# The leg after which the tool is at the point.
_THERE = 4


async def reach(host: Host, client: Client, request: ReachRequest) -> dict[str, Any]:
    """Approach, straight to the point, and there stay, or grip or let go and back off; recorded and measured.

    Raises:
        RequestRefused: UNREACHABLE with the nearest distance, NO_GRIPPER, pre-flight (every reason), BUSY, stopped or
            failed on the way.
        LogError: the recording cannot be made.
    """
    legs = _Legs(host, request)
    name, done = await host.execute(client, "reach", legs.all(), {"event": "REACH", **request.model_dump()})
    n = host.robot.chain.n
    q = np.array([leg.watch.positions_rad[-1][:n] for leg in done])
    place = tool_position(host.robot.chain, q)
    error_mm = 1e3 * np.linalg.norm(place[_THERE] - np.array(request.point_m))
    result: dict[str, Any] = {
        "recording": name,
        "position_error_mm": float(error_mm),
        "position_m": place[_THERE].tolist(),
        "joints_rad": q[_THERE].tolist(),
        "target_rad": legs.path_rad[-1].tolist(),
        "method": request.ik,
        "duration_s": (done[-1].watch.time_ns[-1] - done[0].watch.time_ns[0]) / NS_PER_S,
        "gripped": None,
    }
    if request.gripper == "stay":
        return result
    index, gripper = grasp.gripper_of(host.arm, host.robot)
    now = host.status()["joints"][index]
    held = abs(now["load_ratio"]) >= HELD_SHARE * gripper.load_ratio
    met = any(leg.reply.code == "GRIPPED" for leg in done)
    return {
        **result,
        "gripped": (met and held) if request.gripper == "grip" else False,
        "gripper": {"joint": gripper.joint, "position_rad": now["position_rad"], "load_ratio": now["load_ratio"]},
        "lifted_m": place[-1].tolist(),
    }


class _Legs:
    """The legs of one reach; the way is planned when the first is made, before anything moves."""

    # Joint positions on the straight line, once it is planned; see `Grasp`.
    path_rad: FloatArray

    def __init__(self, host: Host, request: ReachRequest) -> None:
        self._request = request
        self._where = host.arm, host.robot, host.period_s

    def all(self) -> list[Leg]:
        where = self._where

        def straight(step: int) -> Leg:
            return lambda q_now, _: grasp.straight(self.path_rad[::step], q_now, *where)

        def align(place: int) -> Leg:
            return lambda q_now, q_measured: grasp.align(self.path_rad[place], q_now, q_measured, *where)

        # Twice at the point: the second correction takes what the first one has left.
        there = [self._approach, align(0), straight(1), align(-1), align(-1)]
        act: dict[str, list[Leg]] = {
            "stay": [],
            "grip": [lambda q_now, _: grasp.gripping(q_now, *where, closing=True), straight(-1)],
            "let_go": [lambda q_now, _: grasp.gripping(q_now, *where, closing=False), straight(-1)],
        }
        return there + act[self._request.gripper]

    def _approach(self, q_now: Sequence[float], _: Sequence[float]) -> JointTrajectory:
        if self._request.gripper != "stay":
            grasp.gripper_of(*self._where[:2])
        try:
            planned = grasp.plan_grasp(self._request, q_now, *self._where)
        except UnreachableTarget as error:
            raise RequestRefused("UNREACHABLE", str(error)) from None
        self.path_rad = planned.path_rad
        return grasp.approach(planned, q_now, *self._where, opening=self._request.gripper == "grip")
